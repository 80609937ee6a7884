"""Balls that touch the ground by springs and dampers: one step of time.

A ball that has sunk into the plane under it is pushed out along the normal with ``stiffness *
depth - damping * speed``, never pulled. Explicitly, the force is that of the step's start.
Implicitly, it is that of its end, with the depth that the ball then has: backward Euler, which for
a force with a convex potential only takes energy away. Then the ball goes straight on, and its
centre meets the ground as something hard.
"""

import warp as wp

from terrasim.kernels.balls import Tally, tallied
from terrasim.kernels.balls_detail import begun, walked
from terrasim.kernels.body import Body, Material, Step, loaded
from terrasim.kernels.contact import Plane, normal, resting_z, unburied
from terrasim.kernels.lattice import Lattice

_ZERO = wp.constant(wp.float64(0.0))
_ONE = wp.constant(wp.float64(1.0))
_IN_HOLE = wp.constant(2)


@wp.func
def depth_in(plane: Plane, body: Body, radius: wp.float64, size: wp.float64) -> wp.float64:
    """How deep a ball has sunk into a plane, along its normal [m]; below 0 above it."""
    if (plane.state & _IN_HOLE) != 0:
        return -wp.float64(1e300)
    return (resting_z(plane, body, radius, size) - body.z) / plane.length


@wp.func
def push(
    depth: wp.float64,
    before: wp.float64,
    free: wp.float64,
    spring: wp.vec2d,
    implicit: int,
    dt: wp.float64,
) -> wp.float64:
    """Speed along the normal that the contact gives a ball in a step [m/s], at least 0.

    ``before`` is the speed along the normal, ``free`` that speed after gravity; ``spring`` holds
    stiffness and damping of a kilogram.
    """
    stiffness = spring[0]
    damping = spring[1]
    if implicit == 1:
        if depth - dt * free <= _ZERO:
            return _ZERO
        after = (free + dt * stiffness * depth) / (_ONE + dt * (damping + dt * stiffness))
        return wp.max(_ZERO, after - free)
    if depth <= _ZERO:
        return _ZERO
    return wp.max(_ZERO, dt * (stiffness * depth - damping * before))


@wp.func
def sprung(
    body: Body,
    plane: Plane,
    ball: Material,
    depth: wp.float64,
    spring: wp.vec2d,
    implicit: int,
    step: Step,
) -> Body:
    """The body after gravity and the contact's forces of a step: the spring's and friction."""
    out = body
    n = normal(plane)
    out.v[2] -= step.gravity * step.dt
    given = push(depth, wp.dot(body.v, n), wp.dot(out.v, n), spring, implicit, step.dt)
    if given > _ZERO:
        out.v += n * given
        up = wp.dot(out.v, n)
        along = out.v - n * up
        speed = wp.length(along)
        if speed > _ZERO:
            along = along * wp.max(_ZERO, _ONE - ball.friction * given / speed)
        out.v = along + n * up
    return out


@wp.func
def straight(step: Step) -> Step:
    """The step without gravity, which has acted."""
    out = step
    out.gravity = _ZERO
    out.pull = _ZERO
    out.calm = _ZERO
    return out


@wp.kernel(enable_backward=False)
def step_sprung_balls(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    error: wp.array(dtype=int),
    lattice: Lattice,
    step: Step,
    implicit: int,
    used_out: wp.array(dtype=wp.uint8),
    # In:
    material: wp.array(dtype=Material),
    spring: wp.array(dtype=wp.vec2d),
    # In and out:
    cell: wp.array(dtype=wp.vec2i),
    offset: wp.array(dtype=wp.vec2d),
    z: wp.array(dtype=wp.float64),
    velocity: wp.array(dtype=wp.vec3d),
    tally: wp.array(dtype=Tally),
):
    """Move one ball by one step; over ground with detail or without."""
    # Over the limit: springs are beside what other balls have.
    i = wp.tid()
    ball = material[i]
    body = loaded(cell[i], offset[i], z[i], velocity[i], step.dt)
    trip = begun(pool, table, lattice, body, step.upright)
    trip.body = unburied(trip.body, trip.plane, _ZERO, trip.ground.size)
    depth = depth_in(trip.plane, trip.body, ball.radius, trip.ground.size)
    trip.body = sprung(trip.body, trip.plane, ball, depth, spring[i], implicit, step)
    centre = Material()
    trip = walked(pool, table, error, used_out, lattice, trip, centre, straight(step))
    body = trip.body
    # What its centre met, it should not have.
    body.projected += body.impacts
    end = begun(pool, table, lattice, body, step.upright)
    sunk = depth_in(end.plane, end.body, ball.radius, end.ground.size)
    body.impacts = wp.where(depth <= _ZERO and sunk > _ZERO, 1, 0)
    tally[i] = tallied(tally[i], body, trip.seen, trip.error)
    cell[i] = wp.vec2i(body.row, body.col)
    offset[i] = wp.vec2d(body.x, body.y)
    z[i] = body.z
    velocity[i] = body.v
