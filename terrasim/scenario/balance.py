"""The ledger's counterpart: what the heights themselves say was added."""

from __future__ import annotations

import numpy as np

from terrasim.counts import HOLE
from terrasim.detail.grid import DETAIL_LEVEL
from terrasim.grid import Block, Span
from terrasim.kernels.addressing import BLOCK
from terrasim.scenario.fingerprint import changed_blocks
from terrasim.sources.source import Source
from terrasim.terrain import Terrain


def height_difference(terrain: Terrain, source: Source, unit: int) -> int:
    """Sum of all heights less what it was, over the posts of the terrain [counts / unit].

    Nothing of the ledger enters: it is read from the ground before and after, block by block.

    Args:
        terrain: The ground now.
        source: The ground before, without detail.
        unit: Parts of a count, as :class:`~terrasim.deform.ledger.Ledger` has it.
    """
    grid, detail = terrain.grid, terrain.detail
    base = Span(grid.row, grid.row + grid.rows, grid.col, grid.col + grid.cols)
    total = 0
    for key in changed_blocks(terrain):
        if key.level == 0:
            now = terrain.ground.block(key).posts.astype(np.int64)
            before = source.block(key).posts.astype(np.int64)
            rise = np.where((now == HOLE) | (before == HOLE), 0, now - before)
            total += unit * int(rise[_inside(key, base)].sum())
        elif key.level == DETAIL_LEVEL:
            counts = terrain.ground.block(key).posts[_inside(key, detail.posts)]
            total += unit // detail.factor**3 * int(counts.sum(dtype=np.int64))
    return total


def _inside(key: Block, span: Span) -> tuple[slice, slice]:
    """The part of a block that lies in a rectangle of posts."""
    row, col = key.row * BLOCK, key.col * BLOCK
    return (
        slice(max(span.row0 - row, 0), max(min(span.row1 - row, BLOCK), 0)),
        slice(max(span.col0 - col, 0), max(min(span.col1 - col, BLOCK), 0)),
    )
