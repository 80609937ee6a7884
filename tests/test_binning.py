"""From stamps to blocks: every block once, its stamps in order, squares of blocks together."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from terrasim.deform.binning import group, touch
from terrasim.deform.placing import Records, blank
from terrasim.grid import Block, Span
from terrasim.kernels.stamps import Stamp

SPAN = Span(-3, 9, -2, 11)


def scattered(count: int) -> Records:
    """Rectangles of posts within the blocks of ``SPAN``."""
    rng = np.random.default_rng(4)
    records = blank(Stamp, count)
    for name, first, last in (("row", -3 * 256, 9 * 256 - 1), ("col", -2 * 256, 11 * 256 - 1)):
        ends = np.sort(rng.integers(first, last + 1, (2, count)), axis=0)
        records[f"{name}0"] = ends[0]
        records[f"{name}1"] = np.minimum(ends[1], ends[0] + 700)
    return records


@pytest.mark.parametrize("factor", [1, 2, 5])
def test_every_block_has_exactly_the_stamps_that_reach_it(factor: int) -> None:
    """In their order, whatever blocks stand together."""
    records = scattered(50)
    found = touch(records, 0, SPAN, factor)
    blocks = found.blocks()
    assert len(set(blocks)) == len(blocks)
    listed = {
        key: found.stamps[found.begin[i] : found.begin[i + 1]].tolist()
        for i, key in enumerate(blocks)
    }
    for row in range(SPAN.row0, SPAN.row1):
        for col in range(SPAN.col0, SPAN.col1):
            reach = (records["row0"] < 256 * row + 256) & (records["row1"] >= 256 * row)
            reach &= (records["col0"] < 256 * col + 256) & (records["col1"] >= 256 * col)
            assert listed.get(Block(0, row, col), []) == np.flatnonzero(reach).tolist()


def test_blocks_of_a_square_stand_together() -> None:
    """Squares are counted from block 0, as those of detail in a block of level 0 are."""
    blocks = touch(scattered(50), -1, SPAN, 3).blocks()
    squares = [(key.row // 3, key.col // 3) for key in blocks]
    changes = sum(one != other for one, other in pairwise(squares))
    assert changes == len(set(squares)) - 1


def test_groups_are_all_blocks_in_parts() -> None:
    """Each stamp's rows are those within its block, and stand one after another."""
    records = scattered(50)
    found = touch(records, 0, SPAN)
    count = len(found.row)
    parts = [group(found, records, i, min(i + 7, count)) for i in range(0, count, 7)]
    assert [key for part in parts for key in part.keys] == found.blocks()
    assert max(len(part.keys) for part in parts) == 7
    for part in parts:
        place = 0
        for key, work in zip(part.keys, part.work, strict=True):
            for number, first, last, before in part.listed[work["begin"] : work["end"]].tolist():
                assert first == max(records["row0"][number], key.row * 256)
                assert last == min(records["row1"][number], key.row * 256 + 255)
                assert before == place
                place += last - first + 1
        assert part.rows == place
