"""The one surface: the triangulated posts, exact in counts.

A cell's two triangles share the diagonal from (x-, y-) to (x+, y+). Inside a cell at fractions
``u`` along x and ``v`` along y the surface is the walk from the near post to the far one, first
along the axis with the larger fraction (Kuhn's simplex interpolation)::

    height = h00 + (mid - h00) * max(u, v) + (h11 - mid) * min(u, v)

where ``mid`` is the post at (x+, y-) if ``u >= v``, else the one at (x-, y+). Differences are taken
as 64-bit integers, so they are exact, and everything after them is float64.
"""

import warp as wp

from terrasim.kernels.addressing import layer_of, offset_in_pool

HOLE = -(2**31)
COUNT_M = 1e-5
"""Height of a count [m]; as ``terrasim.counts`` has it."""

OFF_TERRAIN = 1
"""The point lay beyond the edge and was moved to the nearest edge point."""
IN_HOLE = 2
"""A post of the triangle is a hole: there is no height."""
COARSER = 4
"""The wanted level was not resident: a coarser one answered."""

_HOLE = wp.constant(HOLE)
_SHIFT = wp.constant(8)
_LAST = wp.constant(255)
_PITCH = wp.constant(256)
_OFF = wp.constant(OFF_TERRAIN)
_IN_HOLE = wp.constant(IN_HOLE)
_COARSER = wp.constant(COARSER)
_NO_SIGN = wp.constant(0x7FFFFFFF)


@wp.struct
class Lattice:
    """Placement of a terrain's posts."""

    x: wp.float64
    """World x of column 0 [m]."""
    y: wp.float64
    """World y of row 0 [m]."""
    z: wp.float64
    """World z of count 0 [m]."""
    spacing: wp.float64
    """Distance between level-0 posts [m]."""
    row: int
    """First row of cells."""
    col: int
    """First column of cells."""
    last_row: int
    """Last row of cells."""
    last_col: int
    """Last column of cells."""
    levels: int
    """Number of levels."""


@wp.struct
class Facet:
    """The triangle under a point, at the level that answered."""

    height: wp.float64
    """Height of the surface at the point [counts]; 0 in a hole."""
    du: wp.float64
    """Rise along x over one cell of its level [counts]."""
    dv: wp.float64
    """Rise along y over one cell of its level [counts]."""
    level: int
    """Level of the triangle."""
    layer: int
    """Layer that holds the cell's (x-, y-) post."""
    state: int
    """0, or ``IN_HOLE`` and ``COARSER`` added up."""


@wp.func
def fraction(index: int, level: int, offset: wp.float64) -> wp.float64:
    """Where a point of level-0 cell ``index``, ``offset`` into it, lies in its cell of a level."""
    inside = index & ((1 << level) - 1)
    return (wp.float64(inside) + offset) / wp.float64(1 << level)


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
def post_or_absent(
    pool: wp.array(dtype=int), table: wp.array(dtype=int), level: int, row: int, col: int
) -> wp.vec2i:
    """A post's count and the layer that holds it, -1 where it is not resident."""
    layer = layer_of(table, level, row >> _SHIFT, col >> _SHIFT)
    if layer < 0:
        return wp.vec2i(0, -1)
    return wp.vec2i(pool[offset_in_pool(layer, row, col)], layer)


@wp.func
def any_facet(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    levels: int,
    wanted: int,
    row: int,
    col: int,
    u: wp.float64,
    v: wp.float64,
) -> Facet:
    """The facet where its posts lie in several blocks or are not resident at the wanted level.

    The finest resident level from the wanted one up answers; the top is always there.
    """
    facet = Facet()
    level = int(wanted)
    found = int(0)
    while found == 0 and level < levels:
        p = fraction(col, level, u)
        q = fraction(row, level, v)
        right = wp.where(p >= q, 1, 0)
        r = row >> level
        c = col >> level
        near = post_or_absent(pool, table, level, r, c)
        mid = post_or_absent(pool, table, level, r + 1 - right, c + right)
        far = post_or_absent(pool, table, level, r + 1, c + 1)
        if near[1] >= 0 and mid[1] >= 0 and far[1] >= 0:
            facet = facet_of(near[0], mid[0], far[0], level, near[1], p, q)
            found = 1
        level += 1
    if facet.level > wanted:
        facet.state += _COARSER
    return facet


@wp.func
def surface_at(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    levels: int,
    level: int,
    row: int,
    col: int,
    u: wp.float64,
    v: wp.float64,
) -> Facet:
    """The surface at fractions ``u``, ``v`` of level-0 cell ``(row, col)``.

    Answers at ``level`` where it is resident, else at the finest resident level above it.
    """
    p = u
    q = v
    if level > 0:
        p = fraction(col, level, u)
        q = fraction(row, level, v)
    r = row >> level
    c = col >> level
    layer = layer_of(table, level, r >> _SHIFT, c >> _SHIFT)
    if layer < 0 or (r & _LAST) == _LAST or (c & _LAST) == _LAST:
        return any_facet(pool, table, levels, level, row, col, u, v)
    near = offset_in_pool(layer, r, c)
    mid = (near + wp.where(p >= q, 1, _PITCH)) & _NO_SIGN
    far = (near + _PITCH + 1) & _NO_SIGN
    return facet_of(pool[near], pool[mid], pool[far], level, layer, p, q)


@wp.func
def normal_of(facet: Facet, spacing: wp.float64) -> wp.vec3d:
    """Upward unit normal of a facet; ``spacing`` is level 0's [m]."""
    scale = wp.float64(1.0e-5) / (spacing * wp.float64(1 << facet.level))
    return wp.normalize(wp.vec3d(-facet.du * scale, -facet.dv * scale, wp.float64(1.0)))
