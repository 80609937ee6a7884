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
from terrasim.kernels.sample import (
    NOT_A_NUMBER,
    PENDING,
    LevelLattice,
    sample_height,
    sample_inside,
    sample_surface,
)
from terrasim.kernels.surface import COARSER, IN_HOLE, OFF_TERRAIN
from terrasim.launch import launch
from terrasim.terrain import Terrain

Call = tuple[Any, list[Any]]
"""A kernel and its shared arguments."""


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
    shared = [terrain.pool, terrain.resident, terrain.lattice, level, terrain.used]
    call = (sample_height, shared)
    if terrain.device.is_cuda:
        _launch(terrain, call, asked, outputs)
    else:
        _launch_quick(terrain, call, level, asked, outputs)
    _complete(terrain, call, asked, level, wait, outputs)
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
    call = (sample_surface, shared)
    _launch(terrain, call, asked, outputs)
    _complete(terrain, call, asked, level, wait, outputs)
    return SurfaceSample(*(answer(array, kind) for array in outputs))


def check_level(grid: Grid, level: int) -> None:
    """Refuse a level the terrain does not have."""
    if not 0 <= level <= grid.top:
        raise InputError(f"level must be 0 to {grid.top} on this terrain, got {level}")


def _asked(terrain: Terrain, points: Any, level: int) -> tuple[Any, Any]:
    check_level(terrain.grid, level)
    return kind_of(points), vectors(points, 2, terrain.device, "points")


def _launch(terrain: Terrain, call: Call, asked: Any, outputs: list[Any]) -> None:
    kernel, shared = call
    launch(
        kernel,
        asked.shape[0],
        shared=shared,
        items=[asked, *outputs],
        device=terrain.device,
        threads=terrain.threads,
    )


def _launch_quick(terrain: Terrain, call: Call, level: int, asked: Any, outputs: list[Any]) -> None:
    """The quick pass, then the general kernel on the few points it left."""
    lattice = level_lattice(terrain.grid, level)
    if level == 0 and terrain.detail.factor > 1:
        lattice.detail = terrain.lattice.detail
    shared = [terrain.pool, terrain.resident, lattice, terrain.used]
    _launch(terrain, (sample_inside, shared), asked, outputs)
    left = np.flatnonzero(outputs[-1].numpy() & PENDING)
    if left.size:
        _answer_some(terrain, call, asked.numpy()[left], left, outputs)


def _answer_some(
    terrain: Terrain,
    call: Call,
    points: npt.NDArray[np.float64],
    places: npt.NDArray[np.int64],
    outputs: list[Any],
) -> None:
    """Answer some points and put the answers at their places among the outputs."""
    asked: Any = wp.array(points, dtype=wp.vec2d, device=terrain.device)
    answers: list[Any] = [
        wp.empty(len(points), dtype=array.dtype, device=terrain.device) for array in outputs
    ]
    _launch(terrain, call, asked, answers)
    for array, part in zip(outputs, answers, strict=True):
        host = array.numpy()
        host[places] = part.numpy()
        if terrain.device.is_cuda:
            array.assign(host)


def _complete(
    terrain: Terrain, call: Call, asked: Any, level: int, wait: bool, outputs: list[Any]
) -> None:
    """Refuse NaN, bring in what was missing if the caller waits, and count."""
    state = outputs[-1].numpy()
    seen = int(np.bitwise_or.reduce(state)) if state.size else 0
    if seen & NOT_A_NUMBER:
        bad = int(np.flatnonzero(state & NOT_A_NUMBER)[0])
        raise InputError(f"points[{bad}] must be finite, got {tuple(asked.numpy()[bad].tolist())}")
    if seen & COARSER and wait:
        # What the first pass read was used before what is brought in now.
        terrain.cache.note_used()
        late = np.flatnonzero(state & COARSER)
        points = asked.numpy()[late]
        # As many blocks at a time as the pool holds.
        for part, blocks in _groups(terrain, points, level):
            terrain.cache.hold(blocks)
            _answer_some(terrain, call, points[part], late[part], outputs)
        state = outputs[-1].numpy()
    if seen:
        _count(terrain, state)
    used = terrain.cache.note_used()
    if seen & COARSER and not wait:
        terrain.cache.note_fallback(used, level)


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
    cache = terrain.cache
    first = start = fine = 0
    for i, (row0, row1, col0, col1) in enumerate(ranges.tolist()):
        new = [Block(level, r, c) for r in range(row0, row1 + 1) for c in range(col0, col1 + 1)]
        added = [key for key in new if key not in blocks]
        detail = sum(cache.detail_count(key) for key in added)
        full = len(blocks) + len(added) > cache.capacity or fine + detail > cache.detail_room
        if blocks and full:
            yield order[start:first], list(blocks)
            blocks, start, fine = {}, first, 0
            detail = sum(cache.detail_count(key) for key in new)
        blocks.update(dict.fromkeys(new))
        fine += detail
        first = int(ends[i])
    yield order[start:first], list(blocks)


def level_lattice(grid: Grid, level: int) -> Any:
    """One level's posts as the quick kernel takes them."""
    scale = float(1 << level)
    lattice: Any = LevelLattice()
    lattice.x = grid.x
    lattice.y = grid.y
    lattice.z = grid.datum
    lattice.spacing = grid.spacing * scale
    lattice.west = grid.col / scale
    lattice.east = (grid.col + grid.cols - 1) / scale
    lattice.south = grid.row / scale
    lattice.north = (grid.row + grid.rows - 1) / scale
    lattice.level = level
    lattice.detail = -1
    return lattice


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
