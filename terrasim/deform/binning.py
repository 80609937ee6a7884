"""From stamps to the blocks they touch."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.grid import Block, Grid, Indices, Span
from terrasim.kernels.addressing import BLOCK_SHIFT
from terrasim.kernels.stamps import BlockStamps

Records = npt.NDArray[Any]
"""An array of a kernel's structs."""
Group = tuple[list[Block], Records, npt.NDArray[np.int32]]
"""Blocks, their records for the kernel, and the stamps' numbers in the order of the blocks."""


def blank(struct: Any, count: int) -> Records:
    """Records of a kernel's struct, all zero, shape ``(count,)``."""
    return np.zeros(count, dtype=struct.numpy_dtype())


def groups(grid: Grid, records: Records, level: int, most: int) -> Iterator[Group]:
    """Blocks of a level that stamps touch, ``most`` at a time, each with its stamps in order.

    At level 0 a block is touched if one of its posts is, above if one of its cells is: then the
    level's error changes even where its posts do not.

    Args:
        grid: The terrain's grid.
        records: Stamps, ``kernels.stamps.Stamp``, shape ``(count,)``.
        level: Level.
        most: Blocks in a group.

    Yields:
        Blocks in order, ``kernels.stamps.BlockStamps`` records without their layers, and the
        numbers of the stamps they point at, int32.
    """
    span = grid.blocks(level)
    row0, row1 = _touched(records, "row", level, (span.row0, span.row1), (grid.row, grid.rows))
    col0, col1 = _touched(records, "col", level, (span.col0, span.col1), (grid.col, grid.cols))
    wide = col1 - col0 + 1
    count = (row1 - row0 + 1) * wide
    stamp = np.repeat(np.arange(len(records), dtype=np.int64), count)
    within = np.arange(int(count.sum())) - np.repeat(np.cumsum(count) - count, count)
    row = row0[stamp] + within // wide[stamp]
    col = col0[stamp] + within % wide[stamp]
    code = (row - span.row0) * (span.col1 - span.col0) + (col - span.col0)
    # Stable: the stamps of a block stay in order.
    order = np.argsort(code, kind="stable")
    listed = stamp[order].astype(np.int32)
    blocks, begin = np.unique(code[order], return_index=True)
    end = np.append(begin[1:], len(order))
    for i in range(0, len(blocks), most):
        yield _group(
            span, level, blocks[i : i + most], begin[i : i + most], end[i : i + most], listed
        )


def _touched(
    records: Records,
    name: str,
    level: int,
    blocks: tuple[int, int],
    posts: tuple[int, int],
) -> tuple[Indices, Indices]:
    """First and last block along one axis that each stamp touches."""
    low = records[f"{name}0"].astype(np.int64)
    high = records[f"{name}1"].astype(np.int64)
    before = 0 if level == 0 else 1
    first = ((low - before) >> level) >> BLOCK_SHIFT
    last = (high >> level) >> BLOCK_SHIFT
    # Posts beyond an edge repeat it: a stamp that reaches the edge changes all of them.
    first = np.where(low <= posts[0], blocks[0], first)
    last = np.where(high >= posts[0] + posts[1] - 1, blocks[1] - 1, last)
    return np.maximum(first, blocks[0]), np.minimum(last, blocks[1] - 1)


def _group(
    span: Span,
    level: int,
    codes: Indices,
    begin: Indices,
    end: Indices,
    listed: npt.NDArray[np.int32],
) -> Group:
    wide = span.col1 - span.col0
    work = blank(BlockStamps, len(codes))
    work["row"] = codes // wide + span.row0
    work["col"] = codes % wide + span.col0
    work["begin"] = begin - begin[0]
    work["end"] = end - begin[0]
    keys = [
        Block(level, row, col)
        for row, col in zip(work["row"].tolist(), work["col"].tolist(), strict=True)
    ]
    return keys, work, listed[int(begin[0]) : int(end[-1])]
