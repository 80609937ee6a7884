"""What a stamp that only adds would raise each post by, not rounded.

Gaussians and craters take the same path as in ``kernels/stamps.py``: rounded, these are the counts
that applying the stamp adds, to the bit.
"""

import warp as wp

from terrasim.kernels.shapes import CRATER, GAUSSIAN, crater_at, shape_at
from terrasim.kernels.stamps import Posts, Stamp, part

_GAUSSIAN = wp.constant(GAUSSIAN)
_CRATER = wp.constant(CRATER)
_NO_SIGN = wp.constant(0x7FFFFFFF)


@wp.func
def rise_at(
    posts: Posts,
    stamp: Stamp,
    data: wp.array(dtype=wp.float64),
    along: wp.float64,
    dx: wp.float64,
    dy: wp.float64,
) -> wp.float64:
    """Rise of a post [counts]; ``along`` is a gaussian's or crater's part of y."""
    if stamp.kind == _GAUSSIAN:
        return (stamp.a * posts.unit * along) * part(stamp, dx)
    if stamp.kind == _CRATER:
        square = part(stamp, dx) + along
        return crater_at(square, stamp.a, stamp.b, stamp.c, stamp.d)[0] * posts.unit
    found = shape_at(
        stamp.kind, stamp.a, stamp.b, stamp.c, stamp.d, data, stamp.first, stamp.count, dx, dy
    )
    return wp.where(found[1] > wp.float64(0.0), found[0] * posts.unit, wp.float64(0.0))


@wp.kernel(enable_backward=False)
def rises(
    # Posts:
    posts: Posts,
    stamps: wp.array(dtype=Stamp),
    data: wp.array(dtype=wp.float64),
    # Rectangle:
    first_col: int,
    # In: row of posts of each row of the rectangle.
    row: wp.array(dtype=int),
    # Out:
    rise_out: wp.array2d(dtype=wp.float64),
):
    """Rises of one row of a rectangle of posts by the first stamp [counts]; 0 beyond its posts."""
    i = wp.tid() & _NO_SIGN
    stamp = stamps[0]
    if row[i] >= stamp.row0 and row[i] <= stamp.row1:
        dy = wp.float64(row[i] - stamp.cell_row) * posts.spacing - stamp.y
        along = part(stamp, dy)
        c = wp.max(0, stamp.col0 - first_col)
        end = wp.min(rise_out.shape[1] - 1, stamp.col1 - first_col)
        while c <= end:
            dx = wp.float64(first_col + c - stamp.cell_col) * posts.spacing - stamp.x
            rise_out[i, c] = rise_at(posts, stamp, data, along, dx, dy)
            c += 1
