"""A row of posts while it is changed: taken up, put down, and what happened to it.

A row is held as whole numbers in float64, which is exact below 2^53; a post without ground is NaN
there and stays it. Where the loops over a row are plain ones over contiguous numbers the CPU does
several posts at a time.
"""

import warp as wp

from terrasim.kernels.addressing import offset_in_pool

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
    layer: int,
    block_row: int,
    block_col: int,
    row: int,
    value: wp.array(dtype=wp.float64),
    met: wp.array(dtype=int),
) -> RowTally:
    """Put down a row of posts; only those within the terrain are counted."""
    start = offset_in_pool(layer, row, 0)
    left = posts.col - (block_col << _SHIFT)
    right = posts.last_col - (block_col << _SHIFT)
    first = wp.max(0, left)
    last = wp.min(_MASK, right)
    tally = end_row(pool, start, first, last, value, met)
    if posts.detail == 0:
        repeat_edges(pool, start, first, last)
    post_row = (block_row << _SHIFT) + row
    if post_row < posts.row or post_row > posts.last_row:
        tally.added = wp.int64(0)
        tally.removed = wp.int64(0)
        tally.changed = 0
        tally.clamped = 0
        tally.holes = 0
    return tally
