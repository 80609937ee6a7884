"""Posts of a terrain as they are now, cut from its blocks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from terrasim.counts import Counts
from terrasim.grid import Block, Grid, Span
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT
from terrasim.output.tile_ground import DetailPosts
from terrasim.terrain import Terrain


def read_window(terrain: Terrain, level: int, window: Span) -> Counts:
    """Posts of a level with everything that deformed them.

    Their blocks are brought in, as many at a time as the pool holds, so call it between steps.

    Args:
        terrain: The terrain.
        level: Level.
        window: The level's posts, half-open; those beyond the terrain repeat its edge.

    Returns:
        Counts, shape of the window, int32.
    """
    grid = terrain.grid
    posts = np.empty((window.row1 - window.row0, window.col1 - window.col0), np.int32)
    span = grid.posts(level)
    rows = np.clip(np.arange(window.row0, window.row1), span.row0, span.row1 - 1)
    cols = np.clip(np.arange(window.col0, window.col1), span.col0, span.col1 - 1)
    keys = [
        Block(level, row, col)
        for row in np.unique(rows >> BLOCK_SHIFT).tolist()
        for col in np.unique(cols >> BLOCK_SHIFT).tolist()
    ]
    room = terrain.cache.capacity if level < grid.top else len(keys)
    for first in range(0, len(keys), max(room, 1)):
        part = keys[first : first + max(room, 1)]
        for key, layer in zip(part, terrain.cache.hold(part), strict=True):
            block = terrain.cache.pool.read(layer)
            row_at = np.flatnonzero(rows >> BLOCK_SHIFT == key.row)
            col_at = np.flatnonzero(cols >> BLOCK_SHIFT == key.col)
            inside = np.ix_(rows[row_at] & (BLOCK - 1), cols[col_at] & (BLOCK - 1))
            posts[np.ix_(row_at, col_at)] = block[inside]
    return posts


def level_window(grid: Grid, level: int, cells: Span) -> Span:
    """The level's posts that cover a rectangle of level-0 cells, within the terrain."""
    row0, row1 = max(cells.row0, grid.row), min(cells.row1, grid.row + grid.rows - 1)
    col0, col1 = max(cells.col0, grid.col), min(cells.col1, grid.col + grid.cols - 1)
    up = (1 << level) - 1
    return Span(
        row0 >> level,
        ((row1 + up) >> level) + 1,
        col0 >> level,
        ((col1 + up) >> level) + 1,
    )


def detail_factor(terrain: Terrain) -> int:
    """Detail cells along a base cell's side, 1 without detail."""
    del terrain
    return 1


def detail_posts(terrain: Terrain, cells: Span) -> Iterator[DetailPosts]:
    """Detail that is not all zero in a rectangle of level-0 cells and on its edges."""
    del terrain, cells
    yield from ()
