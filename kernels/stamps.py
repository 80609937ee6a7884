"""Stamps: the kernels that put them to a row of posts, one after another.

A row is held as whole numbers in float64, which is exact below 2^53; a post without ground is NaN
there and stays it. Each stamp's rise is rounded by itself, so that the order of stamps that are
only added does not matter. Where the loops over a row are plain ones over contiguous numbers the
CPU does several posts at a time.
"""

import warp as wp

from terrasim.kernels.addressing import offset_in_pool
from terrasim.kernels.shapes import GAUSSIAN, crater_at

ADD = 0
DIG = 1
FILL = 2
REPLACE = 3
BLEND = 4

_GAUSSIAN = wp.constant(GAUSSIAN)
_HOLE = wp.constant(-(2**31))
_MOST = wp.constant(wp.float64(2**31 - 1))
_NOT_A_NUMBER = wp.constant(wp.float64(float("nan")))
_MAX = wp.constant(2**31 - 1)
_MASK = wp.constant(255)
_BLOCK = wp.constant(256)
_SHIFT = wp.constant(8)
# Warp counts a negative index from the array's end; it leaves that test out where none can be.
_NO_SIGN = wp.constant(0x7FFFFFFF)


@wp.struct
class Posts:
    """The posts that stamps change: those of level 0, or those of the detail grid."""

    detail: int
    """Whether they are the detail grid's."""
    row: int
    """First row of posts of the terrain."""
    last_row: int
    """Last row."""
    col: int
    """First column."""
    last_col: int
    """Last column."""
    spacing: wp.float64
    """Distance between posts [m]."""
    unit: wp.float64
    """Counts in a metre; negative to take back what was added."""


@wp.struct
class Stamp:
    """One stamp, placed."""

    kind: int
    """Its formula in ``kernels/shapes.py``."""
    mode: int
    """``ADD`` to ``BLEND``."""
    cell_row: int
    """Row of the cell its place lies in."""
    cell_col: int
    """Column of that cell."""
    row0: int
    """First row of posts that it may change, within the terrain."""
    row1: int
    """Last such row."""
    col0: int
    """First such column."""
    col1: int
    """Last such column."""
    across: int
    """Where its columns begin in the array of parts of x."""
    first: int
    """Where its data begin."""
    count: int
    """How long they are."""
    x: wp.float64
    """Its place within its cell, along x [m]."""
    y: wp.float64
    """Its place within its cell, along y [m]."""
    a: wp.float64
    """The four numbers of its shape; ``terrasim.deform.shapes`` says which."""
    b: wp.float64
    c: wp.float64
    d: wp.float64
    base: wp.float64
    """World height that its heights start from [counts above the datum]."""


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
    """Sum of the falls within the terrain [counts]."""
    added: wp.int64
    """Sum of the rises within the terrain [counts]."""
    rose: wp.int64
    """Largest rise of a post [counts], at least 0."""
    fell: wp.int64
    """Largest fall of a post [counts], at least 0."""
    changed: int
    """Posts changed within the terrain."""
    clamped: int
    """Posts that met the end of the range of heights, counted likewise."""
    holes: int
    """Posts without ground that a stamp would have changed, counted likewise."""
    first: int
    """First post of the row that changed; the length of a row if none did."""
    last: int
    """Last post that changed; -1 if none did."""
    lowest: int
    """Lowest count afterwards; the largest int32 if all are holes."""
    highest: int
    """Highest count afterwards; ``HOLE`` if all are holes."""


@wp.func
def part(stamp: Stamp, distance: wp.float64) -> wp.float64:
    """An added gaussian's or crater's part of one coordinate, at a distance along it [m]."""
    if stamp.kind == _GAUSSIAN:
        return wp.exp(distance * distance * stamp.b)
    return distance * distance


@wp.kernel(enable_backward=False)
def parts_of_x(
    # Posts:
    posts: Posts,
    stamps: wp.array(dtype=Stamp),
    # In:
    place: wp.array(dtype=int),
    owner: wp.array(dtype=int),
    # Out:
    across_out: wp.array(dtype=wp.float64),
):
    """Every such stamp's part of x at each column of posts it may change."""
    i = wp.tid()
    stamp = stamps[owner[i]]
    col = stamp.col0 + (place[i] - stamp.across)
    # The difference of the indices is exact wherever the terrain lies.
    across_out[i] = part(stamp, wp.float64(col - stamp.cell_col) * posts.spacing - stamp.x)


@wp.func
def is_hole(value: wp.float64) -> bool:
    """Whether a height of a row, or a difference to one, is that of a hole."""
    # wp.isnan is a call, and no loop with a call in it does several posts at a time.
    return value != value  # noqa: PLR0124


@wp.func
def within(wanted: wp.float64) -> wp.float64:
    """The nearest height that can be counted; a hole stays one."""
    low = wp.where(wanted < -_MOST, -_MOST, wanted)
    return wp.where(low > _MOST, _MOST, low)


