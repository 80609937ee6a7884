"""Contact of a spinning sphere with the plane of the triangle under its centre.

As ``contact``, with the same impacts, edges and grooves; only friction differs, which goes by the
slip of the contact point and not by the velocity of the centre. A variant without spin has none of
this.
"""

import warp as wp

from terrasim.kernels.body import Body, Material, Step, leave, moved, outward
from terrasim.kernels.contact import (
    TOUCH,
    Plane,
    along_edge,
    closing,
    hard,
    motion_of,
    normal,
    railed,
    rebound,
    resting_z,
    wedged,
)
from terrasim.kernels.spin import (
    Spun,
    Wheel,
    after,
    course_of,
    energy_of_spin,
    in_groove,
    on_plane,
    struck,
)

_TOUCH = wp.constant(wp.float64(TOUCH))
_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_TWO = wp.constant(wp.float64(2.0))
_IN_HOLE = wp.constant(2)
_NO_EDGE = wp.constant(-1)


@wp.struct
class Roller:
    """A spinning ball on its way."""

    body: Body
    """All but its spin."""
    w: wp.vec3d
    """Spin [rad/s]."""
    rolling: wp.float64
    """Coefficient of rolling friction."""
    up: wp.vec3d
    """In a groove the unit vector half way between the planes' normals."""
    rise: wp.float64
    """There the cosine of the angle of either normal to it."""


@wp.func
def spun_loaded(body: Body, w: wp.vec3d, rolling: wp.float64) -> Roller:
    """A spinning ball as it is stored."""
    out = Roller()
    out.body = body
    out.w = w
    out.rolling = rolling
    return out


@wp.func
def spun_strike(plane: Plane, v: wp.vec3d, ball: Roller, material: Material, step: Step) -> Spun:
    """Velocity and spin after an impact at a velocity ``v``."""
    wheel = on_plane(normal(plane), material.radius, material.friction, ball.rolling)
    return struck(v, ball.w, wheel, rebound(plane, v, material, step))


@wp.func
def spun_landed(
    ball: Roller, plane: Plane, material: Material, step: Step, spacing: wp.float64
) -> Roller:
    """The ball after it struck its plane if it meets it, and put onto it if it does not rise."""
    out = ball
    body = ball.body
    body.lies = 0
    rest = resting_z(plane, body, material.radius, spacing)
    if (plane.state & _IN_HOLE) == 0 and body.z - rest <= _TOUCH:
        if closing(plane, body.v) < -_TOUCH:
            body.impacts += hard(plane, body.v, step)
            now = spun_strike(plane, body.v, ball, material, step)
            body.v = now.v
            out.w = now.w
        rate = closing(plane, body.v)
        if rate <= _TOUCH:
            body.lies = 1
            body.z = rest
            body.v -= normal(plane) * (rate / plane.length)
    out.body = body
    return out


@wp.func
def wheel_of(ball: Roller, plane: Plane, material: Material) -> Wheel:
    """What a ball rolls on: its plane, or both planes of a groove."""
    if ball.body.rail != _NO_EDGE:
        return in_groove(ball.up, ball.rise, material.radius, material.friction, ball.rolling)
    return on_plane(normal(plane), material.radius, material.friction, ball.rolling)


@wp.func
def pull_on(body: Body, plane: Plane, step: Step) -> wp.vec3d:
    """Gravity along the ground a ball lies on [m/s^2]."""
    if body.rail != _NO_EDGE:
        way = along_edge(plane, body.rail)
        return way * (-step.pull * way[2])
    n = normal(plane)
    return wp.vec3d(n[0] * n[2], n[1] * n[2], n[2] * n[2] - _ONE) * step.pull


