"""A cross-section swept along a polyline: what counts is the distance to the nearest point of it.

So bends are joined without a gap and nothing counts twice. The polyline's segments are the leaves
of a binary tree of boxes, numbered as a heap: 1 is all of them, 2 n and 2 n + 1 are the halves of
n. A place looks only into boxes nearer than what it has found.
"""

import warp as wp

SWEPT_HEAD = 2
"""Numbers before a polyline's points: leaves of its tree, a power of two, and points. After the
points, x and y each, stand the boxes: low x, low y, high x, high y of node 0 (unused), 1, 2..."""

_NOWHERE = wp.constant(wp.float64(1.0e300))


@wp.func
def box_square(
    data: wp.array(dtype=wp.float64), at: int, x: wp.float64, y: wp.float64
) -> wp.float64:
    """Squared distance from a place to a box [m^2]; infinite for the box of nothing."""
    zero = wp.float64(0.0)
    beyond_x = wp.max(zero, wp.max(data[at] - x, x - data[at + 2]))
    beyond_y = wp.max(zero, wp.max(data[at + 1] - y, y - data[at + 3]))
    return beyond_x * beyond_x + beyond_y * beyond_y


@wp.func
def segment_square(
    data: wp.array(dtype=wp.float64),
    at: int,
    x: wp.float64,
    y: wp.float64,
    cut_start: bool,
    cut_end: bool,
) -> wp.float64:
    """Squared distance from a place to a segment [m^2], huge beyond an end that is cut off."""
    along_x = data[at + 2] - data[at]
    along_y = data[at + 3] - data[at + 1]
    from_x = x - data[at]
    from_y = y - data[at + 1]
    t = (from_x * along_x + from_y * along_y) / (along_x * along_x + along_y * along_y)
    if (cut_start and t < wp.float64(0.0)) or (cut_end and t > wp.float64(1.0)):
        return _NOWHERE
    t = wp.clamp(t, wp.float64(0.0), wp.float64(1.0))
    away_x = from_x - t * along_x
    away_y = from_y - t * along_y
    return away_x * away_x + away_y * away_y


@wp.func
def after(node: int) -> int:
    """The node that follows when all below this one is done; 0 after the last."""
    while (node & 1) == 1:
        node = node >> 1
    if node == 0:
        return 0
    return node + 1


@wp.func
def polyline_square(
    data: wp.array(dtype=wp.float64),
    first: int,
    x: wp.float64,
    y: wp.float64,
    within: wp.float64,
    flat: bool,
) -> wp.float64:
    """Squared distance to a polyline [m^2] if it is less than ``within``, else that."""
    leaves = int(data[first])
    segments = int(data[first + 1]) - 1
    points = first + SWEPT_HEAD
    boxes = points + 2 * (segments + 1)
    nearest = within
    node = int(1)
    while node != 0:
        if node < leaves:
            if box_square(data, boxes + 4 * node, x, y) < nearest:
                node = 2 * node
            else:
                node = after(node)
        else:
            one = node - leaves
            if one < segments:
                start = flat and one == 0
                end = flat and one == segments - 1
                square = segment_square(data, points + 2 * one, x, y, start, end)
                nearest = wp.min(nearest, square)
            node = after(node)
    return nearest
