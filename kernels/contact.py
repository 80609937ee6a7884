"""Contact of a sphere with the plane of the triangle under its centre.

A ball touches the plane when the vertical clearance ``z - surface - radius * sqrt(1 + slope^2)`` is
nothing; one whose contact is ``vertical``, when ``z - surface - radius`` is. That is linear in its
place on one plane, so in flight the time of an impact is the root of a quadratic. From one plane to
the next the clearance jumps, as ``sqrt(1 + slope^2)`` does: what happens at such an edge is the
greater part of this file.
"""

import warp as wp

from terrasim.kernels.body import Body, Material, Step, beyond, first_zero, outward
from terrasim.kernels.surface import Lattice, surface_at

TOUCH = 1e-9
"""Clearance [m], and speed of it [m/s], below which a ball counts as touching."""
STILL = 1e-12
"""Speed of a ball that has stopped, up to rounding [m/s]."""

_STILL = wp.constant(wp.float64(STILL))
_TOUCH = wp.constant(wp.float64(TOUCH))
_NEVER = wp.constant(wp.float64(1e300))
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_HALF = wp.constant(wp.float64(0.5))
_TWO = wp.constant(wp.float64(2.0))
_QUARTER = wp.constant(wp.float64(0.25))
_COUNT_M = wp.constant(wp.float64(1e-5))
_OFF = wp.constant(1)
_IN_HOLE = wp.constant(2)
_NO_EDGE = wp.constant(-1)
_ACROSS_X = wp.constant(0)
_ACROSS_Y = wp.constant(1)


@wp.struct
class Plane:
    """The plane of a triangle, from its cell's (x-, y-) post."""

    height: wp.float64
    """Height there [counts]."""
    du: wp.float64
    """Rise along x over the cell [counts]."""
    dv: wp.float64
    """Rise along y over the cell [counts]."""
    slope: wp.vec2d
    """Slope along x and y."""
    length: wp.float64
    """Length of the normal whose z is 1."""
    over: wp.float64
    """Height of the centre of a ball that touches it over the plane [radii]."""
    layer: int
    """Layer of the pool that answered."""
    state: int
    """As in ``Facet``, and ``OFF_TERRAIN``."""


@wp.struct
class Motion:
    """How a body moves until something happens."""

    a: wp.vec3d
    """Acceleration [m/s^2]."""
    time: wp.float64
    """In how long it meets its plane, or stops [s]."""
    sticks: int
    """1 if friction holds it once it has stopped."""


@wp.func
def plane_of(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    body: Body,
) -> Plane:
    """The plane of the triangle under a body. Beyond the terrain the edge's height goes on."""
    row = wp.clamp(body.row, lattice.row, lattice.last_row)
    col = wp.clamp(body.col, lattice.col, lattice.last_col)
    # A point within the triangle whose height, made of quarters, is exact.
    u = wp.where(body.side > 0, _HALF, _QUARTER)
    v = wp.where(body.side > 0, _QUARTER, _HALF)
    if body.col != col:
        u = wp.where(body.col > col, _ONE, _ZERO)
    if body.row != row:
        v = wp.where(body.row > row, _ONE, _ZERO)
    facet = surface_at(pool, table, lattice, 0, row, col, u, v)
    plane = Plane()
    plane.layer = facet.layer
    plane.state = facet.state
    if body.col != col or body.row != row:
        plane.state += _OFF
    scale = _ONE / wp.float64(1 << facet.level)
    if body.col == col:
        plane.du = facet.du * scale
    if body.row == row:
        plane.dv = facet.dv * scale
    plane.height = facet.height - (plane.du * u + plane.dv * v)
    rise = _COUNT_M / lattice.spacing
    plane.slope = wp.vec2d(plane.du * rise, plane.dv * rise)
    plane.length = wp.sqrt(_ONE + wp.dot(plane.slope, plane.slope))
    plane.over = plane.length
    return plane


@wp.func
def seated(plane: Plane, upright: int) -> Plane:
    """The plane as balls touch it whose contact is by the height under the centre alone."""
    out = plane
    out.over = wp.where(upright == 1, _ONE, plane.over)
    return out


