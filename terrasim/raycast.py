"""Rays: where they first meet the surface, exact on its triangles."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.arrays import Kind, kind_of, vectors
from terrasim.errors import InputError
from terrasim.grid import Block
from terrasim.kernels.addressing import BLOCK_SHIFT
from terrasim.kernels.ray import Ray
from terrasim.kernels.raycast import WAITING, Hit, Walk, aim, cast
from terrasim.kernels.surface import COARSER
from terrasim.launch import launch
from terrasim.query import check_level
from terrasim.terrain import Terrain


@dataclass(frozen=True)
class RayHits:
    """Answers of :func:`raycast`, of the kind that was asked with, on the terrain's device."""

    distance: Any
    """Distance along the ray [m], float64, shape ``(count,)``; infinite without a hit."""
    point: Any
    """World place of the hit, float64, shape ``(count, 3)`` (``vec3d`` for Warp); its z is the
    surface's at its x and y. NaN without a hit."""
    normal: Any
    """Upward unit normal of the triangle, float64, shape ``(count, 3)``; 0 without a hit."""
    error: Any
    """Bound of the vertical distance to the level-0 surface [m], float64, shape ``(count,)``."""
    level: Any
    """Level that was hit, uint8, shape ``(count,)``."""
    state: Any
    """0, or the sum of ``COARSER`` 4, ``MISSED`` 16 and ``FROM_BELOW`` 32, uint8, ``(count,)``."""


def raycast(
    terrain: Terrain,
    origins: Any,
    directions: Any,
    *,
    max_distance: float,
    level: int = 0,
    wait: bool = True,
) -> RayHits:
    """Where rays first meet the surface.

    A ray sees the terrain's own area only: one that starts beyond the edge enters there. It may
    start below the ground and meets it from below. Holes let rays through.

    Args:
        terrain: The terrain.
        origins: World starts [m], shape ``(count, 3)``: NumPy, torch or Warp.
        directions: Directions, shape ``(count, 3)``, of any length but 0.
        max_distance: Length of the rays [m].
        level: Level to meet.
        wait: Bring in the blocks along the rays. Otherwise the finest resident level stands in,
            counted as a fallback.

    Returns:
        The hits.

    Raises:
        InputError: If a coordinate is NaN or infinite, a direction is 0, a shape is wrong, there is
            no such level, or ``max_distance`` is not above 0 and finite.
    """
    check_level(terrain.grid, level)
    if not (math.isfinite(max_distance) and max_distance > 0.0):
        raise InputError(f"max_distance must be above 0 m and finite, got {max_distance}")
    start = vectors(origins, 3, terrain.device, "origins")
    way = vectors(directions, 3, terrain.device, "directions")
    count = start.shape[0]
    if way.shape[0] != count:
        raise InputError(f"there are {count} origins but {way.shape[0]} directions")
    _check_finite(start, "origins")
    _check_directions(way)
    rays = wp.zeros(count, dtype=Ray, device=terrain.device)
    hits = wp.zeros(count, dtype=Hit, device=terrain.device)
    launch(
        aim,
        count,
        shared=[terrain.lattice, max_distance],
        items=[start, way, rays, hits],
        device=terrain.device,
        threads=terrain.threads,
    )
    found = _walk(terrain, rays, hits, level, wait)
    return _answers(terrain, found, kind_of(origins))


def _walk(terrain: Terrain, rays: Any, hits: Any, level: int, wait: bool) -> Any:
    """Walk all rays to their ends; returns the hits on the host."""
    walk: Any = Walk()
    walk.level, walk.wait = level, int(wait)
    shared = [terrain.pool, terrain.resident, terrain.error, terrain.lattice, walk, terrain.used]
    launch(
        cast,
        hits.shape[0],
        shared=shared,
        items=[rays, hits],
        device=terrain.device,
        threads=terrain.threads,
    )
    found = hits.numpy()
    while True:
        used = terrain.cache.note_used()
        late = np.flatnonzero(found["state"] == WAITING)
        if late.size == 0:
            break
        state = rays.numpy()
        part, blocks = next(_groups(terrain, state[late], level))
        terrain.cache.hold(blocks)
        some = late[part]
        going: Any = wp.array(state[some], dtype=Ray, device=terrain.device)
        ends: Any = wp.array(found[some], dtype=Hit, device=terrain.device)
        wp.launch(cast, len(some), inputs=[*shared, going, ends], device=terrain.device)
        state[some], found[some] = going.numpy(), ends.numpy()
        rays = wp.array(state, dtype=Ray, device=terrain.device)
    coarser = int(np.count_nonzero(found["state"] & COARSER))
    if coarser:
        terrain.cache.counters.fallbacks += coarser
        terrain.cache.note_fallback(used, level)
    return found


def _groups(
    terrain: Terrain, rays: Any, level: int
) -> Iterator[tuple[npt.NDArray[np.int64], list[Block]]]:
    """The first rays whose cells' blocks fit into the pool together."""
    row, col = rays["at_row"] >> level, rays["at_col"] >> level
    blocks: dict[Block, None] = {}
    last = len(row)
    for i in range(len(row)):
        new = {
            Block(level, int(r) >> BLOCK_SHIFT, int(c) >> BLOCK_SHIFT): None
            for r in (row[i], row[i] + 1)
            for c in (col[i], col[i] + 1)
        }
        if blocks and len(blocks.keys() | new.keys()) > terrain.cache.capacity:
            last = i
            break
        blocks.update(new)
    yield np.arange(last), list(blocks)


def _answers(terrain: Terrain, found: Any, kind: Kind) -> RayHits:
    count = len(found)
    point = np.ascontiguousarray(found["point"]).reshape(count, 3)
    normal = np.ascontiguousarray(found["normal"]).reshape(count, 3)
    arrays = [
        np.ascontiguousarray(found["distance"]),
        point,
        normal,
        np.ascontiguousarray(found["error"]),
        found["level"].astype(np.uint8),
        found["state"].astype(np.uint8),
    ]
    if kind == "numpy":
        return RayHits(*arrays)
    types = (wp.float64, wp.vec3d, wp.vec3d, wp.float64, wp.uint8, wp.uint8)
    on_device: list[Any] = [
        wp.array(array, dtype=dtype, device=terrain.device)
        for array, dtype in zip(arrays, types, strict=True)
    ]
    if kind == "torch":
        on_device = [wp.to_torch(array) for array in on_device]
    return RayHits(*on_device)


def _check_finite(values: Any, name: str) -> npt.NDArray[np.float64]:
    host: npt.NDArray[np.float64] = values.numpy()
    good = np.isfinite(host).all(axis=1)
    if not good.all():
        bad = int(np.flatnonzero(~good)[0])
        raise InputError(f"{name}[{bad}] must be finite, got {tuple(host[bad].tolist())}")
    return host


def _check_directions(values: Any) -> None:
    zero = ~_check_finite(values, "directions").any(axis=1)
    if zero.any():
        bad = int(np.flatnonzero(zero)[0])
        raise InputError(f"directions[{bad}] must not be zero: a ray needs a way to go")
