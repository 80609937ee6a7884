"""What a source of heights offers: posts of any level, and blocks with their bounds."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from terrasim.counts import HOLE, Counts
from terrasim.grid import Block, Grid, Indices
from terrasim.kernels.addressing import BLOCK


@dataclass(frozen=True)
class BlockData:
    """A block's posts and what is known of them."""

    posts: Counts
    """Counts, shape ``(BLOCK, BLOCK)``, ``[row, col]``, int32, C order."""
    lowest: int
    """Smallest count of the posts that are no holes; ``HOLE`` if all are."""
    highest: int
    """Largest count of the posts that are no holes; ``HOLE`` if all are."""
    error: int
    """Bound [counts] of the vertical distance between this level's surface and level 0's, over the
    cells whose (x-, y-) post is the block's. 0 at level 0."""


class Source(Protocol):
    """A terrain's heights before anything deformed it. Reading is safe from several threads."""

    @property
    def grid(self) -> Grid:
        """Placement of the level-0 posts."""
        ...

    @property
    def synthetic(self) -> str:
        """What part of the heights is invented, in a few words; empty if none is."""
        ...

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        """Heights of the level's posts at the outer product of two index vectors.

        Level-``l`` post ``(r, c)`` is level-0 post ``(r << l, c << l)``, moved to the terrain's
        edge where it lies beyond it.

        Args:
            level: Level, 0 to ``grid.top``.
            rows: Row indices at that level, int64, any order.
            cols: Column indices at that level, int64, any order.

        Returns:
            Counts, shape ``(len(rows), len(cols))``, int32.
        """
        ...

    def block(self, key: Block) -> BlockData:
        """One block, ready for the pool."""
        ...


def block_indices(index: int) -> Indices:
    """Post indices of a row (or column) of blocks, int64, shape ``(BLOCK,)``."""
    return np.arange(index * BLOCK, (index + 1) * BLOCK, dtype=np.int64)


def describe(posts: Counts, error: int) -> BlockData:
    """Wrap a block's posts with their range; holes do not count."""
    posts = np.ascontiguousarray(posts, dtype=np.int32)
    if posts.min() != HOLE:
        return BlockData(posts, int(posts.min()), int(posts.max()), error)
    ground = posts[posts != HOLE]
    if ground.size == 0:
        return BlockData(posts, HOLE, HOLE, error)
    return BlockData(posts, int(ground.min()), int(ground.max()), error)


def read_block(source: Source, key: Block, error: int) -> BlockData:
    """A block cut from a source's posts."""
    return describe(source.posts(key.level, block_indices(key.row), block_indices(key.col)), error)