@wp.func
def resting_z(plane: Plane, body: Body, radius: wp.float64, spacing: wp.float64) -> wp.float64:
    """Height at which the body's centre touches the plane [m above the datum]."""
    counts = plane.height + (plane.du * (body.x / spacing) + plane.dv * (body.y / spacing))
    return counts * _COUNT_M + radius * plane.over


@wp.func
def closing(plane: Plane, v: wp.vec3d) -> wp.float64:
    """Rate of the vertical clearance [m/s]: below 0 towards the plane."""
    return v[2] - (plane.slope[0] * v[0] + plane.slope[1] * v[1])


@wp.func
def normal(plane: Plane) -> wp.vec3d:
    """Upward unit normal."""
    return wp.vec3d(-plane.slope[0], -plane.slope[1], _ONE) / plane.length


@wp.func
def rebound(plane: Plane, v: wp.vec3d, material: Material, step: Step) -> wp.float64:
    """Speed along the normal after an impact.

    A ball that would be back on the ground within the step does not leave it.
    """
    up = -material.restitution * wp.dot(v, normal(plane))
    return wp.where(up < step.calm / plane.length, _ZERO, up)


@wp.func
def strike(plane: Plane, v: wp.vec3d, material: Material, step: Step) -> wp.vec3d:
    """Velocity after an impact: restitution along the normal, Coulomb's friction across it."""
    n = normal(plane)
    down = wp.dot(v, n)
    up = rebound(plane, v, material, step)
    along = v - n * down
    speed = wp.length(along)
    if speed > _ZERO:
        along = along * wp.max(_ZERO, _ONE - material.friction * (up - down) / speed)
    return along + n * up


@wp.func
def hard(plane: Plane, v: wp.vec3d, step: Step) -> int:
    """1 if a ball meets the plane faster than gravity makes it in half the step."""
    return wp.where(-closing(plane, v) > step.calm * plane.length, 1, 0)


@wp.func
def along_edge(plane: Plane, edge: int) -> wp.vec3d:
    """Unit vector along an edge of a triangle, on its plane."""
    x = wp.where(edge == _ACROSS_X, _ZERO, _ONE)
    y = wp.where(edge == _ACROSS_Y, _ZERO, _ONE)
    return wp.normalize(wp.vec3d(x, y, x * plane.slope[0] + y * plane.slope[1]))


@wp.func
def slide(pull: wp.vec3d, most: wp.float64, v: wp.vec3d) -> Motion:
    """Motion under a pull along the ground and a friction of at most ``most`` against the way."""
    motion = Motion()
    motion.time = _NEVER
    strength = wp.length(pull)
    motion.sticks = wp.where(strength <= most, 1, 0)
    speed = wp.length(v)
    if speed > _ZERO:
        motion.a = pull - v * (most / speed)
        braking = -wp.dot(motion.a, v)
        if braking > _ZERO:
            motion.time = speed * speed / braking
    elif motion.sticks == 0:
        motion.a = pull * (_ONE - most / strength)
    return motion


@wp.func
def motion_of(
    body: Body, plane: Plane, material: Material, step: Step, spacing: wp.float64
) -> Motion:
    """How a body moves: along an edge, on its plane, or in flight."""
    motion = Motion()
    motion.time = _NEVER
    if body.rail != _NO_EDGE:
        way = along_edge(plane, body.rail)
        return slide(way * (-step.pull * way[2]), material.friction * body.press, body.v)
    if body.lies == 1:
        n = normal(plane)
        pull = wp.vec3d(n[0] * n[2], n[1] * n[2], n[2] * n[2] - _ONE) * step.pull
        return slide(pull, material.friction * step.pull * n[2], body.v)
    motion.a = wp.vec3d(_ZERO, _ZERO, -step.pull)
    if (plane.state & _IN_HOLE) == 0:
        clear = wp.max(_ZERO, body.z - resting_z(plane, body, material.radius, spacing))
        motion.time = first_zero(clear, closing(plane, body.v), -step.pull)
    return motion


