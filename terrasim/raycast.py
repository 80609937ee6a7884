"""Rays: where they first meet the surface, exact on its triangles."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.arrays import Kind, kind_of, vectors
from terrasim.cache.cache import Cache
from terrasim.errors import InputError
from terrasim.grid import Block
from terrasim.kernels.addressing import BLOCK_SHIFT
from terrasim.kernels.ray import Ray
from terrasim.kernels.ray_cell import WAITING, Hit
from terrasim.kernels.raycast import Walk, aim, cast
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

    A ray sees the terrain's own area only: one that starts beyond the edge enters there, and where
    it enters below the ground it meets no wall. The ground is met from either side; a ray that
    starts on it meets it at once. Holes let rays through. ``COARSER`` says that the ray passed or
    met ground of a coarser level than asked for.

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
    start, way = _asked(terrain, origins, directions)
    count = start.shape[0]
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


def _asked(terrain: Terrain, origins: Any, directions: Any) -> tuple[Any, Any]:
    start = vectors(origins, 3, terrain.device, "origins")
    way = vectors(directions, 3, terrain.device, "directions")
    if way.shape[0] != start.shape[0]:
        raise InputError(f"there are {start.shape[0]} origins but {way.shape[0]} directions")
    _check_finite(start, "origins")
    _check_directions(way)
    return start, way


def _walk(terrain: Terrain, rays: Any, hits: Any, level: int, wait: bool) -> Any:
    """Walk all rays to their ends; returns the hits on the host."""
    _cast(terrain, rays, hits, level, wait)
    used = terrain.cache.note_used()
    found = hits.numpy()
    late = np.flatnonzero(found["state"] == WAITING)
    if late.size:
        state = rays.numpy()
    while late.size:
        part, blocks = _most_waited_for(state[late], level, terrain.cache)
        terrain.cache.hold(blocks)
        some = late[part]
        going: Any = wp.array(state[some], dtype=Ray, device=terrain.device)
        ends: Any = wp.array(found[some], dtype=Hit, device=terrain.device)
        _cast(terrain, going, ends, level, wait)
        terrain.cache.note_used()
        state[some], found[some] = going.numpy(), ends.numpy()
        late = late[found["state"][late] == WAITING]
    coarser = int(np.count_nonzero(found["state"] & COARSER))
    if coarser:
        terrain.cache.counters.fallbacks += coarser
        terrain.cache.note_fallback(used, level)
    return found


def _cast(terrain: Terrain, rays: Any, hits: Any, level: int, wait: bool) -> None:
    """Walk rays until they end or wait for ground."""
    walk: Any = Walk()
    walk.level, walk.wait = level, int(wait)
    # What waits to be done to the ground raises blocks, too.
    terrain.settle()
    highest: Any = wp.array(terrain.cache.highest, dtype=wp.int32, device=terrain.device)
    launch(
        cast,
        rays.shape[0],
        shared=[
            terrain.pool,
            terrain.resident,
            terrain.error,
            highest,
            terrain.lattice,
            walk,
            terrain.used,
        ],
        items=[rays, hits],
        device=terrain.device,
        threads=terrain.threads,
    )


def _most_waited_for(
    rays: Any, level: int, cache: Cache
) -> tuple[npt.NDArray[np.int64], list[Block]]:
    """The blocks that most rays wait for, as many as fit, and which rays can go on with them."""
    row, col = rays["at_row"] >> level, rays["at_col"] >> level
    ends = np.stack([row, row + 1, col, col + 1], axis=1) >> BLOCK_SHIFT
    ranges, which, waiting = np.unique(ends, axis=0, return_inverse=True, return_counts=True)
    blocks: dict[Block, None] = {}
    fine = 0
    ready = np.zeros(len(ranges), dtype=np.bool_)
    for i in np.argsort(-waiting, kind="stable"):
        row0, row1, col0, col1 = ranges[i].tolist()
        new = [Block(level, r, c) for r in range(row0, row1 + 1) for c in range(col0, col1 + 1)]
        added = [key for key in new if key not in blocks]
        detail = sum(cache.detail_count(key) for key in added)
        fits = len(blocks) + len(added) <= cache.capacity and fine + detail <= cache.detail_room
        # What does not fit even alone is for the cache to refuse.
        if fits or not blocks:
            blocks.update(dict.fromkeys(new))
            fine += detail
            ready[i] = True
    return np.flatnonzero(ready[which.reshape(-1)]), list(blocks)


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
