"""Spin of a solid sphere: impacts, slipping, rolling, and what resists rolling.

All friction acts at the contact point, so it changes velocity and spin together: a push ``J`` for a
kilogram, across the normal, changes the velocity by ``J`` and the spin by ``-arm n x J / I`` with
``I = 2/5 radius^2``. The speed of the contact point over the ground is the slip; a push changes it
by ``7/2 J`` on a plane, so ``2/7`` of the slip stops it, if Coulomb's limit allows that much.
Rolling friction is a moment ``rolling * radius * load`` against the roll, as if the ground carried
the ball that much ahead of its centre: it slows a ball as a pull of ``rolling * load`` would, and
holds it where the pull of gravity is less. It acts on what rolls, never on what slips. Nothing
slows the spin about the normal.

In a groove the two contact points are one wheel whose arm is shorter than the radius.
"""

import warp as wp

SOLID = 0.4
"""Moment of inertia of a solid sphere over its mass and the square of its radius."""

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_SOLID = wp.constant(wp.float64(SOLID))
_NEVER = wp.constant(wp.float64(1e300))
_STILL = wp.constant(wp.float64(1e-12))


@wp.struct
class Wheel:
    """A sphere against what it touches."""

    n: wp.vec3d
    """Unit normal, from the ground to the centre."""
    arm: wp.float64
    """Distance of the centre from the line or point it rolls on [m]."""
    inertia: wp.float64
    """Moment of inertia over mass and ``arm^2``: 2/5 on a plane."""
    friction: wp.float64
    """Coulomb's coefficient."""
    rolling: wp.float64
    """Coefficient of rolling friction."""


@wp.struct
class Spun:
    """A velocity and a spin."""

    v: wp.vec3d
    """Velocity [m/s]."""
    w: wp.vec3d
    """Spin [rad/s]."""


@wp.struct
class Brake:
    """Which way something acts that resists a motion."""

    way: wp.vec3d
    """Unit vector that it acts against."""
    time: wp.float64
    """In how long to look again [s]."""
    stops: int
    """1 if the motion has stopped by then."""


@wp.struct
class Course:
    """How a sphere on the ground moves until its kind of motion changes."""

    a: wp.vec3d
    """Acceleration [m/s^2]."""
    alpha: wp.vec3d
    """Rate of its spin while it slips [rad/s^2]."""
    time: wp.float64
    """In how long to look again [s]."""
    rolls: int
    """1 if it rolls, 0 if it slips."""
    stops: int
    """1 if by then it has stopped, or its slip has."""


@wp.func
def on_plane(n: wp.vec3d, radius: wp.float64, friction: wp.float64, rolling: wp.float64) -> Wheel:
    """A sphere on a plane."""
    wheel = Wheel()
    wheel.n = n
    wheel.arm = radius
    wheel.inertia = _SOLID
    wheel.friction = friction
    wheel.rolling = rolling
    return wheel


@wp.func
def in_groove(
    up: wp.vec3d,
    rise: wp.float64,
    radius: wp.float64,
    friction: wp.float64,
    rolling: wp.float64,
) -> Wheel:
    """A sphere between two planes.

    Args:
        up: The unit vector half way between their normals.
        rise: Cosine of the angle of either normal to it.
        radius: Radius [m].
        friction: Coulomb's coefficient.
        rolling: Coefficient of rolling friction.
    """
    wheel = on_plane(up, radius * rise, friction, rolling)
    wheel.inertia = _SOLID / (rise * rise)
    return wheel


@wp.func
def slip_of(v: wp.vec3d, w: wp.vec3d, wheel: Wheel) -> wp.vec3d:
    """Velocity of the contact point over the ground [m/s]."""
    return v - wheel.n * wp.dot(v, wheel.n) - wp.cross(w, wheel.n) * wheel.arm


@wp.func
def stopping(wheel: Wheel) -> wp.float64:
    """The part of a slip that a push must be to stop it: 2/7 on a plane."""
    return wheel.inertia / (_ONE + wheel.inertia)


@wp.func
def turning(wheel: Wheel, push: wp.vec3d) -> wp.vec3d:
    """Spin [rad/s] that a push [m/s] at the contact point gives; likewise their rates."""
    return wp.cross(push, wheel.n) / (wheel.inertia * wheel.arm)


@wp.func
def rolling_spin(v: wp.vec3d, w: wp.vec3d, wheel: Wheel) -> wp.vec3d:
    """The spin that rolls at a velocity, with what there is about the normal."""
    return wheel.n * wp.dot(w, wheel.n) + wp.cross(wheel.n, v) / wheel.arm


@wp.func
def energy_of_spin(w: wp.vec3d, radius: wp.float64) -> wp.float64:
    """Twice the energy of a spin, for a kilogram: what it adds to the square of a speed."""
    return _SOLID * radius * radius * wp.dot(w, w)


@wp.func
def speed_with_spin(v: wp.vec3d, w: wp.vec3d, radius: wp.float64) -> wp.float64:
    """The speed if all of the spin became speed [m/s]."""
    return wp.sqrt(wp.dot(v, v) + energy_of_spin(w, radius))


@wp.func
def spare_grip(held: wp.vec3d, way: wp.vec3d, most: wp.float64) -> wp.float64:
    """How far friction may still push against a unit ``way`` when it already pushes ``held``."""
    along = wp.dot(held, way)
    square = along * along + most * most - wp.dot(held, held)
    return wp.max(_ZERO, along + wp.sqrt(wp.max(_ZERO, square)))