@wp.func
def landed(body: Body, plane: Plane, material: Material, step: Step, spacing: wp.float64) -> Body:
    """The body after it struck its plane if it meets it, and put onto it if it does not rise."""
    out = body
    out.lies = 0
    rest = resting_z(plane, body, material.radius, spacing)
    if (plane.state & _IN_HOLE) != 0 or body.z - rest > _TOUCH:
        return out
    if closing(plane, body.v) < -_TOUCH:
        out.v = strike(plane, body.v, material, step)
        out.impacts += hard(plane, body.v, step)
    rate = closing(plane, out.v)
    if rate <= _TOUCH:
        out.lies = 1
        out.z = rest
        out.v -= normal(plane) * (rate / plane.length)
    return out


@wp.func
def unburied(body: Body, plane: Plane, radius: wp.float64, spacing: wp.float64) -> Body:
    """The body lifted onto the plane if it is under it."""
    out = body
    rest = resting_z(plane, body, radius, spacing)
    if (plane.state & _IN_HOLE) == 0 and body.z < rest:
        out.projected += wp.where(rest - body.z > _TOUCH, 1, 0)
        out.z = rest
    return out


@wp.func
def wedged(body: Body, here: Plane, there: Plane, step: Step) -> bool:
    """Whether a body at an edge lies in the valley of two planes, too slow to leave it.

    Gravity presses it against both: neither could carry it alone.
    """
    a = normal(here)
    b = normal(there)
    both = wp.dot(a, b)
    slow = outward(body, body.edge) <= step.calm
    pressed = b[2] - both * a[2] > _STILL and a[2] - both * b[2] > _STILL
    return body.lies == 1 and slow and pressed


@wp.func
def railed(body: Body, here: Plane, there: Plane, step: Step) -> Body:
    """The body bound to the edge it stands at."""
    out = body
    a = normal(here)
    b = normal(there)
    way = along_edge(here, body.edge)
    out.v = way * wp.dot(way, body.v)
    out.rail = body.edge
    # The sum of the two forces along a and b whose vector sum carries the ball.
    out.press = step.pull * (a[2] + b[2]) / (_ONE + wp.dot(a, b))
    return out


@wp.func
def climb(
    body: Body, ahead: Body, plane: Plane, lift: wp.float64, material: Material, step: Step
) -> Body:
    """The body at an edge whose far plane it already cuts into: ``lift`` takes it out of it.

    It strikes that plane. If it still goes on it is lifted, and pays the height with its speed; one
    that is too slow to is thrown back.
    """
    out = body
    out.rail = _NO_EDGE
    if closing(plane, body.v) < _ZERO:
        out.v = strike(plane, body.v, material, step)
        out.impacts += hard(plane, body.v, step)
    if outward(out, body.edge) <= _ZERO:
        return out
    square = wp.dot(out.v, out.v)
    spare = square - _TWO * step.gravity * lift
    if spare < _ZERO:
        out.v = out.v * -material.restitution
        return out
    ahead.v = out.v * wp.sqrt(spare / square)
    ahead.z += lift
    ahead.impacts = out.impacts
    ahead.projected += 1
    return ahead


@wp.func
def barred(
    body: Body,
    ahead: Body,
    lift: wp.float64,
    here: Plane,
    there: Plane,
    material: Material,
    step: Step,
) -> Body:
    """The body at an edge whose far plane it cuts into by ``lift``; ``ahead`` lies beyond."""
    out = body
    out.rail = _NO_EDGE
    if (here.state & _IN_HOLE) != 0 and lift > material.radius * there.over:
        # Its centre is below the surface: the hole's wall.
        out.v[0] = -material.restitution * body.v[0]
        out.v[1] = -material.restitution * body.v[1]
        out.impacts += 1
        return out
    return climb(body, ahead, there, lift, material, step)


@wp.func
def cross(
    body: Body, here: Plane, there: Plane, material: Material, step: Step, spacing: wp.float64
) -> Body:
    """The body at an edge: in the next triangle, whose plane is ``there``, or kept from it."""
    ahead = beyond(body, body.edge, spacing)
    if (there.state & _IN_HOLE) != 0:
        return ahead
    lift = resting_z(there, ahead, material.radius, spacing) - ahead.z
    if lift >= -_TOUCH and wedged(body, here, there, step):
        return railed(body, here, there, step)
    if lift <= _TOUCH:
        return ahead
    return barred(body, ahead, lift, here, there, material, step)
