"""The one surface: the triangulated posts, and the detail where there is any.

A level is resident by blocks; where it is not, the finest level above that is answers. On level 0
the detail is added: base and detail are both linear on a detail cell's triangles, and so is their
sum.
"""

import warp as wp

from terrasim.kernels.addressing import layer_of, offset_in_pool, post_or_absent
from terrasim.kernels.detail import detail_triangle, has_detail
from terrasim.kernels.facet import Facet, facet_of
from terrasim.kernels.lattice import Lattice

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
_IN_HOLE = wp.constant(IN_HOLE)
_COARSER = wp.constant(COARSER)
_NO_SIGN = wp.constant(0x7FFFFFFF)


@wp.func
def fraction(index: int, level: int, offset: wp.float64) -> wp.float64:
    """Where a point of level-0 cell ``index``, ``offset`` into it, lies in its cell of a level."""
    inside = index & ((1 << level) - 1)
    return (wp.float64(inside) + offset) / wp.float64(1 << level)


@wp.func
def with_detail(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    base: Facet,
    row: int,
    col: int,
    u: wp.float64,
    v: wp.float64,
) -> Facet:
    """The facet of the detail at fractions ``u``, ``v`` of a level-0 cell, on its ``base`` facet.

    Where the detail is zero it is the base facet, to the bit.
    """
    if base.state != 0:
        return base
    scale = wp.float64(lattice.factor)
    # The last detail cell of a cell has its upper edge, as on the terrain's edge.
    j = wp.min(int(wp.floor(u * scale)), lattice.factor - 1)
    i = wp.min(int(wp.floor(v * scale)), lattice.factor - 1)
    p = u * scale - wp.float64(j)
    q = v * scale - wp.float64(i)
    right = wp.where(p >= q, 1, 0)
    if i == j:
        # On the base's own diagonal its own side counts, whatever the product's rounding.
        right = wp.where(u >= v, 1, 0)
    detail_row = (row - lattice.row0) * lattice.factor + i
    detail_col = (col - lattice.col0) * lattice.factor + j
    post = detail_triangle(pool, table, lattice, detail_row, detail_col, right)
    first = wp.float64(wp.int64(post[1]) - wp.int64(post[0]))
    second = wp.float64(wp.int64(post[2]) - wp.int64(post[1]))
    along = wp.where(right == 1, first, second)
    across = wp.where(right == 1, second, first)
    facet = base
    facet.height += (wp.float64(post[0]) + (along * p + across * q)) / scale
    facet.du += along
    facet.dv += across
    return facet


@wp.func
def any_facet(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
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
    while found == 0 and level < lattice.levels:
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
            # All detail posts of the triangle lie in the blocks of its three posts.
            if level == 0 and (
                has_detail(table, lattice, near[1])
                or has_detail(table, lattice, mid[1])
                or has_detail(table, lattice, far[1])
            ):
                facet = with_detail(pool, table, lattice, facet, row, col, u, v)
        level += 1
    if facet.level > wanted:
        facet.state += _COARSER
    return facet


@wp.func
def surface_at(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
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
        return any_facet(pool, table, lattice, level, row, col, u, v)
    near = offset_in_pool(layer, r, c)
    mid = (near + wp.where(p >= q, 1, _PITCH)) & _NO_SIGN
    far = (near + _PITCH + 1) & _NO_SIGN
    facet = facet_of(pool[near], pool[mid], pool[far], level, layer, p, q)
    if level == 0 and has_detail(table, lattice, layer):
        return with_detail(pool, table, lattice, facet, row, col, u, v)
    return facet


@wp.func
def detail_facet(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    row: int,
    col: int,
    i: int,
    j: int,
    u: wp.float64,
    v: wp.float64,
) -> Facet:
    """The surface at fractions ``u``, ``v`` of a detail cell, from exact totals.

    The detail cell is row ``i`` and column ``j``, 0 to ``factor - 1``, of those in level-0 cell
    ``(row, col)``. Rises are still those over a level-0 cell [counts]: as many counts / factor as
    over the detail cell. Where level 0 is not resident, a coarser level's facet at that point.
    """
    right = wp.where(u >= v, 1, 0)
    lower = wp.where(j > i or (j == i and right == 1), 1, 0)
    near = post_or_absent(pool, table, 0, row, col)
    mid = post_or_absent(pool, table, 0, row + 1 - lower, col + lower)
    far = post_or_absent(pool, table, 0, row + 1, col + 1)
    scale = wp.float64(lattice.factor)
    if near[1] < 0 or mid[1] < 0 or far[1] < 0:
        x = (wp.float64(j) + u) / scale
        y = (wp.float64(i) + v) / scale
        return any_facet(pool, table, lattice, 0, row, col, x, y)
    facet = Facet()
    facet.layer = near[1]
    if near[0] == _HOLE or mid[0] == _HOLE or far[0] == _HOLE:
        facet.state = _IN_HOLE
        return facet
    detail_row = (row - lattice.row0) * lattice.factor + i
    detail_col = (col - lattice.col0) * lattice.factor + j
    post = detail_triangle(pool, table, lattice, detail_row, detail_col, right)
    leg = wp.int64(mid[0]) - wp.int64(near[0])
    other = wp.int64(far[0]) - wp.int64(mid[0])
    x_rise = wp.where(lower == 1, leg, other)
    y_rise = wp.where(lower == 1, other, leg)
    start = wp.int64(near[0]) * wp.int64(lattice.factor) + wp.int64(post[0])
    start += x_rise * wp.int64(j) + y_rise * wp.int64(i)
    first = wp.int64(post[1]) - wp.int64(post[0])
    second = wp.int64(post[2]) - wp.int64(post[1])
    facet.du = wp.float64(x_rise + wp.where(right == 1, first, second))
    facet.dv = wp.float64(y_rise + wp.where(right == 1, second, first))
    facet.height = (wp.float64(start) + (facet.du * u + facet.dv * v)) / scale
    return facet