@wp.func
def met_end(wanted: wp.float64, got: wp.float64, rise: wp.float64) -> int:
    """1 where a post that should have changed is a hole or met the end of the range."""
    return wp.where(wanted == got, 0, wp.where(rise == wp.float64(0.0), 0, 1))


@wp.func
def moved(before: wp.float64, after: wp.float64) -> wp.int64:
    """How far a post rose [counts]; 0 if it is a hole."""
    step = after - before
    return wp.int64(wp.where(is_hole(step), wp.float64(0.0), step))


@wp.func
def add_gaussian(
    scale: wp.float64,
    across: wp.array(dtype=wp.float64),
    start: int,
    begin: int,
    end: int,
    value: wp.array(dtype=wp.float64),
    met: wp.array(dtype=int),
) -> wp.vec2l:
    """Add a row of a gaussian to posts ``begin`` to ``end``; returns what rose and what fell."""
    added = wp.int64(0)
    removed = wp.int64(0)
    c = int(begin)
    while c <= end:
        rise = wp.rint(scale * across[(start + c) & _NO_SIGN])
        old = value[c & _MASK]
        wanted = old + rise
        new = within(wanted)
        value[c & _MASK] = new
        met[c & _MASK] = met[c & _MASK] | met_end(wanted, new, rise)
        added += wp.max(moved(old, new), wp.int64(0))
        removed += wp.max(moved(new, old), wp.int64(0))
        c += 1
    return wp.vec2l(added, removed)


@wp.func
def add_crater(
    stamp: Stamp,
    unit: wp.float64,
    along: wp.float64,
    across: wp.array(dtype=wp.float64),
    start: int,
    begin: int,
    end: int,
    value: wp.array(dtype=wp.float64),
    met: wp.array(dtype=int),
) -> wp.vec2l:
    """Add a row of a crater to posts ``begin`` to ``end``; returns what rose and what fell."""
    added = wp.int64(0)
    removed = wp.int64(0)
    c = int(begin)
    while c <= end:
        square = across[(start + c) & _NO_SIGN] + along
        height = crater_at(square, stamp.a, stamp.b, stamp.c, stamp.d)[0]
        rise = wp.rint(height * unit)
        old = value[c & _MASK]
        wanted = old + rise
        new = within(wanted)
        value[c & _MASK] = new
        met[c & _MASK] = met[c & _MASK] | met_end(wanted, new, rise)
        added += wp.max(moved(old, new), wp.int64(0))
        removed += wp.max(moved(new, old), wp.int64(0))
        c += 1
    return wp.vec2l(added, removed)


@wp.func
def add_parts(
    posts: Posts,
    stamp: Stamp,
    across: wp.array(dtype=wp.float64),
    post_row: int,
    first_col: int,
    value: wp.array(dtype=wp.float64),
    met: wp.array(dtype=int),
) -> wp.vec2l:
    """Add a gaussian or a crater to a row of posts, whose first column is ``first_col``."""
    along = part(stamp, wp.float64(post_row - stamp.cell_row) * posts.spacing - stamp.y)
    begin = wp.max(0, stamp.col0 - first_col)
    end = wp.min(_MASK, stamp.col1 - first_col)
    start = stamp.across + (first_col - stamp.col0)
    if stamp.kind == _GAUSSIAN:
        scale = stamp.a * posts.unit * along
        return add_gaussian(scale, across, start, begin, end, value, met)
    return add_crater(stamp, posts.unit, along, across, start, begin, end, value, met)


@wp.func
def begin_row(pool: wp.array(dtype=int), start: int, value: wp.array(dtype=wp.float64)):
    """Take up a row of posts."""
    for c in range(_BLOCK):
        old = pool[(start + c) & _NO_SIGN]
        value[c] = wp.where(old == _HOLE, _NOT_A_NUMBER, wp.float64(old))


@wp.func
def end_row(
    pool: wp.array(dtype=int),
    start: int,
    first: int,
    last: int,
    value: wp.array(dtype=wp.float64),
    met: wp.array(dtype=int),
) -> RowTally:
    """Put down posts ``first`` to ``last`` of a row and say what happened to them."""
    removed = wp.int64(0)
    added = wp.int64(0)
    rose = wp.int64(0)
    fell = wp.int64(0)
    changed = int(0)
    clamped = int(0)
    holes = int(0)
    left = int(_BLOCK)
    right = int(-1)
    lowest = int(_MAX)
    highest = int(_HOLE)
    c = int(first)
    while c <= last:
        old = pool[(start + c) & _NO_SIGN]
        exact = value[c & _MASK]
        hole = wp.where(is_hole(exact), 1, 0)
        new = wp.where(hole == 1, old, int(wp.where(hole == 1, wp.float64(0.0), exact)))
        pool[(start + c) & _NO_SIGN] = new
        step = wp.int64(new) - wp.int64(old)
        added += wp.max(step, wp.int64(0))
        removed += wp.max(-step, wp.int64(0))
        rose = wp.max(rose, step)
        fell = wp.max(fell, -step)
        here = wp.where(new == old, 0, 1)
        changed += here
        left = wp.min(left, wp.where(here == 1, c, _BLOCK))
        right = wp.max(right, wp.where(here == 1, c, -1))
        holes += met[c & _MASK] & hole
        clamped += met[c & _MASK] & (1 - hole)
        lowest = wp.min(lowest, wp.where(new == _HOLE, _MAX, new))
        highest = wp.max(highest, new)
        c += 1
    return RowTally(
        removed, added, rose, fell, changed, clamped, holes, left, right, lowest, highest
    )


