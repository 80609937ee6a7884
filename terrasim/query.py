"""Asking the surface: heights, normals, levels and error bounds at world points."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.arrays import answer, kind_of, vectors
from terrasim.errors import InputError
from terrasim.grid import Block, Grid
from terrasim.kernels.addressing import BLOCK_SHIFT
from terrasim.kernels.sample import NOT_A_NUMBER, sample_height, sample_surface
from terrasim.kernels.surface import COARSER, IN_HOLE, OFF_TERRAIN
from terrasim.launch import launch
from terrasim.terrain import Terrain


@dataclass(frozen=True)
class Sample:
    """Answers of :func:`sample`, of the kind that was asked with, on the terrain's device."""

    height: Any
    """World z of the surface [m], float64, shape ``(count,)``; NaN in a hole."""
    state: Any
    """0, or the sum of ``OFF_TERRAIN`` 1, ``IN_HOLE`` 2 and ``COARSER`` 4, uint8, ``(count,)``."""


@dataclass(frozen=True)
class SurfaceSample:
    """Answers of :func:`sample_all`, of the kind that was asked with."""

    height: Any
    """World z of the surface [m], float64, shape ``(count,)``; NaN in a hole."""
    normal: Any
    """Upward unit normal, float64, shape ``(count, 3)`` (``vec3d`` for Warp); up in a hole."""
    slope: Any
    """Steepest rise per run of the triangle, float64, shape ``(count,)``; 0 in a hole."""
    level: Any
    """Level that answered, uint8, shape ``(count,)``."""
    error: Any
    """Bound of the vertical distance to the level-0 surface [m], float64, shape ``(count,)``."""
    state: Any
    """As in :class:`Sample`."""


def sample(terrain: Terrain, points: Any, *, level: int = 0, wait: bool = True) -> Sample:
    """Height of the surface at world points.

    Args:
        terrain: The terrain.
        points: World x, y [m], shape ``(count, 2)``: NumPy, torch or Warp. A point beyond the edge
            takes the height of the nearest edge point, and its state says so.
        level: Level to answer from.
        wait: Bring the level's blocks in first where they are not resident. Otherwise the finest
            resident level above answers, counted as a fallback.

    Returns:
        Heights and states.

    Raises:
        InputError: If a coordinate is NaN or infinite, the shape is wrong or there is no such
            level.
    """
    kind, asked = _asked(terrain, points, level)
    count = asked.shape[0]
    height = wp.empty(count, dtype=wp.float64, device=terrain.device)
    state = wp.empty(count, dtype=wp.uint8, device=terrain.device)
    outputs = [height, state]
    _answer_all(terrain, asked, level, wait, sample_height, _height_shared(terrain, level), outputs)
    return Sample(*(answer(array, kind) for array in outputs))


def sample_all(
    terrain: Terrain, points: Any, *, level: int = 0, wait: bool = True
) -> SurfaceSample:
    """Height, normal, slope, level and error bound of the surface at world points.

    Arguments and errors are those of :func:`sample`.
    """
    kind, asked = _asked(terrain, points, level)
    count = asked.shape[0]
    types = (wp.float64, wp.vec3d, wp.float64, wp.uint8, wp.float64, wp.uint8)
    outputs = [wp.empty(count, dtype=dtype, device=terrain.device) for dtype in types]
    shared = [terrain.pool, terrain.resident, terrain.error, terrain.lattice, level, terrain.used]
    _answer_all(terrain, asked, level, wait, sample_surface, shared, outputs)
    return SurfaceSample(*(answer(array, kind) for array in outputs))


def check_level(grid: Grid, level: int) -> None:
    """Refuse a level the terrain does not have."""
    if not 0 <= level <= grid.top:
        raise InputError(f"level must be 0 to {grid.top} on this terrain, got {level}")


def _asked(terrain: Terrain, points: Any, level: int) -> tuple[Any, Any]:
    check_level(terrain.grid, level)
    return kind_of(points), vectors(points, 2, terrain.device, "points")


def _height_shared(terrain: Terrain, level: int) -> list[Any]:
    return [terrain.pool, terrain.resident, terrain.lattice, level, terrain.used]


