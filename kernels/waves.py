"""A wave on a rectangle of posts: its displacement and its velocity, stepped in turn.

Each post is pulled towards its four neighbours. Beyond the rectangle's edge the outermost post is
repeated, so that nothing is pulled through an edge: what one post gains its neighbour loses.
Differences are taken before they are summed, in an order that a reflection or a turn by a right
angle leaves the same, so that a symmetric wave stays it to the bit.
"""

import warp as wp

# Warp counts a negative index from the array's end; it leaves that test out where none can be.
_NO_SIGN = wp.constant(0x7FFFFFFF)


@wp.struct
class Rectangle:
    """The posts of a wave, row by row in flat arrays."""

    rows: int
    """Number of rows."""
    cols: int
    """Number of columns."""
    width: int
    """Posts that one thread takes, one after another."""


@wp.func
def flow(
    displacement: wp.array(dtype=wp.float64),
    here: int,
    south: int,
    north: int,
    west: int,
    east: int,
) -> wp.float64:
    """The sum of the differences between a post's neighbours and it [m]."""
    own = displacement[here & _NO_SIGN]
    across = (displacement[west & _NO_SIGN] - own) + (displacement[east & _NO_SIGN] - own)
    along = (displacement[south & _NO_SIGN] - own) + (displacement[north & _NO_SIGN] - own)
    return across + along


@wp.kernel(enable_backward=False)
def kick(
    # Wave:
    rectangle: Rectangle,
    keep: wp.float64,
    pull: wp.float64,
    # In:
    displacement: wp.array(dtype=wp.float64),
    # In and out, by each thread at its own posts:
    velocity: wp.array(dtype=wp.float64),
    # In: row and first column of each run of posts.
    place: wp.array(dtype=wp.vec2i),
):
    """Change velocities: ``keep`` times themselves and ``pull`` times the flow."""
    run = place[wp.tid()]
    start = run[0] * rectangle.cols
    south = wp.max(run[0] - 1, 0) * rectangle.cols
    north = wp.min(run[0] + 1, rectangle.rows - 1) * rectangle.cols
    last = wp.min(run[1] + rectangle.width, rectangle.cols)
    c = int(run[1])
    while c < last:
        west = start + wp.max(c - 1, 0)
        east = start + wp.min(c + 1, rectangle.cols - 1)
        moved = flow(displacement, start + c, south + c, north + c, west, east)
        at = (start + c) & _NO_SIGN
        velocity[at] = keep * velocity[at] + pull * moved
        c += 1


@wp.kernel(enable_backward=False)
def drift(
    # Wave:
    rectangle: Rectangle,
    step: wp.float64,
    # In:
    velocity: wp.array(dtype=wp.float64),
    # In and out, by each thread at its own posts:
    displacement: wp.array(dtype=wp.float64),
    # In: row and first column of each run of posts.
    place: wp.array(dtype=wp.vec2i),
):
    """Move posts by their velocity over a step [s]."""
    run = place[wp.tid()]
    start = run[0] * rectangle.cols
    last = wp.min(run[1] + rectangle.width, rectangle.cols)
    c = int(run[1])
    while c < last:
        at = (start + c) & _NO_SIGN
        displacement[at] = displacement[at] + step * velocity[at]
        c += 1
