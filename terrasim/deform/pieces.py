"""Pieces: what of a block changes over one block of the level below, and groups that fit a pool."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import NamedTuple

from terrasim.deform.regions import Region, Regions
from terrasim.deform.room import Room
from terrasim.grid import Block, Grid
from terrasim.kernels.addressing import BLOCK
from terrasim.kernels.propagate import QUADRANT

MOST = 256
"""Pieces in a launch."""


class Piece(NamedTuple):
    """A region of a block."""

    block: Block
    """The block."""
    below: tuple[Block, Block, Block, Block]
    """The block below it, and the next ones east, north and both; the same again if not needed."""
    place: tuple[int, ...]
    """Fields ``row`` to ``last_col`` of ``kernels.propagate.Piece``."""
    rise: int
    """At least what the surface rose by [counts]."""
    fall: int
    """At least what it fell by [counts]."""
    sample: bool = True
    """Whether to sample its posts."""
    measure: bool = True
    """Whether to compare it with the level below."""

    @property
    def needs(self) -> tuple[Block, ...]:
        """Blocks that must be resident together; some may be named twice."""
        below = self.below if self.measure else self.below[:1]
        return (self.block, *below) if self.sample else below

    def record(self, layers: Mapping[Block, int]) -> tuple[int, ...]:
        """``kernels.propagate.Piece``."""
        own, east, north, corner = self.below if self.measure else self.below[:1] * 4
        return (
            layers[self.block] if self.sample else -1,
            layers[own],
            layers[east],
            layers[north],
            layers[corner],
            *self.place,
            int(self.measure),
        )


def pieces_of(grid: Grid, level: int, regions: Regions) -> list[Piece]:
    """Pieces of a level in the order of their blocks."""
    span = grid.blocks(level - 1)
    rows = {row: _source(row, span.row0, span.row1) for row, _ in regions}
    cols = {col: _source(col, span.col0, span.col1) for _, col in regions}
    above = grid.blocks(level)
    last = (above.row1 * BLOCK - 1, above.col1 * BLOCK - 1)
    return [
        _piece(level, row, col, region, rows[row], cols[col], last)
        for (row, col), region in sorted(regions.items())
    ]


def groups(pieces: list[Piece], room: Room) -> Iterator[list[Piece]]:
    """Pieces of one level that may be in the pool together, in order."""
    if len(pieces) <= MOST and room.holds({key for piece in pieces for key in piece.needs}):
        yield pieces
        return
    group: list[Piece] = []
    held: set[Block] = set()
    for piece in _fitting(pieces, room.capacity, room.top):
        needs = set(piece.needs)
        if group and (len(group) == MOST or not room.holds(held | needs)):
            yield group
            group, held = [], set()
        group.append(piece)
        held |= needs
    if group:
        yield group


def _fitting(pieces: list[Piece], capacity: int, top: int) -> Iterator[Piece]:
    """The pieces; one too large for the pool is measured and sampled apart."""
    for piece in pieces:
        # A block and four below are the most that a piece needs.
        if capacity >= 5 or sum(key.level < top for key in piece.needs) <= capacity:
            yield piece
        else:
            yield piece._replace(sample=False)
            yield piece._replace(measure=False)


class _Source(NamedTuple):
    """Where the posts of a quadrant come from along one axis."""

    own: int
    """Row of blocks below."""
    first: int
    """Row of posts in it of the quadrant's first."""
    step: int
    """From one row of posts to the next."""
    next: int
    """Row of blocks below that the row after the quadrant's last lies in."""
    next_first: int
    """Its row there."""


def _source(quadrant: int, begin: int, end: int) -> _Source:
    """Beyond the terrain all rows repeat the outermost one."""
    own = min(max(quadrant, begin), end - 1)
    after = min(max(quadrant + 1, begin), end - 1)
    first = BLOCK - 1 if quadrant >= end else 0
    next_first = BLOCK - 1 if quadrant + 1 >= end else 0
    return _Source(own, first, 2 if own == quadrant else 0, after, next_first)


def _piece(
    level: int,
    row: int,
    col: int,
    region: Region,
    rows: _Source,
    cols: _Source,
    last: tuple[int, int],
) -> Piece:
    row0, row1, col0, col1, rise, fall = region
    own = north = east = corner = Block(level - 1, rows.own, cols.own)
    # The last cells of a quadrant end on posts of the next block below.
    if col1 % QUADRANT == QUADRANT - 1:
        east = corner = Block(level - 1, rows.own, cols.next)
    if row1 % QUADRANT == QUADRANT - 1:
        north = corner = Block(level - 1, rows.next, cols.own)
        if east is not own:
            corner = Block(level - 1, rows.next, cols.next)
    place = (
        row0 - row * QUADRANT,
        row1 - row0 + 1,
        col0 - col * QUADRANT,
        col1 - col0 + 1,
        ((row & 1) * BLOCK + (col & 1)) * QUADRANT,
        rows.step,
        cols.step,
        rows.first,
        cols.first,
        rows.next_first,
        cols.next_first,
        rows.own,
        cols.own,
        row * QUADRANT,
        col * QUADRANT,
        *last,
    )
    return Piece(Block(level, row >> 1, col >> 1), (own, east, north, corner), place, rise, fall)
