"""Posts of a terrain as they are now, cut from its blocks."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from terrasim.cache.needs import region_blocks
from terrasim.counts import Counts
from terrasim.grid import Block, Grid, Indices, Span
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


def detail_posts(terrain: Terrain, cells: Span) -> Iterator[DetailPosts]:
    """Detail that is not all zero in a rectangle of level-0 cells and on its edges.

    Its blocks are brought in one of level 0 at a time, so call it between steps.

    Args:
        terrain: The terrain.
        cells: Level-0 cells, half-open. What lies off the terrain has no detail.
    """
    detail, cache, grid = terrain.detail, terrain.cache, terrain.grid
    if detail.factor == 1:
        return
    span = detail.posts
    first_row = (cells.row0 - detail.row0) * detail.factor
    first_col = (cells.col0 - detail.col0) * detail.factor
    row0, row1 = max(first_row, span.row0), (cells.row1 - detail.row0) * detail.factor + 1
    col0, col1 = max(first_col, span.col0), (cells.col1 - detail.col0) * detail.factor + 1
    row1, col1 = min(row1, span.row1), min(col1, span.col1)
    posts = Span(cells.row0, cells.row1 + 1, cells.col0, cells.col1 + 1)
    for base in region_blocks(grid, posts, 0):
        # Before its detail is listed: what waits to be done to it may add some.
        cache.hold([base])
        for key in cache.details(base):
            low_row, high_row = max(row0, key.row * BLOCK), min(row1, (key.row + 1) * BLOCK)
            low_col, high_col = max(col0, key.col * BLOCK), min(col1, (key.col + 1) * BLOCK)
            if low_row >= high_row or low_col >= high_col:
                continue
            # The caller may have read something else in between.
            cache.hold([base])
            block = cache.pool.read(cache.layer_of(key))
            part = block[
                low_row - key.row * BLOCK : high_row - key.row * BLOCK,
                low_col - key.col * BLOCK : high_col - key.col * BLOCK,
            ]
            if part.any():
                yield DetailPosts(low_row - first_row, low_col - first_col, part)


def detail_at(terrain: Terrain, cells: Span, rows: Indices, cols: Indices) -> Counts:
    """Detail [counts / factor] at the outer product of two vectors of detail posts.

    Args:
        terrain: The terrain.
        cells: Level-0 cells that the posts lie on.
        rows: Rows of detail posts from the cells' first post.
        cols: Columns likewise.

    Returns:
        Differences, int32, shape ``(len(rows), len(cols))``.
    """
    found = np.zeros((len(rows), len(cols)), np.int32)
    for part in detail_posts(terrain, cells):
        high, wide = part.counts.shape
        r = np.flatnonzero((rows >= part.row) & (rows < part.row + high))
        c = np.flatnonzero((cols >= part.col) & (cols < part.col + wide))
        found[np.ix_(r, c)] = part.counts[np.ix_(rows[r] - part.row, cols[c] - part.col)]
    return found
