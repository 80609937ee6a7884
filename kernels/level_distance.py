"""How far a row of a level's cells lies from the level below [half counts].

A cell of a level has four posts, which the level below has too, and on its edges and its diagonal
lie three kinds of middle posts that only the level below has. The surface below is linear between
all of these, so the two surfaces are furthest apart at a middle post: half of
``2 * middle - (one end) - (other end)``.
"""

import warp as wp

from terrasim.kernels.rows import posts_from

UNKNOWN = 1 << 40
"""Distance where the level below has a hole in a triangle of the level: it cannot say."""

_HOLE = wp.constant(-(2**31))
_UNKNOWN = wp.constant(wp.int64(UNKNOWN))
_ZERO = wp.constant(wp.int64(0))
_NONE = wp.constant(wp.int64(-1))
_ONE = wp.constant(wp.int64(1))
# Warp counts a negative index from the array's end; it leaves that test out where none can be.
_NO_SIGN = wp.constant(0x7FFFFFFF)


@wp.func
def edge_distance(one: int, middle: int, other: int) -> wp.int64:
    """Distance of a middle post from the line between two posts [half counts]."""
    if one == _HOLE or other == _HOLE:
        return _ZERO
    if middle == _HOLE:
        return _UNKNOWN
    return wp.abs((wp.int64(middle) << _ONE) - (wp.int64(one) + wp.int64(other)))


@wp.func
def plain_distance(
    pool: wp.array(dtype=int), low: int, middle: int, high: int, count: int
) -> wp.int64:
    """Largest distance [half counts] of cells whose posts below lie side by side.

    -1 if one of those is a hole.
    """
    worst = wp.int64(0)
    lowest = int(0)
    bottom_row = posts_from(pool, low)
    middle_row = posts_from(pool, middle)
    top_row = posts_from(pool, high)
    i = int(0)
    while i < count:
        k = i + i
        near = bottom_row[k]
        bottom = bottom_row[k + 1]
        right = bottom_row[k + 2]
        side = middle_row[k]
        centre = middle_row[k + 1]
        above = top_row[k]
        far = top_row[k + 2]
        ends = wp.min(wp.min(near, above), wp.min(right, far))
        lowest = wp.min(wp.min(lowest, ends), wp.min(bottom, wp.min(side, centre)))
        one = wp.int64(near)
        along = (wp.int64(bottom) << _ONE) - (one + wp.int64(right))
        up = (wp.int64(side) << _ONE) - (one + wp.int64(above))
        across = (wp.int64(centre) << _ONE) - (one + wp.int64(far))
        worst = wp.max(worst, wp.max(wp.abs(along), wp.max(wp.abs(up), wp.abs(across))))
        i += 1
    return wp.where(lowest == _HOLE, _NONE, worst)


@wp.func
def largest_distance(
    pool: wp.array(dtype=int),
    low: int,
    middle: int,
    high: int,
    step: int,
    count: int,
    east_low: int,
    east_high: int,
) -> wp.int64:
    """Largest distance [half counts] of a row of cells from its three rows of posts below."""
    worst = wp.int64(0)
    begin = int(0)
    if step == 2:
        worst = plain_distance(pool, low, middle, high, count - 1)
        begin = wp.where(worst < _ZERO, 0, count - 1)
    half = step >> 1
    for c in range(begin, count):
        at = step * c
        near = pool[(low + at) & _NO_SIGN]
        bottom = pool[(low + at + half) & _NO_SIGN]
        side = pool[(middle + at) & _NO_SIGN]
        centre = pool[(middle + at + half) & _NO_SIGN]
        above = pool[(high + at) & _NO_SIGN]
        right = pool[wp.where(c == count - 1, east_low, low + at + step) & _NO_SIGN]
        far = pool[wp.where(c == count - 1, east_high, high + at + step) & _NO_SIGN]
        worst = wp.max(worst, edge_distance(near, bottom, right))
        worst = wp.max(worst, edge_distance(near, side, above))
        worst = wp.max(worst, edge_distance(near, centre, far))
    return worst


@wp.func
def lower_edges(
    pool: wp.array(dtype=int), low: int, step: int, count: int, east_low: int
) -> wp.int64:
    """Largest distance [half counts] over the lower edges of a row of cells."""
    worst = wp.int64(0)
    for c in range(count):
        at = low + step * c
        right = wp.where(c == count - 1, east_low, at + step)
        bottom = pool[(at + (step >> 1)) & _NO_SIGN]
        worst = wp.max(worst, edge_distance(pool[at & _NO_SIGN], bottom, pool[right & _NO_SIGN]))
    return worst
