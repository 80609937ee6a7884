"""From stamps to the blocks they touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from terrasim.deform.placing import Records, blank
from terrasim.grid import Block, Indices, Span
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT
from terrasim.kernels.stamps import BlockStamps


@dataclass(frozen=True)
class Group:
    """Blocks that are changed in one launch."""

    keys: list[Block]
    """The blocks."""
    work: Records
    """``kernels.stamps.BlockStamps`` of each, without its layer."""
    listed: npt.NDArray[np.int32]
    """The stamps of one block after another, shape ``(pairs, 4)``: number, first and last row of
    the block that it may change, and where these rows stand in a list of all such rows."""

    @property
    def rows(self) -> int:
        """Rows in that list."""
        if not len(self.listed):
            return 0
        _, first, last, before = self.listed[-1].tolist()
        return int(before + last - first + 1)


@dataclass(frozen=True)
class Touch:
    """Which stamps touch which blocks of a level."""

    level: int
    """The level."""
    row: Indices
    """Rows of the blocks, each named once, in order."""
    col: Indices
    """Their columns."""
    begin: Indices
    """Where each block's stamps begin in ``stamps``; its last entry is their end."""
    stamps: Indices
    """Numbers of the stamps, those of a block in order."""

    def blocks(self, first: int = 0, last: int | None = None) -> list[Block]:
        """The blocks, or some of them."""
        rows, cols = self.row[first:last].tolist(), self.col[first:last].tolist()
        return [Block(self.level, row, col) for row, col in zip(rows, cols, strict=True)]


def touch(records: Records, level: int, span: Span, factor: int = 1) -> Touch:
    """Find the blocks that stamps touch.

    Args:
        records: Stamps, ``kernels.stamps.Stamp``, shape ``(count,)``.
        level: Level that the stamps' posts are of.
        span: The blocks there are.
        factor: Blocks along a side of the squares that shall stay together: those of detail that
            lie in one block of level 0.
    """
    row0, row1, col0, col1 = (
        records[name].astype(np.int64) >> BLOCK_SHIFT for name in ("row0", "row1", "col0", "col1")
    )
    wide = col1 - col0 + 1
    count = (row1 - row0 + 1) * wide
    stamp = np.repeat(np.arange(len(records), dtype=np.int64), count)
    within = np.arange(len(stamp)) - np.repeat(np.cumsum(count) - count, count)
    row = row0[stamp] + within // wide[stamp]
    col = col0[stamp] + within % wide[stamp]
    square_row, in_row = np.divmod(row - span.row0 // factor * factor, factor)
    square_col, in_col = np.divmod(col - span.col0 // factor * factor, factor)
    squares = (span.col1 - 1) // factor - span.col0 // factor + 1
    code = ((square_row * squares + square_col) * factor + in_row) * factor + in_col
    # Stable: the stamps of a block stay in order.
    order = np.argsort(code, kind="stable")
    _, begin = np.unique(code[order], return_index=True)
    first = order[begin]
    return Touch(level, row[first], col[first], np.append(begin, len(order)), stamp[order])


def group(found: Touch, records: Records, first: int, last: int) -> Group:
    """Touched blocks ``first`` up to before ``last``, each with its stamps in order."""
    begin, end = int(found.begin[first]), int(found.begin[last])
    work = blank(BlockStamps, last - first)
    work["row"], work["col"] = found.row[first:last], found.col[first:last]
    work["begin"] = found.begin[first:last] - begin
    work["end"] = found.begin[first + 1 : last + 1] - begin
    edge = np.repeat(found.row[first:last] * BLOCK, work["end"] - work["begin"])
    numbers = found.stamps[begin:end]
    listed = np.empty((end - begin, 4), dtype=np.int32)
    listed[:, 0] = numbers
    listed[:, 1] = np.maximum(records["row0"][numbers], edge)
    listed[:, 2] = np.minimum(records["row1"][numbers], edge + BLOCK - 1)
    rows = listed[:, 2].astype(np.int64) - listed[:, 1] + 1
    listed[:, 3] = np.cumsum(rows) - rows
    return Group(found.blocks(first, last), work, listed)
