"""The same heights twice: as a base with detail, and as a base that is simply finer."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.counts import HOLE, Counts
from terrasim.deform.patch import Patch, apply_patch
from terrasim.grid import Block, Grid
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

NO_GROUND = -(2**63)


def base_between(base: Counts, factor: int) -> npt.NDArray[np.int64]:
    """The base's surface at all detail posts [counts / factor]; the smallest int64 in holes."""
    rows, cols = base.shape
    row = np.arange((rows - 1) * factor + 1)[:, None]
    col = np.arange((cols - 1) * factor + 1)[None, :]
    r, c = np.minimum(row // factor, rows - 2), np.minimum(col // factor, cols - 2)
    i, j = row - r * factor, col - c * factor
    larger, smaller = np.maximum(i, j), np.minimum(i, j)
    mid = np.where(j >= i, base[r, c + 1], base[r + 1, c])
    total = np.zeros(mid.shape, np.int64)
    hole = np.zeros(mid.shape, np.bool_)
    for posts, weight in (
        (base[r, c], factor - larger),
        (mid, larger - smaller),
        (base[r + 1, c + 1], smaller),
    ):
        total += posts.astype(np.int64) * weight
        hole |= (posts == HOLE) & (weight > 0)
    total[hole] = NO_GROUND
    return total


def put_detail(terrain: Terrain, posts: Counts, row: int = 0, col: int = 0) -> None:
    """Make these the differences of a rectangle of detail posts, the first of them given."""
    cache = terrain.cache
    rows, cols = posts.shape
    for r in range(row >> BLOCK_SHIFT, ((row + rows - 1) >> BLOCK_SHIFT) + 1):
        for c in range(col >> BLOCK_SHIFT, ((col + cols - 1) >> BLOCK_SHIFT) + 1):
            down, right = r * BLOCK - row, c * BLOCK - col
            top, left = max(down, 0), max(right, 0)
            part = posts[top : down + BLOCK, left : right + BLOCK]
            key = Block(-1, r, c)
            [layer] = cache.hold_details([key])
            now = cache.pool.read(layer)
            i, j = top - down, left - right
            now[i : i + part.shape[0], j : j + part.shape[1]] = part
            cache.pool.write(layer, now, 0)
            cache.edited(key, int(now.min()), int(now.max()), 0)


def dense_ground(dense: Counts, spacing: float) -> Terrain:
    """Posts as a base."""
    return Terrain(ArraySource(dense, Grid(dense.shape[0], dense.shape[1], spacing)))


def detailed_ground(
    dense: Counts, factor: int, spacing: float, row: int = 0, col: int = 0, **options: Any
) -> Terrain:
    """Every ``factor``-th post as a base and the rest as detail; first post at a block's first."""
    base = np.ascontiguousarray(dense[::factor, ::factor])
    grid = Grid(base.shape[0], base.shape[1], spacing, row=row, col=col)
    terrain = Terrain(ArraySource(base, grid), detail_factor=factor, **options)
    total = base_between(base, factor)
    ground = (total != NO_GROUND) & (dense != HOLE)
    difference = dense.astype(np.int64) * factor - np.where(ground, total, 0)
    put_detail(terrain, np.where(ground, difference, 0).astype(np.int32))
    return terrain


def rough_ground(
    factor: int, rows: int = 300, cols: int = 330, *, holes: bool = False, **more: Any
) -> Terrain:
    """Rough ground whose first post lies within a tile of the first block."""
    rng = np.random.default_rng(7)
    counts = rng.integers(-200_000, 200_000, (rows, cols)).astype(np.int32)
    if holes:
        counts[rng.random(counts.shape) < 0.03] = HOLE
    grid = Grid(rows, cols, 0.5, x=1e5, y=-3e5, row=-290, col=-60, datum=40.0)
    return Terrain(ArraySource(counts, grid), detail_factor=factor, **more)


def add_detail(terrain: Terrain, posts: Counts, row: int = 0, col: int = 0) -> None:
    """Add differences; row and column of detail posts from the terrain's first post."""
    first = terrain.detail.posts
    apply_patch(terrain, Patch(first.row0 + row, first.col0 + col, posts, detail=True))


def scatter(terrain: Terrain) -> None:
    """Detail over borders of tiles, blocks and the terrain, and at single posts on edges."""
    rng, factor = np.random.default_rng(8), terrain.detail.factor
    span = terrain.detail.posts
    rows, cols = span.row1 - span.row0, span.col1 - span.col0
    # Post (34, 60) from the first is the corner of four blocks, (34 + 64 n, 60 + 64 m) of tiles.
    for row, col in ((0, 0), (30, 55), (30, 120), (95, 100), (200, 20), (33, 200), (290, 320)):
        high, wide = (
            min(7 * factor, rows - row * factor),
            min(9 * factor, cols - col * factor),
        )
        part = rng.integers(-9_000 * factor, 9_000 * factor, (high, wide)).astype(np.int32)
        add_detail(terrain, part, row * factor, col * factor)
    for row, col in ((98, 124), (162, 188), (98, 70)):
        add_detail(terrain, np.full((1, 1), 7_777, np.int32), row * factor, col * factor)
        add_detail(terrain, np.full((1, 1), 7_777, np.int32), row * factor, col * factor + 1)
