"""Stamps: what each adds to a post, and the kernel that adds all of them to a row of posts.

What a stamp adds to a post depends on the post's level-0 place alone, in the same arithmetic at
every level, so a post of a coarse level changes exactly as the level-0 post it stands for. It is
split into a part of x, a part of y and what joins the two: a gaussian is a product of
exponentials, and everything round joins two squares.
"""

import warp as wp

from terrasim.kernels.addressing import offset_in_pool
from terrasim.kernels.shapes import GAUSSIAN, round_at
from terrasim.kernels.surface import Lattice

_GAUSSIAN = wp.constant(GAUSSIAN)
_COUNTS = wp.constant(wp.float64(100_000.0))
_HOLE = wp.constant(-(2**31))
_MAX = wp.constant(2**31 - 1)
_MASK = wp.constant(255)
_BLOCK = wp.constant(256)
_SHIFT = wp.constant(8)
# Warp counts a negative index from the array's end; it leaves that test out where none can be.
_NO_SIGN = wp.constant(0x7FFFFFFF)


@wp.struct
class Stamp:
    """One stamp, placed."""

    kind: int
    """Its formula in ``kernels/shapes.py``."""
    cell_row: int
    """Row of the level-0 cell its centre lies in."""
    cell_col: int
    """Column of that cell."""
    row0: int
    """First row of level-0 posts that it may change, within the terrain."""
    row1: int
    """Last such row."""
    col0: int
    """First such column."""
    col1: int
    """Last such column."""
    first: int
    """Where its columns begin in the array of parts of x."""
    x: wp.float64
    """Centre within its cell, along x [m]."""
    y: wp.float64
    """Centre within its cell, along y [m]."""
    a: wp.float64
    """The four numbers of its shape; ``terrasim.deform.stamps`` says which."""
    b: wp.float64
    c: wp.float64
    d: wp.float64


@wp.struct
class BlockStamps:
    """A block to change and where its stamps stand in the list."""

    layer: int
    row: int
    """Row of blocks."""
    col: int
    """Column of blocks."""
    begin: int
    end: int


@wp.struct
class RowTally:
    """What happened to one row of posts of a block."""

    removed: wp.int64
    """Sum of the falls, level 0 within the terrain [counts]."""
    added: wp.int64
    """Sum of the rises, level 0 within the terrain [counts]."""
    error: wp.int64
    """Bound of the row's cells: what the stamps' own levels miss of them [counts]."""
    changed: int
    """Posts changed, level 0 within the terrain."""
    clamped: int
    """Posts that met the end of the range of heights, counted likewise."""
    holes: int
    """Posts without ground that a stamp would have changed, counted likewise."""
    lowest: int
    """Lowest count afterwards; the largest int32 if all are holes."""
    highest: int
    """Highest count afterwards; ``HOLE`` if all are holes."""


@wp.func
def part(stamp: Stamp, distance: wp.float64) -> wp.float64:
    """A stamp's part of one coordinate, at a distance along it [m]."""
    if stamp.kind == _GAUSSIAN:
        return wp.exp(distance * distance * stamp.b)
    return distance * distance


@wp.func
def rise(stamp: Stamp, across: wp.float64, along: wp.float64) -> wp.float64:
    """What a stamp adds where its parts of x and y are these [counts]."""
    if stamp.kind == _GAUSSIAN:
        return stamp.a * along * across * _COUNTS
    return round_at(stamp.kind, across + along, stamp.a, stamp.b, stamp.c, stamp.d)[0] * _COUNTS


@wp.kernel(enable_backward=False)
def parts_of_x(
    # Terrain:
    spacing: wp.float64,
    stamps: wp.array(dtype=Stamp),
    # In:
    place: wp.array(dtype=int),
    owner: wp.array(dtype=int),
    # Out:
    across_out: wp.array(dtype=wp.float64),
):
    """Every stamp's part of x at each column of posts it may change."""
    i = wp.tid()
    stamp = stamps[owner[i]]
    col = stamp.col0 + (place[i] - stamp.first)
    # The difference of the indices is exact wherever the terrain lies.
    across_out[i] = part(stamp, wp.float64(col - stamp.cell_col) * spacing - stamp.x)


