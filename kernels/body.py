"""A body on its way across the triangles: where it leaves one, and where it is after a time.

With a constant acceleration every coordinate is a quadratic in time, so the times at which a centre
leaves its triangle are roots of quadratics. On its way a body knows its triangle by cell and side,
not by its offsets, which rounding may put beyond an edge.
"""

import warp as wp

_NEVER = wp.constant(wp.float64(1e300))
_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_TWO = wp.constant(wp.float64(2.0))
_BIT = wp.constant(wp.float64(2.0**-52))
_NO_EDGE = wp.constant(-1)
_ACROSS_X = wp.constant(0)
_ACROSS_Y = wp.constant(1)
_DIAGONAL = wp.constant(2)


@wp.struct
class Step:
    """One step of time."""

    dt: wp.float64
    """Its length [s]."""
    gravity: wp.float64
    """Downward acceleration [m/s^2]."""
    pull: wp.float64
    """What of it acts between two events [m/s^2]: all, or nothing if it acted before the first."""
    calm: wp.float64
    """Speed after an impact up to which a ball does not leave level ground [m/s]."""
    upright: int
    """1 if a ball touches what is a radius under its centre, whatever the slope there."""


@wp.struct
class Material:
    """What a ball is."""

    radius: wp.float64
    """Radius [m]."""
    restitution: wp.float64
    """Normal speed after an impact over that before."""
    friction: wp.float64
    """Coulomb's coefficient."""


@wp.struct
class Body:
    """A ball on its way."""

    row: int
    """Row of its cell."""
    col: int
    """Column of its cell."""
    side: int
    """Its triangle of the cell: 1 at the (x+, y-) corner, -1 at the (x-, y+) corner."""
    x: wp.float64
    """Centre from the cell's (x-, y-) post [m]."""
    y: wp.float64
    """Likewise along y."""
    z: wp.float64
    """Centre above the datum [m]."""
    v: wp.vec3d
    """Velocity [m/s]."""
    left: wp.float64
    """What is left of the step [s]."""
    edge: int
    """The edge of its triangle that it has come to, or ``_NO_EDGE``."""
    lies: int
    """1 if it touches its plane and does not rise from it."""
    rail: int
    """The edge it slides along, wedged between two planes, or ``_NO_EDGE``."""
    press: wp.float64
    """What those two planes carry of it together, for a kilogram [N]."""
    impacts: int
    """Impacts in this step."""
    projected: int
    """Lifts in this step."""


@wp.struct
class Exit:
    """Where a body leaves its triangle."""

    time: wp.float64
    """In how long [s]."""
    edge: int
    """Across the edge along y or x, or the diagonal."""


@wp.func
def first_zero(q: wp.float64, rate: wp.float64, acceleration: wp.float64) -> wp.float64:
    """When ``q + rate t + acceleration t^2 / 2``, which is at least 0, next falls below 0."""
    square = rate * rate - _TWO * acceleration * q
    if square < _ZERO:
        return _NEVER
    root = wp.sqrt(square)
    # Of the two forms of the same root the one that does not cancel.
    if rate > _ZERO:
        if acceleration < _ZERO:
            return (rate + root) / -acceleration
        return _NEVER
    if root - rate > _ZERO:
        return _TWO * q / (root - rate)
    return wp.where(acceleration < _ZERO, _ZERO, _NEVER)


@wp.func
def loaded(cell: wp.vec2i, offset: wp.vec2d, z: wp.float64, v: wp.vec3d, dt: wp.float64) -> Body:
    """A ball as it is stored; on a diagonal it counts to the triangle that queries take."""
    body = Body()
    body.row = cell[0]
    body.col = cell[1]
    body.x = offset[0]
    body.y = offset[1]
    body.side = wp.where(offset[0] >= offset[1], 1, -1)
    body.z = z
    body.v = v
    body.left = dt
    body.edge = _NO_EDGE
    body.rail = _NO_EDGE
    return body


@wp.func
def leave(body: Body, a: wp.vec3d, spacing: wp.float64) -> Exit:
    """When and where a body leaves its triangle."""
    side = wp.float64(body.side)
    lower = body.side > 0
    out = Exit()
    out.time = _NEVER
    if body.rail != _ACROSS_X:
        to_x = wp.where(lower, spacing - body.x, body.x)
        out.time = first_zero(to_x, -side * body.v[0], -side * a[0])
        out.edge = _ACROSS_X
    if body.rail != _ACROSS_Y:
        to_y = wp.where(lower, body.y, spacing - body.y)
        time = first_zero(to_y, side * body.v[1], side * a[1])
        if time < out.time:
            out.time = time
            out.edge = _ACROSS_Y
    if body.rail != _DIAGONAL:
        # Rounding may have put it beyond the diagonal.
        away = wp.max(_ZERO, side * (body.x - body.y))
        time = first_zero(away, side * (body.v[0] - body.v[1]), side * (a[0] - a[1]))
        if time < out.time:
            out.time = time
            out.edge = _DIAGONAL
    return out


@wp.func
def outward(body: Body, edge: int) -> wp.float64:
    """Rate at which a body goes out across an edge of its triangle."""
    across = body.v[1] - body.v[0]
    if edge == _ACROSS_X:
        across = body.v[0]
    elif edge == _ACROSS_Y:
        across = -body.v[1]
    return wp.float64(body.side) * across


@wp.func
def beyond(body: Body, edge: int, spacing: wp.float64) -> Body:
    """The body in the triangle on the other side of an edge it stands on."""
    out = body
    if edge == _ACROSS_X:
        out.col = body.col + body.side
        out.x = wp.where(body.side > 0, _ZERO, spacing)
    elif edge == _ACROSS_Y:
        out.row = body.row - body.side
        out.y = wp.where(body.side > 0, spacing, _ZERO)
    out.side = -body.side
    out.rail = _NO_EDGE
    return out


@wp.func
def moved(body: Body, a: wp.vec3d, t: wp.float64, spacing: wp.float64) -> Body:
    """The body after a time of constant acceleration within its triangle."""
    out = body
    half = _HALF * t * t
    out.x = wp.clamp(body.x + (body.v[0] * t + a[0] * half), _ZERO, spacing)
    out.y = wp.clamp(body.y + (body.v[1] * t + a[1] * half), _ZERO, spacing)
    out.z = body.z + (body.v[2] * t + a[2] * half)
    out.v = body.v + a * t
    return out


@wp.func
def kept(body: Body, spacing: wp.float64) -> Body:
    """The body within its triangle, by the last bit, as its offsets alone tell it.

    One that lies against a wall would else begin the next step inside the wall.
    """
    out = body
    bit = spacing * _BIT
    out.x = wp.min(body.x, spacing - bit)
    out.y = wp.min(body.y, spacing - bit)
    if body.side > 0 and out.x < out.y:
        out.y = out.x
    if body.side < 0 and out.x >= out.y:
        if out.y > bit:
            out.x = out.y - bit
        else:
            out.y = out.x + bit
    return out