@wp.func
def spun_advance(
    ball: Roller, plane: Plane, material: Material, step: Step, spacing: wp.float64
) -> Roller:
    """The ball at its next event, or at the end of the step."""
    out = spun_landed(ball, plane, material, step, spacing)
    body = out.body
    if body.lies == 0 and body.rail == _NO_EDGE:
        motion = motion_of(body, plane, material, step, spacing)
        way_out = leave(body, motion.a, spacing)
        t = wp.min(body.left, wp.min(motion.time, way_out.time))
        out.body = moved(body, motion.a, t, spacing)
        out.body.left -= t
        out.body.edge = wp.where(way_out.time <= t, way_out.edge, _NO_EDGE)
        return out
    wheel = wheel_of(out, plane, material)
    load = wp.where(body.rail != _NO_EDGE, body.press, step.pull * wheel.n[2])
    course = course_of(body.v, out.w, wheel, pull_on(body, plane, step), load, body.left)
    way_out = leave(body, course.a, spacing)
    t = wp.min(body.left, wp.min(course.time, way_out.time))
    now = after(body.v, out.w, wheel, course, t)
    body = moved(body, course.a, t, spacing)
    body.v = now.v
    body.left -= t
    body.edge = wp.where(way_out.time <= t, way_out.edge, _NO_EDGE)
    out.w = now.w
    out.body = body
    return out


@wp.func
def spun_climb(
    ball: Roller, ahead: Body, plane: Plane, lift: wp.float64, material: Material, step: Step
) -> Roller:
    """The ball at an edge whose far plane it already cuts into: ``lift`` takes it out of it.

    As ``climb``; the height is paid with speed and spin, in the same parts.
    """
    out = ball
    out.body.rail = _NO_EDGE
    if closing(plane, ball.body.v) < _ZERO:
        now = spun_strike(plane, ball.body.v, ball, material, step)
        out.body.impacts += hard(plane, ball.body.v, step)
        out.body.v = now.v
        out.w = now.w
    if outward(out.body, ball.body.edge) <= _ZERO:
        return out
    v = out.body.v
    n = normal(plane)
    upright = n * wp.dot(out.w, n)
    rolls = out.w - upright
    square = wp.dot(v, v) + energy_of_spin(rolls, material.radius)
    spare = square - _TWO * step.gravity * lift
    if spare < _ZERO:
        out.body.v = v * -material.restitution
        out.w = upright - rolls * material.restitution
        return out
    part = wp.sqrt(spare / square)
    impacts = out.body.impacts
    out.body = ahead
    out.body.v = v * part
    out.body.z += lift
    out.body.impacts = impacts
    out.body.projected += 1
    out.w = upright + rolls * part
    return out


@wp.func
def spun_railed(ball: Roller, here: Plane, there: Plane, material: Material, step: Step) -> Roller:
    """The ball bound to the edge it stands at.

    It no longer turns about the edge, unless nothing rubs. Its spin about the line half way between
    the normals is left alone.
    """
    out = ball
    out.body = railed(ball.body, here, there, step)
    a = normal(here)
    out.up = wp.normalize(a + normal(there))
    out.rise = wp.dot(a, out.up)
    if material.friction > _ZERO:
        way = along_edge(here, ball.body.edge)
        out.w = ball.w - way * wp.dot(ball.w, way)
    return out


@wp.func
def spun_pass(
    ball: Roller,
    ahead: Body,
    here: Plane,
    there: Plane,
    material: Material,
    step: Step,
    size: wp.float64,
) -> Roller:
    """The ball at an edge: ``ahead``, in a cell of a ``size`` of its own, or kept from it."""
    out = ball
    out.body = ahead
    if (there.state & _IN_HOLE) != 0:
        return out
    lift = resting_z(there, ahead, material.radius, size) - ahead.z
    if lift >= -_TOUCH and wedged(ball.body, here, there, step):
        return spun_railed(ball, here, there, material, step)
    if lift <= _TOUCH:
        return out
    if (here.state & _IN_HOLE) != 0 and lift > material.radius * there.over:
        # Its centre is below the surface: the hole's wall.
        out.body = ball.body
        out.body.rail = _NO_EDGE
        out.body.v[0] = -material.restitution * ball.body.v[0]
        out.body.v[1] = -material.restitution * ball.body.v[1]
        out.body.impacts += 1
        return out
    return spun_climb(ball, ahead, there, lift, material, step)
