"""A triangle of the surface and the height on it.

A cell's two triangles share the diagonal from (x-, y-) to (x+, y+). Inside a cell at fractions
``u`` along x and ``v`` along y the surface is the walk from the near post to the far one, first
along the axis with the larger fraction (Kuhn's simplex interpolation)::

    height = h00 + (mid - h00) * max(u, v) + (h11 - mid) * min(u, v)

where ``mid`` is the post at (x+, y-) if ``u >= v``, else the one at (x-, y+). Differences are taken
as 64-bit integers, so they are exact, and everything after them is float64.
"""

import warp as wp

_HOLE = wp.constant(-(2**31))
_IN_HOLE = wp.constant(2)


@wp.struct
class Facet:
    """The triangle under a point, at the level that answered."""

    height: wp.float64
    """Height of the surface at the point [counts]; 0 in a hole."""
    du: wp.float64
    """Rise along x over one cell of its level [counts]; a triangle of the detail is shorter."""
    dv: wp.float64
    """Rise along y over one cell of its level [counts]."""
    level: int
    """Level of the triangle; 0 for one of the detail."""
    layer: int
    """Layer that holds the cell's (x-, y-) post."""
    state: int
    """0, or ``IN_HOLE`` and ``COARSER`` added up."""


@wp.func
def plane_of(
    near: int,
    mid: int,
    far: int,
    right: int,
    larger: wp.float64,
    smaller: wp.float64,
) -> Facet:
    """The plane through a triangle's posts at ``larger`` along its first leg and ``smaller`` on.

    ``right`` is 1 for the triangle of (x+, y-), whose first leg runs along x. Level and layer are
    the caller's to fill in.
    """
    facet = Facet()
    if near == _HOLE or mid == _HOLE or far == _HOLE:
        facet.state = _IN_HOLE
    else:
        first = wp.float64(wp.int64(mid) - wp.int64(near))
        second = wp.float64(wp.int64(far) - wp.int64(mid))
        facet.height = wp.float64(near) + (first * larger + second * smaller)
        facet.du = wp.where(right == 1, first, second)
        facet.dv = wp.where(right == 1, second, first)
    return facet


@wp.func
def facet_of(
    near: int, mid: int, far: int, level: int, layer: int, u: wp.float64, v: wp.float64
) -> Facet:
    """The triangle under a point of its cell, evaluated there."""
    # wp.max and wp.min also look for NaN, which is refused before it comes here.
    larger = wp.where(u >= v, u, v)
    smaller = wp.where(u >= v, v, u)
    facet = plane_of(near, mid, far, wp.where(u >= v, 1, 0), larger, smaller)
    facet.level = level
    facet.layer = layer
    return facet


@wp.func
def normal_of(facet: Facet, spacing: wp.float64) -> wp.vec3d:
    """Upward unit normal of a facet; ``spacing`` is level 0's [m]."""
    scale = wp.float64(1.0e-5) / (spacing * wp.float64(1 << facet.level))
    return wp.normalize(wp.vec3d(-facet.du * scale, -facet.dv * scale, wp.float64(1.0)))
