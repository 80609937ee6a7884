"""Ground of two kinds under a body: cells of the base, and where there is detail cells of that.

A body's functions know one size of cell. Here stands what changes when the next cell is of another
size: fine ground has ``factor`` by ``factor`` detail cells in each cell of the base.
"""

import warp as wp

from terrasim.kernels.addressing import layer_of
from terrasim.kernels.body import Body, Material, Step, kept
from terrasim.kernels.contact import TOUCH, Plane, barred, plane_of, railed, resting_z, wedged
from terrasim.kernels.detail import fine_at
from terrasim.kernels.lattice import Lattice
from terrasim.kernels.surface import detail_facet

_TOUCH = wp.constant(wp.float64(TOUCH))
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_HALF = wp.constant(wp.float64(0.5))
_TWO = wp.constant(wp.float64(2.0))
_QUARTER = wp.constant(wp.float64(0.25))
_BIT = wp.constant(wp.float64(2.0**-52))
_COUNT_M = wp.constant(wp.float64(1e-5))
_SHIFT = wp.constant(8)
_OFF = wp.constant(1)
_IN_HOLE = wp.constant(2)
_ACROSS_X = wp.constant(0)


@wp.struct
class Footing:
    """The cell of the base under a body, and of what kind it is."""

    row: int
    """Row of the cell of the base. It may lie off the terrain, where the edge goes on."""
    col: int
    """Its column."""
    fine: int
    """1 if it has detail. Then the body's row and column are those of a detail cell within it, from
    0 to ``factor - 1``; else they are the same as here."""
    size: wp.float64
    """Side of the body's cell [m]."""


@wp.func
def finer(ground: Footing, lattice: Lattice) -> Footing:
    """The same cell of the base, divided into detail cells."""
    out = ground
    out.fine = 1
    out.size = lattice.spacing / wp.float64(lattice.factor)
    return out


@wp.func
def footing_of(table: wp.array(dtype=int), lattice: Lattice, row: int, col: int) -> Footing:
    """What a cell of the base is. Where a coarser level stands in, it has no detail."""
    out = Footing()
    out.row = row
    out.col = col
    out.size = lattice.spacing
    r = wp.clamp(row, lattice.row, lattice.last_row)
    c = wp.clamp(col, lattice.col, lattice.last_col)
    for down in range(r >> _SHIFT, ((r + 1) >> _SHIFT) + 1):
        for right in range(c >> _SHIFT, ((c + 1) >> _SHIFT) + 1):
            if layer_of(table, 0, down, right) < 0:
                return out
    if fine_at(table, lattice, r, c) == 1:
        return finer(out, lattice)
    return out


@wp.func
def plane_under(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    body: Body,
    ground: Footing,
) -> Plane:
    """The plane of the triangle under a body. Beyond the terrain the edge's height goes on."""
    if ground.fine == 0:
        return plane_of(pool, table, lattice, body)
    row = wp.clamp(ground.row, lattice.row, lattice.last_row)
    col = wp.clamp(ground.col, lattice.col, lattice.last_col)
    i = body.row
    j = body.col
    u = wp.where(body.side > 0, _HALF, _QUARTER)
    v = wp.where(body.side > 0, _QUARTER, _HALF)
    if ground.col != col:
        u = wp.where(ground.col > col, _ONE, _ZERO)
        j = wp.where(ground.col > col, lattice.factor - 1, 0)
    if ground.row != row:
        v = wp.where(ground.row > row, _ONE, _ZERO)
        i = wp.where(ground.row > row, lattice.factor - 1, 0)
    facet = detail_facet(pool, table, lattice, row, col, i, j, u, v)
    plane = Plane()
    plane.layer = facet.layer
    plane.state = facet.state
    if ground.col != col or ground.row != row:
        plane.state += _OFF
    # Of a detail cell, where the facet's are over a whole one.
    scale = wp.float64(lattice.factor)
    if ground.col == col:
        plane.du = facet.du / scale
    if ground.row == row:
        plane.dv = facet.dv / scale
    plane.height = facet.height - (plane.du * u + plane.dv * v)
    rise = _COUNT_M / ground.size
    plane.slope = wp.vec2d(plane.du * rise, plane.dv * rise)
    plane.length = wp.sqrt(_ONE + wp.dot(plane.slope, plane.slope))
    plane.over = plane.length
    return plane


