"""What changed at level 0 carried up through the levels: posts, ranges and error bounds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from terrasim.counts import HOLE, MAX_COUNT
from terrasim.grid import Block, Span
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT
from terrasim.output.window import read_window
from terrasim.sources.source import describe
from terrasim.terrain import Terrain


@dataclass(frozen=True)
class Touched:
    """One block in which posts changed."""

    key: Block
    """A block of level 0, or of the detail grid."""
    row0: int
    """First row of level-0 posts in which something changed, within the terrain. For a detail block
    the rectangle of level-0 posts around what changed."""
    row1: int
    """Last such row, inclusive."""
    col0: int
    """First such column."""
    col1: int
    """Last such column, inclusive."""
    rise: int
    """At least what any post rose by [counts, rounded up], not negative."""
    fall: int
    """At least what any post fell by [counts, rounded up], not negative."""


def propagate(terrain: Terrain, touched: Sequence[Touched]) -> None:
    """Carry changes of level 0 up to the top.

    The caller has changed the posts of the blocks of level 0, those beyond the terrain's edge
    included, and has told the cache (``cache.edited``).

    Args:
        terrain: The terrain.
        touched: What changed.

    Raises:
        RunError: If a block cannot be read or written.
    """
    if not touched:
        return
    grid = terrain.grid
    rise, fall = max(one.rise for one in touched), max(one.fall for one in touched)
    for level in range(1, grid.levels):
        span = grid.blocks(level)
        keys = set()
        for one in touched:
            row0 = ((one.row0 - 1) >> level) >> BLOCK_SHIFT if one.row0 > grid.row else span.row0
            col0 = ((one.col0 - 1) >> level) >> BLOCK_SHIFT if one.col0 > grid.col else span.col0
            row1 = (one.row1 >> level) >> BLOCK_SHIFT
            col1 = (one.col1 >> level) >> BLOCK_SHIFT
            if one.row1 >= grid.row + grid.rows - 1:
                row1 = span.row1 - 1
            if one.col1 >= grid.col + grid.cols - 1:
                col1 = span.col1 - 1
            for row in range(max(row0, span.row0), min(row1, span.row1 - 1) + 1):
                for col in range(max(col0, span.col0), min(col1, span.col1 - 1) + 1):
                    keys.add(Block(level, row, col))
        for key in sorted(keys):
            _redo(terrain, key, rise + fall)


def _redo(terrain: Terrain, key: Block, moved: int) -> None:
    """Sample a block anew from the level below."""
    row, col = 2 * key.row * BLOCK, 2 * key.col * BLOCK
    window = Span(row, row + 2 * BLOCK + 1, col, col + 2 * BLOCK + 1)
    below = read_window(terrain, key.level - 1, window)
    child = 0
    span = terrain.grid.blocks(key.level - 1)
    for child_row in range(max(2 * key.row, span.row0), min(2 * key.row + 3, span.row1)):
        for child_col in range(max(2 * key.col, span.col0), min(2 * key.col + 3, span.col1)):
            under = Block(key.level - 1, child_row, child_col)
            terrain.cache.hold([under])
            child = max(child, terrain.cache.describe(under)[2])
    [layer] = terrain.cache.hold([key])
    old = terrain.cache.describe(key)[2]
    distance = _distance(below.astype(np.int64))
    error = old + moved
    if (below != HOLE).all():
        error = min(error, max(old, distance + child))
    error = min(error, MAX_COUNT)
    data = describe(below[:-1:2, :-1:2], error)
    terrain.cache.pool.write(layer, data.posts, error)
    terrain.cache.edited(key, data.lowest, data.highest, error)


def _distance(below: npt.NDArray[np.int64]) -> int:
    """Largest distance [counts, rounded up] of posts from the triangles of every second one."""
    even = below[::2, ::2]
    along = np.abs(2 * below[::2, 1::2] - even[:, :-1] - even[:, 1:])
    up = np.abs(2 * below[1::2, ::2] - even[:-1] - even[1:])
    across = np.abs(2 * below[1::2, 1::2] - even[:-1, :-1] - even[1:, 1:])
    return (max(int(along.max()), int(up.max()), int(across.max())) + 1) >> 1