def _answer_all(
    terrain: Terrain,
    asked: Any,
    level: int,
    wait: bool,
    kernel: Any,
    shared: list[Any],
    outputs: list[Any],
) -> None:
    """Launch on what is resident; then, if the caller waits, bring in what was missing."""
    launch(
        kernel,
        asked.shape[0],
        shared=shared,
        items=[asked, *outputs],
        device=terrain.device,
        threads=terrain.threads,
    )
    state = outputs[-1].numpy()
    seen = int(np.bitwise_or.reduce(state)) if state.size else 0
    if seen & NOT_A_NUMBER:
        bad = int(np.flatnonzero(state & NOT_A_NUMBER)[0])
        raise InputError(f"points[{bad}] must be finite, got {tuple(asked.numpy()[bad])}")
    if seen & COARSER and wait:
        late = np.flatnonzero(state & COARSER)
        _answer_late(terrain, asked.numpy()[late], late, level, (kernel, shared), outputs)
        state = outputs[-1].numpy()
    if seen:
        _count(terrain, state)
    used = terrain.cache.note_used()
    if seen & COARSER and not wait:
        terrain.cache.note_fallback(used, level)


def _answer_late(
    terrain: Terrain,
    points: npt.NDArray[np.float64],
    late: npt.NDArray[np.int64],
    level: int,
    call: tuple[Any, list[Any]],
    outputs: list[Any],
) -> None:
    """Answer points whose blocks were not resident, as many blocks at a time as the pool holds."""
    kernel, shared = call
    hosts = [array.numpy() for array in outputs]
    for part, blocks in _groups(terrain, points, level):
        terrain.cache.hold(blocks)
        asked: Any = wp.array(points[part], dtype=wp.vec2d, device=terrain.device)
        answers = [
            wp.empty(len(part), dtype=array.dtype, device=terrain.device) for array in outputs
        ]
        wp.launch(kernel, dim=len(part), inputs=[*shared, asked, *answers], device=terrain.device)
        for host, array in zip(hosts, answers, strict=True):
            host[late[part]] = array.numpy()
    if terrain.device.is_cuda:
        for array, host in zip(outputs, hosts, strict=True):
            array.assign(host)


def _groups(
    terrain: Terrain, points: npt.NDArray[np.float64], level: int
) -> Iterator[tuple[npt.NDArray[np.int64], list[Block]]]:
    """Divide points into groups whose blocks fit into the pool together."""
    row, col = (cells >> level for cells in cells_of(terrain.grid, points))
    corners = np.stack(
        [
            row >> BLOCK_SHIFT,
            (row + 1) >> BLOCK_SHIFT,
            col >> BLOCK_SHIFT,
            (col + 1) >> BLOCK_SHIFT,
        ],
        axis=1,
    )
    ranges, which = np.unique(corners, axis=0, return_inverse=True)
    which = which.reshape(-1)
    order = np.argsort(which, kind="stable")
    ends = np.cumsum(np.bincount(which, minlength=len(ranges)))
    blocks: dict[Block, None] = {}
    first = start = 0
    for i, (row0, row1, col0, col1) in enumerate(ranges.tolist()):
        new = [Block(level, r, c) for r in range(row0, row1 + 1) for c in range(col0, col1 + 1)]
        if blocks and len({*blocks, *new}) > terrain.cache.capacity:
            yield order[start:first], list(blocks)
            blocks, start = {}, first
        blocks.update(dict.fromkeys(new))
        first = int(ends[i])
    yield order[start:first], list(blocks)


def cells_of(
    grid: Grid, points: npt.NDArray[np.float64]
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64]]:
    """Level-0 cell row and column under world points, moved into the terrain."""
    col = np.floor((points[:, 0] - grid.x) / grid.spacing)
    row = np.floor((points[:, 1] - grid.y) / grid.spacing)
    return (
        np.clip(row, grid.row, grid.row + grid.rows - 2).astype(np.int64),
        np.clip(col, grid.col, grid.col + grid.cols - 2).astype(np.int64),
    )


def _count(terrain: Terrain, state: npt.NDArray[np.uint8]) -> None:
    counters = terrain.cache.counters
    counters.off_terrain += int(np.count_nonzero(state & OFF_TERRAIN))
    counters.in_hole += int(np.count_nonzero(state & IN_HOLE))
    counters.fallbacks += int(np.count_nonzero(state & COARSER))