@wp.func
def part_of(offset: wp.float64, size: wp.float64, factor: int) -> int:
    """Which part of its cell, each ``size`` long, an offset lies in."""
    part = wp.min(int(offset / size), factor - 1)
    # The quotient is rounded: what counts are the bounds of the parts as they are stored.
    if offset < wp.float64(part) * size:
        return part - 1
    if part < factor - 1 and offset >= wp.float64(part + 1) * size:
        return part + 1
    return part


@wp.func
def divided(body: Body, ground: Footing, factor: int) -> Body:
    """A body whose offsets are from its cell's post, in the detail cell under it."""
    out = body
    out.row = part_of(body.y, ground.size, factor)
    out.col = part_of(body.x, ground.size, factor)
    out.x = wp.min(body.x - wp.float64(out.col) * ground.size, ground.size)
    out.y = wp.min(body.y - wp.float64(out.row) * ground.size, ground.size)
    out.side = wp.where(out.x >= out.y, 1, -1)
    return out


@wp.func
def whole(body: Body, ground: Footing) -> Body:
    """A body whose offsets are from a detail cell's post, in its cell of the base."""
    out = body
    out.row = ground.row
    out.col = ground.col
    out.x = wp.float64(body.col) * ground.size + body.x
    out.y = wp.float64(body.row) * ground.size + body.y
    return out


@wp.func
def next_footing(
    table: wp.array(dtype=int), lattice: Lattice, ahead: Body, ground: Footing
) -> Footing:
    """The footing of a body that has come across an edge of its cell on ``ground``."""
    row = ahead.row
    col = ahead.col
    if ground.fine == 1:
        last = lattice.factor - 1
        row = ground.row + wp.where(ahead.row > last, 1, wp.where(ahead.row < 0, -1, 0))
        col = ground.col + wp.where(ahead.col > last, 1, wp.where(ahead.col < 0, -1, 0))
    if row == ground.row and col == ground.col:
        return ground
    return footing_of(table, lattice, row, col)


@wp.func
def carried(ahead: Body, edge: int, last: Footing, ground: Footing, factor: int) -> Body:
    """A body that has come across an edge from ``last``, as its new ``ground`` has it."""
    out = ahead
    if last.fine == ground.fine:
        if ground.fine == 1:
            # The next cell's first detail cell, or its last.
            out.row = ahead.row + (last.row - ground.row) * factor
            out.col = ahead.col + (last.col - ground.col) * factor
        return out
    if ground.fine == 1:
        out = divided(ahead, ground, factor)
    else:
        out = whole(ahead, last)
        out.row = ground.row
        out.col = ground.col
    out.side = ahead.side
    # On the edge it came across, not beside it by rounding.
    if edge == _ACROSS_X:
        out.x = wp.where(ahead.x > _ZERO, ground.size, _ZERO)
        out.y = wp.min(out.y, ground.size)
    else:
        out.x = wp.min(out.x, ground.size)
        out.y = wp.where(ahead.y > _ZERO, ground.size, _ZERO)
    return out


@wp.func
def pass_on(
    body: Body,
    ahead: Body,
    here: Plane,
    there: Plane,
    material: Material,
    step: Step,
    size: wp.float64,
) -> Body:
    """The body at an edge: ``ahead``, in a cell of a ``size`` of its own, or kept from it.

    As :func:`terrasim.kernels.contact.cross`, which knows one size alone.
    """
    if (there.state & _IN_HOLE) != 0:
        return ahead
    lift = resting_z(there, ahead, material.radius, size) - ahead.z
    if lift >= -_TOUCH and wedged(body, here, there, step):
        return railed(body, here, there, step)
    if lift <= _TOUCH:
        return ahead
    return barred(body, ahead, lift, here, there, material, step)


@wp.func
def stored(body: Body, ground: Footing, spacing: wp.float64) -> Body:
    """The body as it is stored: in its cell of the base, such that its triangle comes back.

    Offsets in that cell have fewer bits for the detail cell than the body's own, so what
    :func:`divided` will make of them is looked at. A bit is twice what rounding changes, or more.
    """
    if ground.fine == 0:
        return kept(body, spacing)
    bit = spacing * _BIT
    inside = body
    inside.x = wp.min(body.x, ground.size - _TWO * bit)
    inside.y = wp.min(body.y, ground.size - _TWO * bit)
    out = whole(inside, ground)
    col = wp.float64(body.col) * ground.size
    row = wp.float64(body.row) * ground.size
    x = out.x - col
    y = out.y - row
    if body.side > 0 and x < y:
        out.y = row + wp.max(x - bit, _ZERO)
    if body.side < 0 and x >= y:
        if y > _TWO * bit:
            out.x = col + (y - _TWO * bit)
        else:
            out.y = row + (x + _TWO * bit)
    return out