@wp.func
def repeat_edges(pool: wp.array(dtype=int), start: int, first: int, last: int):
    """Let the posts of a row beyond the terrain's edges repeat those at the edges."""
    for c in range(first):
        pool[start + c] = pool[start + first]
    for c in range(last + 1, _BLOCK):
        pool[start + c] = pool[start + last]


@wp.func
def range_of_row(pool: wp.array(dtype=int), start: int) -> RowTally:
    """The tally of a row that no stamp touches."""
    tally = RowTally()
    lowest = int(_MAX)
    highest = int(_HOLE)
    for c in range(_BLOCK):
        count = pool[(start + c) & _NO_SIGN]
        highest = wp.max(highest, count)
        lowest = wp.min(lowest, wp.where(count == _HOLE, _MAX, count))
    tally.first = _BLOCK
    tally.last = -1
    tally.lowest = lowest
    tally.highest = highest
    return tally


@wp.func
def close_row(
    pool: wp.array(dtype=int),
    posts: Posts,
    work: BlockStamps,
    row: int,
    value: wp.array(dtype=wp.float64),
    met: wp.array(dtype=int),
) -> RowTally:
    """Put down a row of posts; only those within the terrain are counted."""
    start = offset_in_pool(work.layer, row, 0)
    left = posts.col - (work.col << _SHIFT)
    right = posts.last_col - (work.col << _SHIFT)
    first = wp.max(0, left)
    last = wp.min(_MASK, right)
    tally = end_row(pool, start, first, last, value, met)
    if posts.detail == 0:
        repeat_edges(pool, start, first, last)
    post_row = (work.row << _SHIFT) + row
    if post_row < posts.row or post_row > posts.last_row:
        tally.added = wp.int64(0)
        tally.removed = wp.int64(0)
        tally.changed = 0
        tally.clamped = 0
        tally.holes = 0
    return tally


@wp.func
def next_stamp(listed: wp.array(dtype=wp.vec4i), begin: int, end: int, row: int) -> int:
    """The next place in the list with a stamp that may change a row of posts, or ``end``."""
    k = int(begin)
    while k < end and (listed[k][1] > row or listed[k][2] < row):
        k += 1
    return k


@wp.func
def add_to_row(
    pool: wp.array(dtype=int),
    posts: Posts,
    stamps: wp.array(dtype=Stamp),
    across: wp.array(dtype=wp.float64),
    listed: wp.array(dtype=wp.vec4i),
    work: BlockStamps,
    row: int,
    post_row: int,
    begin: int,
) -> RowTally:
    """Add the stamps from place ``begin`` of the list on to a row of posts."""
    value = wp.zeros(shape=(_BLOCK,), dtype=wp.float64)
    met = wp.zeros(shape=(_BLOCK,), dtype=int)
    begin_row(pool, offset_in_pool(work.layer, row, 0), value)
    k = int(begin)
    while k < work.end:
        stamp = stamps[listed[k][0]]
        add_parts(posts, stamp, across, post_row, work.col << _SHIFT, value, met)
        k = next_stamp(listed, k + 1, work.end, post_row)
    return close_row(pool, posts, work, row, value, met)


@wp.kernel(enable_backward=False)
def add_stamps(
    # Terrain:
    pool: wp.array(dtype=int),
    posts: Posts,
    # Stamps:
    stamps: wp.array(dtype=Stamp),
    across: wp.array(dtype=wp.float64),
    blocks: wp.array(dtype=BlockStamps),
    listed: wp.array(dtype=wp.vec4i),
    # In and out: a row of a block each, blocks one after another.
    place: wp.array(dtype=int),
    tally_out: wp.array(dtype=RowTally),
):
    """Add gaussians and craters to one row of posts of one block."""
    i = wp.tid() & _NO_SIGN
    work = blocks[place[i] >> _SHIFT]
    row = place[i] & _MASK
    # Posts beyond the terrain's edge repeat it.
    post_row = wp.clamp((work.row << _SHIFT) + row, posts.row, posts.last_row)
    begin = next_stamp(listed, work.begin, work.end, post_row)
    if begin == work.end:
        tally_out[i] = range_of_row(pool, offset_in_pool(work.layer, row, 0))
    else:
        tally_out[i] = add_to_row(pool, posts, stamps, across, listed, work, row, post_row, begin)
