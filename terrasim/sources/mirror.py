"""A terrain without end from one source, by reflecting it at its edges again and again.

The source has ``2^k + 1`` posts each way. Index ``i`` of the mirrored terrain is folded with the
period ``2 P``, ``P = 2^k``: with ``m = i & (2 P - 1)`` it is the source's post ``m`` if ``m <= P``
and ``2 P - m`` otherwise. Nothing is stored and nothing is copied.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from terrasim.counts import HOLE, Counts
from terrasim.errors import InputError
from terrasim.grid import Block, Grid, Indices
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT
from terrasim.sources.error_bound import bound_of, straddles_edge
from terrasim.sources.reflected_error import cell_range, distance, half_cross
from terrasim.sources.source import BlockData, Source, block_indices, describe


@dataclass(frozen=True)
class Mirrored:
    """The mirrored extension of a source to any size.

    Post ``(0, 0)`` is the source's first post and stands where that stands.
    """

    source: Source
    """The terrain that is reflected, ``2^k + 1`` posts each way; ``k`` may differ."""
    rows: int
    """Number of posts along y."""
    cols: int
    """Number of posts along x."""
    row: int = 0
    """Index of the first row of posts, counted from the source's first."""
    col: int = 0
    """Index of the first column of posts, counted from the source's first."""

    def __post_init__(self) -> None:
        """Refuse a source that does not fold, and what cannot be addressed."""
        grid = self.source.grid
        for cells in (grid.rows - 1, grid.cols - 1):
            if cells & (cells - 1):
                raise InputError(
                    f"a terrain of {grid.rows} x {grid.cols} posts cannot be mirrored: it needs a "
                    "power of two plus one each way; resample it first "
                    "(resample_power_of_two)"
                )
        _ = self.grid

    @cached_property
    def grid(self) -> Grid:
        """Placement of the level-0 posts."""
        own = self.source.grid
        return dataclasses.replace(
            own,
            rows=self.rows,
            cols=self.cols,
            x=float(own.post_x(own.col)),
            y=float(own.post_y(own.row)),
            row=self.row,
            col=self.col,
        )

    @property
    def synthetic(self) -> str:
        """The source's own inventions and the extension."""
        own = self.source.grid
        text = f"mirrored extension of {own.rows} x {own.cols} posts"
        return "; ".join(filter(None, (self.source.synthetic, text)))

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        """Heights of the level's posts; see :meth:`terrasim.sources.source.Source.posts`."""
        own = self.source.grid
        row = self.grid.clamp_rows(np.asarray(rows, dtype=np.int64) << level)
        col = self.grid.clamp_cols(np.asarray(cols, dtype=np.int64) << level)
        return _read(
            self.source,
            level,
            own.row + _fold(row, own.rows - 1),
            own.col + _fold(col, own.cols - 1),
        )

    def bound(self, key: Block) -> int:
        """Error of a block's level [counts].

        Reflected once, a cell is split by the other diagonal. The two ways differ by at most
        ``|X| / 2`` in its middle, ``X = h11 - h10 - h01 + h00``, and the fine posts stay the same,
        so that the source's error ``E`` becomes ``E + max |X| / 2`` where a block reflects in one
        direction and stays ``E`` where it does so in both. Levels coarser than the source's own
        are compared with its coarsest once for all. Where the terrain's edge runs through a cell,
        all its heights are within ``E`` of its corners'. Beside holes, whose triangles differ
        between the two splits, the bound is the range of the source's heights.
        """
        if key.level == 0:
            return 0
        if key.level > self._shared:
            return self._beyond(key)
        own = self.source.grid
        rows = _span(key.row, key.level, self.row, self.rows, own.rows - 1)
        cols = _span(key.col, key.level, self.col, self.cols, own.cols - 1)
        error = max(
            bound_of(self.source, Block(key.level, row, col))
            for row in _blocks(own.row, rows, key.level)
            for col in _blocks(own.col, cols, key.level)
        )
        straddles = straddles_edge(self.grid, key)
        if not straddles and len(rows.flips | cols.flips) == 1:
            return error
        posts = self._source_posts(key.level, rows, cols)
        if posts.min() == HOLE:
            return self._range
        if straddles:
            return 2 * error + cell_range(posts, 0)
        return error + half_cross(posts)

    def block(self, key: Block) -> BlockData:
        """One block, ready for the pool."""
        posts = self.posts(key.level, block_indices(key.row), block_indices(key.col))
        return describe(posts, self.bound(key))

    def _source_posts(self, level: int, rows: _Span, cols: _Span) -> Counts:
        """The source's posts of a level at the corners of all cells of a part of it."""
        own = self.source.grid
        return self.source.posts(
            level, _corner_posts(own.row, rows, level), _corner_posts(own.col, cols, level)
        )

    @cached_property
    def _shared(self) -> int:
        """The coarsest level whose cells are, reflected or not, cells of the source."""
        own = self.source.grid
        return min(own.top, *map(_zeros, (own.rows - 1, own.cols - 1, own.row, own.col)))

    @cached_property
    def _range(self) -> int:
        """Range [counts] of the source's level-0 posts: reads all of it, once, beside holes."""
        span = self.source.grid.blocks(0)
        blocks = (
            self.source.block(Block(0, row, col))
            for row in range(span.row0, span.row1)
            for col in range(span.col0, span.col1)
        )
        ends = [(block.lowest, block.highest) for block in blocks if block.lowest != HOLE]
        if not ends:
            return 0
        return max(high for _, high in ends) - min(low for low, _ in ends)

    def _beyond(self, key: Block) -> int:
        """Error of a level coarser than those shared with the source [counts]."""
        errors = self._beyond_errors
        # From the level on at which every post is the source's first, all are alike.
        inside, straddling = errors[min(key.level - self._shared - 1, len(errors) - 1)]
        return straddling if straddles_edge(self.grid, key) else inside

    @cached_property
    def _beyond_errors(self) -> tuple[tuple[int, int], ...]:
        """Errors of the levels above the shared one, and those where an edge runs through cells."""
        own, level = self.source.grid, self._shared
        rows, cols = _Span(0, own.rows - 1, _STRAIGHT), _Span(0, own.cols - 1, _STRAIGHT)
        if (rows.high >> level) * (cols.high >> level) > _LARGEST_TABLE:
            return ((self._range, self._range),)
        posts = self._source_posts(level, rows, cols)
        if posts.min() == HOLE:
            return ((self._range, self._range),)
        error = 0
        if level > 0:
            error = max(
                bound_of(self.source, Block(level, row, col))
                for row in _blocks(own.row, rows, level)
                for col in _blocks(own.col, cols, level)
            )
        last = max(rows.high, cols.high).bit_length() - level
        base = error + half_cross(posts)
        return tuple(
            (base + distance(posts, up), 2 * error + cell_range(posts, up))
            for up in range(1, last + 1)
        )