@wp.func
def fine(index: int, level: int, first: int, last: int) -> int:
    """Level-0 index of a level's post, moved to the terrain's edge where it lies beyond."""
    return int(wp.clamp(wp.int64(index) << wp.int64(level), wp.int64(first), wp.int64(last)))


@wp.func
def first_post(begin: int, level: int, edge: int, block: int) -> int:
    """First post of a row of a block that a stamp from column ``begin`` on may change.

    A stamp that reaches the terrain's edge changes the posts beyond, which repeat it.
    """
    if begin <= edge:
        return 0
    return wp.max(0, ((begin + ((1 << level) - 1)) >> level) - (block << _SHIFT))


@wp.func
def last_post(end: int, level: int, edge: int, block: int) -> int:
    """Last post of a row of a block, or last cell, that a stamp up to a column may change."""
    if end >= edge:
        return _MASK
    return wp.min(_MASK, (end >> level) - (block << _SHIFT))


@wp.func
def sum_rises(
    lattice: Lattice,
    level: int,
    stamps: wp.array(dtype=Stamp),
    across: wp.array(dtype=wp.float64),
    listed: wp.array(dtype=int),
    work: BlockStamps,
    row: int,
    base: int,
    change: wp.array(dtype=wp.int64),
) -> int:
    """Sum into ``change`` what the stamps add to a row of posts; whether there are any."""
    found = int(0)
    last_col = lattice.last_col + 1
    fine_row = fine((work.row << _SHIFT) + row, level, lattice.row, lattice.last_row + 1)
    for k in range(work.begin, work.end):
        n = listed[k]
        if stamps[n].row0 <= fine_row and fine_row <= stamps[n].row1:
            stamp = stamps[n]
            if found == 0:
                found = 1
                for c in range(_BLOCK):
                    change[(base + c) & _NO_SIGN] = wp.int64(0)
            along = part(stamp, wp.float64(fine_row - stamp.cell_row) * lattice.spacing - stamp.y)
            begin = first_post(stamp.col0, level, lattice.col, work.col)
            end = last_post(stamp.col1, level, last_col, work.col)
            for c in range(begin, end + 1):
                col = fine((work.col << _SHIFT) + c, level, lattice.col, last_col)
                counts = rise(stamp, across[(stamp.first + (col - stamp.col0)) & _NO_SIGN], along)
                # Each stamp is rounded by itself: then their order does not matter.
                at = (base + c) & _NO_SIGN
                change[at] = change[at] + wp.int64(wp.rint(counts))
    return found


@wp.func
def sum_bounds(
    lattice: Lattice,
    level: int,
    stamps: wp.array(dtype=Stamp),
    bound: wp.array(dtype=wp.int64),
    listed: wp.array(dtype=int),
    work: BlockStamps,
    row: int,
    base: int,
    spread: wp.array(dtype=wp.int64),
) -> wp.int64:
    """Largest sum of the bounds of stamps that touch one cell, over a row of cells."""
    worst = wp.int64(0)
    found = int(0)
    index = (work.row << _SHIFT) + row
    low = fine(index, level, lattice.row, lattice.last_row + 1)
    high = fine(index + 1, level, lattice.row, lattice.last_row + 1)
    for k in range(work.begin, work.end):
        n = listed[k]
        if stamps[n].row0 <= high and low <= stamps[n].row1:
            if found == 0:
                found = 1
                for c in range(_BLOCK):
                    spread[(base + c) & _NO_SIGN] = wp.int64(0)
            begin = int(0)
            if stamps[n].col0 > lattice.col:
                begin = wp.max(0, ((stamps[n].col0 - 1) >> level) - (work.col << _SHIFT))
            end = last_post(stamps[n].col1, level, lattice.last_col + 1, work.col)
            for c in range(begin, end + 1):
                at = (base + c) & _NO_SIGN
                total = spread[at] + bound[n]
                spread[at] = total
                worst = wp.max(worst, total)
    return worst


