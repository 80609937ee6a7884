"""Ground with detail for tests: writing it through the cache, and its heights worked out apart.

The heights here know nothing of the code under test: every detail post is the base's triangle,
times the factor, plus its difference, in NumPy's whole numbers, and between them lie the triangles
of a grid that is simply finer.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt

from terrasim.counts import HOLE, Counts
from terrasim.grid import Block, Grid
from terrasim.terrain import Terrain

Whole = npt.NDArray[np.int64]
Real = npt.NDArray[np.float64]
NO_GROUND = -(2**62)
"""Stands for a hole among totals."""


def rough(rows: int, cols: int, seed: int, most: int = 100_000) -> Counts:
    """Random heights."""
    found = np.random.default_rng(seed).integers(-most, most + 1, (rows, cols))
    return found.astype(np.int32)


def block_of(seed: int, most: int) -> Counts:
    """Random differences of one detail block."""
    return rough(256, 256, seed, most)


def put(terrain: Terrain, blocks: Mapping[Block, Counts]) -> None:
    """Make detail blocks hold these differences."""
    for key, posts in blocks.items():
        [layer] = terrain.cache.hold_details([key])
        terrain.cache.pool.write(layer, posts, 0)
        terrain.cache.edited(key, int(posts.min()), int(posts.max()), 0)


def cut(first: tuple[int, int], posts: Counts) -> dict[Block, Counts]:
    """A rectangle of differences as detail blocks, zero elsewhere; ``first`` is its first post."""
    row, col = first
    rows, cols = posts.shape
    found = {}
    for r in range(row >> 8, ((row + rows - 1) >> 8) + 1):
        for c in range(col >> 8, ((col + cols - 1) >> 8) + 1):
            # One block's rim all round keeps the slices within the array.
            wide = np.zeros((rows + 512, cols + 512), np.int32)
            wide[256:-256, 256:-256] = posts
            down, right = r * 256 - row + 256, c * 256 - col + 256
            found[Block(-1, r, c)] = wide[down : down + 256, right : right + 256].copy()
    return found


class Fine:
    """A base and its detail as one grid of exact totals [counts / factor]."""

    def __init__(
        self, grid: Grid, posts: Counts, factor: int, blocks: Mapping[Block, Counts]
    ) -> None:
        """Take the posts of the base and the differences."""
        self.grid, self.posts, self.factor, self.blocks = grid, posts, factor, blocks
        self.row0, self.col0 = (grid.row >> 8) << 8, (grid.col >> 8) << 8

    def total(self, row: Whole, col: Whole) -> Whole:
        """Totals at detail posts, numbered as the terrain numbers them."""
        size = self.factor
        r = np.minimum(row // size + self.row0 - self.grid.row, self.grid.rows - 2)
        c = np.minimum(col // size + self.col0 - self.grid.col, self.grid.cols - 2)
        i = row - (r + self.grid.row - self.row0) * size
        j = col - (c + self.grid.col - self.col0) * size
        wide = self.posts.astype(np.int64)
        h00, h10, h01, h11 = wide[r, c], wide[r, c + 1], wide[r + 1, c], wide[r + 1, c + 1]
        lower = size * h00 + (h10 - h00) * j + (h11 - h10) * i
        upper = size * h00 + (h01 - h00) * i + (h11 - h01) * j
        found: Whole = np.where(j >= i, lower, upper) + self.difference(row, col)
        mid = np.where(j >= i, h10, h01)
        hole = ((h00 == HOLE) & (np.maximum(i, j) < size)) | ((mid == HOLE) & (i != j))
        found[hole | ((h11 == HOLE) & (np.minimum(i, j) > 0))] = NO_GROUND
        return found

    def difference(self, row: Whole, col: Whole) -> Whole:
        """The detail at its posts."""
        found = np.zeros(row.shape, np.int64)
        for key, posts in self.blocks.items():
            there = (row >> 8 == key.row) & (col >> 8 == key.col)
            found[there] = posts[row[there] & 255, col[there] & 255]
        return found

    def heights(self, x: Real, y: Real) -> tuple[Real, Real]:
        """Heights [m] and rises along x and y per metre at places [m], on the finer triangles."""
        size, grid = self.factor, self.grid
        u = ((x - grid.x) / grid.spacing - self.col0) * size
        v = ((y - grid.y) / grid.spacing - self.row0) * size
        last_col = (grid.col + grid.cols - 1 - self.col0) * size - 1
        last_row = (grid.row + grid.rows - 1 - self.row0) * size - 1
        col = np.minimum(np.floor(u).astype(np.int64), last_col)
        row = np.minimum(np.floor(v).astype(np.int64), last_row)
        p, q = u - col, v - row
        right = p >= q
        near, far = self.total(row, col), self.total(row + 1, col + 1)
        mid = self.total(np.where(right, row, row + 1), np.where(right, col + 1, col))
        first, second = (mid - near).astype(np.float64), (far - mid).astype(np.float64)
        east, north = np.where(right, first, second), np.where(right, second, first)
        metre = 1e-5 / size
        height = grid.datum + near * metre + (east * p + north * q) * metre
        height[(near == NO_GROUND) | (mid == NO_GROUND) | (far == NO_GROUND)] = np.nan
        return height, np.stack([east, north], axis=1) * (1e-5 / grid.spacing)