_LARGEST_TABLE = 1 << 22
"""Posts that are compared at most; more are not read for a bound."""
_STRAIGHT = frozenset({0})
"""Seen as it is, not reflected."""


@dataclass(frozen=True)
class _Span:
    """A part of the source along one axis."""

    low: int
    """First of its level-0 posts, counted from the source's first."""
    high: int
    """Last of them."""
    flips: frozenset[int]
    """Whether it is seen straight (0), reflected (1) or both ways."""


def _fold(index: Indices, period: int) -> Indices:
    """Indices folded into 0 to ``period``, a power of two."""
    rest = index & (2 * period - 1)
    return np.where(rest <= period, rest, 2 * period - rest)


def _span(index: int, level: int, first: int, count: int, period: int) -> _Span:
    """The part of the source that the cells of a row (or column) of blocks show."""
    low, high = (
        min(max((index + end) * BLOCK << level, first), first + count - 1) for end in (0, 1)
    )
    if low == high:
        # Only the terrain's edge: a line of posts, on which the cells' diagonals have no say.
        place = int(_fold(np.array(low), period))
        return _Span(place, place, _STRAIGHT)
    half = low // period
    if half != (high - 1) // period:
        return _Span(0, period, frozenset({0, 1}))
    ends = _fold(np.array([low, high]), period)
    return _Span(int(ends.min()), int(ends.max()), frozenset({half & 1}))


def _corner_posts(origin: int, span: _Span, level: int) -> Indices:
    """Indices of the level's posts around the cells of a part of the source, at least one cell."""
    return np.arange(
        (origin + span.low) >> level, _up(origin + max(span.high, span.low + 1), level) + 1
    )


def _blocks(origin: int, span: _Span, level: int) -> range:
    """Indices of the source's blocks whose cells hold a part of it."""
    last = max(_up(origin + span.high, level) - 1, origin >> level)
    first = min((origin + span.low) >> level, last)
    return range(first >> BLOCK_SHIFT, (last >> BLOCK_SHIFT) + 1)


def _up(index: int, level: int) -> int:
    """A level-0 index in units of a level, rounded up."""
    return -(-index >> level)


def _zeros(number: int) -> int:
    """Binary zeros at the end of a number."""
    return (number & -number).bit_length() - 1 if number else 31


def _read(source: Source, level: int, rows: Indices, cols: Indices) -> Counts:
    """Posts at level-0 indices of a source, from its level where they are that level's posts."""
    level = min(level, source.grid.top)
    counts = np.empty((len(rows), len(cols)), dtype=np.int32)
    for row_level, row_part in _by_level(rows, level):
        for col_level, col_part in _by_level(cols, level):
            at = min(row_level, col_level)
            part = source.posts(at, rows[row_part] >> at, cols[col_part] >> at)
            if len(row_part) == len(rows) and len(col_part) == len(cols):
                return part
            counts[np.ix_(row_part, col_part)] = part
    return counts


def _by_level(indices: Indices, level: int) -> Iterator[tuple[int, Indices]]:
    """The indices that are posts of a level, and the rest, which are read from level 0."""
    aligned = (indices & ((1 << level) - 1)) == 0
    for at, part in ((level, np.flatnonzero(aligned)), (0, np.flatnonzero(~aligned))):
        if len(part) > 0:
            yield at, part