@wp.func
def change_row(
    pool: wp.array(dtype=int),
    lattice: Lattice,
    level: int,
    work: BlockStamps,
    row: int,
    base: int,
    change: wp.array(dtype=wp.int64),
) -> RowTally:
    """Add ``change`` to a row of posts; tally those of level 0 within the terrain."""
    tally = RowTally()
    first = lattice.col - (work.col << _SHIFT)
    last = lattice.last_col + 1 - (work.col << _SHIFT)
    post_row = (work.row << _SHIFT) + row
    if level > 0 or post_row < lattice.row or post_row > lattice.last_row + 1:
        last = -1
    start = offset_in_pool(work.layer, row, 0)
    added = wp.int64(0)
    removed = wp.int64(0)
    for c in range(_BLOCK):
        rise = change[(base + c) & _NO_SIGN]
        if rise != wp.int64(0):
            place = (start + c) & _NO_SIGN
            old = pool[place]
            once = c >= first and c <= last
            if old == _HOLE:
                tally.holes += wp.where(once, 1, 0)
            else:
                wanted = wp.int64(old) + rise
                new = wp.clamp(wanted, wp.int64(-_MAX), wp.int64(_MAX))
                pool[place] = int(new)
                if once:
                    step = new - wp.int64(old)
                    added += wp.max(step, wp.int64(0))
                    removed += wp.max(-step, wp.int64(0))
                    tally.clamped += wp.where(new != wanted, 1, 0)
                    tally.changed += wp.where(step != wp.int64(0), 1, 0)
    tally.added = added
    tally.removed = removed
    return tally


@wp.func
def range_of_row(pool: wp.array(dtype=int), layer: int, row: int) -> wp.vec2i:
    """Lowest and highest count of a row of posts; the largest int32 and ``HOLE`` if none is."""
    start = offset_in_pool(layer, row, 0)
    lowest = int(_MAX)
    highest = int(_HOLE)
    for c in range(_BLOCK):
        count = pool[(start + c) & _NO_SIGN]
        highest = wp.max(highest, count)
        lowest = wp.min(lowest, wp.where(count == _HOLE, _MAX, count))
    return wp.vec2i(lowest, highest)


@wp.kernel(enable_backward=False)
def apply_stamps(
    # Terrain:
    pool: wp.array(dtype=int),
    lattice: Lattice,
    level: int,
    # Stamps:
    stamps: wp.array(dtype=Stamp),
    across: wp.array(dtype=wp.float64),
    bound: wp.array(dtype=wp.int64),
    blocks: wp.array(dtype=BlockStamps),
    listed: wp.array(dtype=int),
    # Scratch, a row of posts for each row:
    change: wp.array(dtype=wp.int64),
    spread: wp.array(dtype=wp.int64),
    # In and out: a row of a block each, blocks one after another.
    place: wp.array(dtype=int),
    tally_out: wp.array(dtype=RowTally),
):
    """Add stamps to one row of posts of one block."""
    i = wp.tid() & _NO_SIGN
    work = blocks[place[i] >> _SHIFT]
    row = place[i] & _MASK
    base = place[i] << _SHIFT
    tally = RowTally()
    if sum_rises(lattice, level, stamps, across, listed, work, row, base, change) == 1:
        tally = change_row(pool, lattice, level, work, row, base, change)
    extent = range_of_row(pool, work.layer, row)
    tally.lowest = extent[0]
    tally.highest = extent[1]
    if level > 0:
        tally.error = sum_bounds(lattice, level, stamps, bound, listed, work, row, base, spread)
    tally_out[i] = tally