@wp.func
def gripped(v: wp.vec3d, w: wp.vec3d, wheel: Wheel) -> Spun:
    """Velocity and spin after the push that stops the slip."""
    out = Spun()
    out.v = v - slip_of(v, w, wheel) * stopping(wheel)
    out.w = rolling_spin(out.v, w, wheel)
    return out


@wp.func
def struck(v: wp.vec3d, w: wp.vec3d, wheel: Wheel, up: wp.float64) -> Spun:
    """Velocity and spin after an impact that it leaves with a speed of ``up`` along the normal.

    Friction pushes at most ``friction`` times as much as the ground does, and no more than stops
    the slip. What then rolls is slowed by rolling friction, as under the same load over a time.
    """
    load = up - wp.dot(v, wheel.n)
    most = wheel.friction * load
    push = slip_of(v, w, wheel) * -stopping(wheel)
    needed = wp.length(push)
    out = Spun()
    if needed > most:
        push = push * (most / needed)
        out.v = v + wheel.n * load + push
        out.w = w + turning(wheel, push)
        return out
    along = v - wheel.n * wp.dot(v, wheel.n) + push
    speed = wp.length(along)
    if wheel.rolling > _ZERO and speed > _ZERO:
        way = along / speed
        loss = wheel.rolling * load / (_ONE + wheel.inertia)
        loss = wp.min(loss, spare_grip(push, way, most))
        along = along * wp.max(_ZERO, _ONE - loss / speed)
    out.v = along + wheel.n * up
    out.w = rolling_spin(along, w, wheel)
    return out


@wp.func
def brake(u: wp.vec3d, pull: wp.vec3d, most: wp.float64, left: wp.float64) -> Brake:
    """What resists a motion ``u`` that is pulled, with a strength of ``most`` [m/s^2].

    It acts against the motion as it will be at the end, not as it was: so it cannot throw it from
    side to side however long the step, a motion that stops leaves nothing over, and one that does
    not turn is exact. A motion that turns back is looked at again when it is across its old way,
    so that what resists never drives it.
    """
    out = Brake()
    square = wp.dot(u, u)
    along = wp.dot(u, pull)
    out.time = _NEVER
    root = along * along + square * (most * most - wp.dot(pull, pull))
    if root >= _ZERO:
        rate = wp.sqrt(root) - along
        if rate > _ZERO:
            # When ``u + pull t`` is as long as ``most t``.
            out.time = square / rate
            out.stops = 1
    if -along * out.time > square:
        out.time = -square / along
        out.stops = 0
    out.way = wp.normalize(u + pull * wp.min(out.time, left))
    return out


@wp.func
def slipping(
    slip: wp.vec3d, wheel: Wheel, pull: wp.vec3d, most: wp.float64, left: wp.float64
) -> Course:
    """Motion under a pull and all the friction there is."""
    against = brake(slip, pull, most / stopping(wheel), left)
    course = Course()
    course.a = pull - against.way * most
    course.alpha = turning(wheel, against.way * -most)
    course.time = against.time
    course.stops = against.stops
    return course


@wp.func
def rolling(
    v: wp.vec3d, wheel: Wheel, pull: wp.vec3d, load: wp.float64, left: wp.float64
) -> Course:
    """Motion of what rolls under a pull: friction takes its part, rolling friction slows it."""
    course = Course()
    course.rolls = 1
    course.time = _NEVER
    ease = _ONE / (_ONE + wheel.inertia)
    still = wp.dot(v, v) == _ZERO
    way = wp.normalize(wp.where(still, pull, v))
    limit = spare_grip(pull * -stopping(wheel), way, wheel.friction * load)
    loss = wp.min(wheel.rolling * load * ease, limit)
    if still and wp.length(pull) * ease <= loss:
        return course
    against = brake(v, pull * ease, loss, left)
    course.a = pull * ease - against.way * loss
    course.time = wp.where(still, _NEVER, against.time)
    course.stops = against.stops
    return course


@wp.func
def course_of(
    v: wp.vec3d,
    w: wp.vec3d,
    wheel: Wheel,
    pull: wp.vec3d,
    load: wp.float64,
    left: wp.float64,
) -> Course:
    """How a sphere moves on the ground.

    Args:
        v: Velocity, along the ground [m/s].
        w: Spin [rad/s].
        wheel: What it touches.
        pull: Acceleration along the ground without friction [m/s^2].
        load: What the ground carries, for a kilogram [N].
        left: What is left of the step [s].
    """
    most = wheel.friction * load
    slip = slip_of(v, w, wheel)
    # Rolling is exact up to rounding.
    if wp.length(slip) > _STILL * (_ONE + wp.length(v)):
        return slipping(slip, wheel, pull, most, left)
    if wp.length(pull) * stopping(wheel) > most:
        return slipping(pull * _STILL, wheel, pull, most, left)
    return rolling(v, wheel, pull, load, left)


@wp.func
def after(v: wp.vec3d, w: wp.vec3d, wheel: Wheel, course: Course, t: wp.float64) -> Spun:
    """Velocity and spin after a time of one course; at its end in the next one."""
    out = Spun()
    out.v = v + course.a * t
    out.w = w + course.alpha * t
    ends = course.stops == 1 and course.time <= t
    if course.rolls == 0:
        if ends:
            return gripped(out.v, out.w, wheel)
        return out
    if ends:
        out.v = wp.vec3d(_ZERO, _ZERO, _ZERO)
    out.w = rolling_spin(out.v, w, wheel)
    return out
