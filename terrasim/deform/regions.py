"""Where the levels change: rectangles of cells, each over one block of the level below."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

from terrasim.deform.touched import Touched
from terrasim.grid import Grid
from terrasim.kernels.addressing import BLOCK
from terrasim.kernels.propagate import QUADRANT

_SHIFT = QUADRANT.bit_length() - 1


class Region(NamedTuple):
    """A rectangle of a level's cells over which the surface may have changed."""

    row0: int
    """First row of cells."""
    row1: int
    """Last row, inclusive."""
    col0: int
    """First column."""
    col1: int
    """Last column, inclusive."""
    rise: int
    """At least what the surface rose by [counts]."""
    fall: int
    """At least what it fell by [counts]."""


Regions = dict[tuple[int, int], Region]
"""Regions of a level by row and column of the blocks of the level below that they lie over; such a
row of blocks may lie beyond the terrain."""


def first_regions(grid: Grid, touched: Iterable[Touched]) -> Regions:
    """Regions of level 1."""
    add = _Adder(grid, 1)
    for one in touched:
        # A level's post is base and detail rounded: it may move by one count more.
        rise = one.rise + (one.key.level < 0)
        # A post belongs to the cells on both its sides.
        add((one.row0 - 1) >> 1, one.row1 >> 1, (one.col0 - 1) >> 1, one.col1 >> 1, rise, one.fall)
    return add.regions


def next_regions(grid: Grid, level: int, below: Regions) -> Regions:
    """Regions of a level from those of the level below."""
    add = _Adder(grid, level)
    for row0, row1, col0, col1, rise, fall in below.values():
        add(row0 >> 1, row1 >> 1, col0 >> 1, col1 >> 1, rise, fall)
    return add.regions


class _Adder:
    """Collects regions of a level, cut by the blocks below; those over the same one are joined."""

    def __init__(self, grid: Grid, level: int) -> None:
        self._found: dict[tuple[int, int], list[int]] = {}
        span = grid.blocks(level)
        self._rows = _Axis.of(grid.row, grid.rows, level, span.row0, span.row1)
        self._cols = _Axis.of(grid.col, grid.cols, level, span.col0, span.col1)

    @property
    def regions(self) -> Regions:
        """All that was added."""
        return {key: Region(*one) for key, one in self._found.items()}

    def __call__(self, row0: int, row1: int, col0: int, col1: int, rise: int, fall: int) -> None:
        row0, row1 = self._rows.widened(row0, row1)
        col0, col1 = self._cols.widened(col0, col1)
        # A wide stamp comes here several times a block: nothing is made that is not kept.
        parts = [
            (col, max(col0, col << _SHIFT), min(col1, (col << _SHIFT) + QUADRANT - 1))
            for col in range(col0 >> _SHIFT, (col1 >> _SHIFT) + 1)
        ]
        for row in range(row0 >> _SHIFT, (row1 >> _SHIFT) + 1):
            low, high = max(row0, row << _SHIFT), min(row1, (row << _SHIFT) + QUADRANT - 1)
            for col, left, right in parts:
                old = self._found.setdefault((row, col), [low, high, left, right, rise, fall])
                old[0] = min(old[0], low)
                old[1] = max(old[1], high)
                old[2] = min(old[2], left)
                old[3] = max(old[3], right)
                old[4] = max(old[4], rise)
                old[5] = max(old[5], fall)


class _Axis(NamedTuple):
    """One axis of a level."""

    first: int
    """The last cell that begins before the terrain does."""
    last: int
    """The first cell that ends beyond the terrain."""
    low: int
    """First post of the level's blocks."""
    high: int
    """Last post of them."""

    @classmethod
    def of(cls, first: int, count: int, level: int, begin: int, end: int) -> _Axis:
        last = (first + count - 1) >> level
        return cls((first - 1) >> level, last, begin * BLOCK, end * BLOCK - 1)

    def widened(self, first: int, last: int) -> tuple[int, int]:
        """A range of cells; one that meets the terrain's edge goes on to its blocks' end."""
        if self.first < first and last < self.last:
            return first, last
        low = self.low if first <= self.first else first
        return low, self.high if last >= self.last else last
