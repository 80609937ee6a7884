"""Balls: one step of time, walked from event to event.

Events are impacts, edges of triangles and stops. Between two of them a ball moves with a constant
acceleration, in flight or along the ground, so a step without rest or turning slides is exact, and
no ground is skipped at any speed.
"""

import warp as wp

from terrasim.kernels.body import Body, Material, Step, beyond, kept, leave, loaded, moved
from terrasim.kernels.contact import (
    STILL,
    Plane,
    cross,
    landed,
    motion_of,
    plane_of,
    resting_z,
    seated,
    unburied,
)
from terrasim.kernels.surface import Lattice

EVENTS = 24
"""Events in a step, beside those that its way across the triangles takes."""
PIT_EVENTS = 6
"""So many of them bring a ball to rest that is slower than gravity makes it in half the step: six
planes meet at a post, and a ball may be wedged between them."""

_STILL = wp.constant(wp.float64(STILL))
_EVENTS = wp.constant(EVENTS)
_PIT_EVENTS = wp.constant(PIT_EVENTS)
_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_SIX = wp.constant(wp.float64(6.0))
_MOST_EDGES = wp.constant(wp.float64(1e6))
_OFF = wp.constant(1)
_IN_HOLE = wp.constant(2)
_COARSER = wp.constant(4)
_NO_EDGE = wp.constant(-1)


@wp.struct
class Tally:
    """What happened to a ball since it was made."""

    impacts: int
    """Times it struck the ground, faster than gravity makes it in half a step."""
    projected: int
    """Times it was lifted out of the ground: an edge it did not clear, or ground that rose."""
    held: int
    """Steps in which it met too many events, as a ball wedged in a pit does: it was stopped."""
    off: int
    """Steps that took it beyond the terrain's edge, where the edge's height goes on."""
    hole: int
    """Steps that took it over a hole, where nothing holds it."""
    coarse: int
    """Steps in which a coarser level stood in for level 0."""
    error: int
    """Largest error bound of such a level [counts]."""


@wp.func
def advance(body: Body, plane: Plane, material: Material, step: Step, spacing: wp.float64) -> Body:
    """The body at its next event, or at the end of the step."""
    out = landed(body, plane, material, step, spacing)
    motion = motion_of(out, plane, material, step, spacing)
    way_out = leave(out, motion.a, spacing)
    t = wp.min(out.left, wp.min(motion.time, way_out.time))
    out = moved(out, motion.a, t, spacing)
    out.left -= t
    out.edge = wp.where(way_out.time <= t, way_out.edge, _NO_EDGE)
    if out.lies == 1 and motion.time <= t:
        # It has stopped, up to rounding if it is to slide back.
        if motion.sticks == 1 or wp.length(out.v) < _STILL:
            out.v = wp.vec3d(_ZERO, _ZERO, _ZERO)
    return out


@wp.func
def calmed(body: Body, spare: int, step: Step) -> Body:
    """The body at rest if it is slow and still met many events: it lies in a pit."""
    out = body
    still = wp.dot(body.v, body.v) <= step.calm * step.calm
    if body.left > _ZERO and spare <= _EVENTS - _PIT_EVENTS and still:
        out.v = wp.vec3d(_ZERO, _ZERO, _ZERO)
        out.left = _ZERO
    return out


@wp.func
def pulled(body: Body, step: Step) -> Body:
    """The body after what of gravity acts before the first event."""
    out = body
    out.v[2] -= (step.gravity - step.pull) * step.dt
    return out


@wp.func
def most_events(v: wp.vec3d, step: Step, spacing: wp.float64) -> int:
    """Events to allow in a step: a straight way crosses three edges a cell along x and y."""
    reach = (wp.length(v) + step.gravity * step.dt) * step.dt / spacing
    return _EVENTS + int(wp.min(_SIX * reach, _MOST_EDGES))


@wp.func
def settled(body: Body, plane: Plane, material: Material, spacing: wp.float64) -> Body:
    """The body as it is stored: not under the ground, and at rest if it met too many events."""
    out = unburied(body, plane, material.radius, spacing)
    if out.left > _ZERO:
        out.v = wp.vec3d(_ZERO, _ZERO, _ZERO)
    return kept(out, spacing)


@wp.func
def tallied(tally: Tally, body: Body, seen: int, error: int) -> Tally:
    """A ball's tally after a step; ``seen`` joins the states of the planes it met."""
    out = tally
    out.impacts += body.impacts
    out.projected += body.projected
    out.held += wp.where(body.left > _ZERO, 1, 0)
    out.off += wp.where((seen & _OFF) != 0, 1, 0)
    out.hole += wp.where((seen & _IN_HOLE) != 0, 1, 0)
    out.coarse += wp.where((seen & _COARSER) != 0, 1, 0)
    out.error = wp.max(tally.error, error)
    return out


@wp.kernel(enable_backward=False)
def step_balls(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    error: wp.array(dtype=int),
    lattice: Lattice,
    step: Step,
    used_out: wp.array(dtype=wp.uint8),
    # In:
    material: wp.array(dtype=Material),
    # In and out:
    cell: wp.array(dtype=wp.vec2i),
    offset: wp.array(dtype=wp.vec2d),
    z: wp.array(dtype=wp.float64),
    velocity: wp.array(dtype=wp.vec3d),
    tally: wp.array(dtype=Tally),
):
    """Move one ball by one step, over ground without detail."""
    i = wp.tid()
    # A constant, so that the compiler leaves the detail out: worth a twentieth of the time.
    lattice.factor = 1
    ball = material[i]
    body = loaded(cell[i], offset[i], z[i], velocity[i], step.dt)
    plane = seated(plane_of(pool, table, lattice, body), step.upright)
    body = pulled(unburied(body, plane, ball.radius, lattice.spacing), step)
    most = most_events(body.v, step, lattice.spacing)
    events = int(0)
    seen = int(plane.state)
    worst = int(0)
    while body.left > _ZERO and events < most:
        events += 1
        used_out[plane.layer] = wp.uint8(1)
        if (plane.state & _COARSER) != 0:
            worst = wp.max(worst, error[plane.layer])
        body = advance(body, plane, ball, step, lattice.spacing)
        if body.edge != _NO_EDGE:
            there = plane_of(pool, table, lattice, beyond(body, body.edge, lattice.spacing))
            there = seated(there, step.upright)
            side = body.side
            body = cross(body, plane, there, ball, step, lattice.spacing)
            if body.side != side:
                plane = there
                seen = seen | plane.state
        body = calmed(body, most - events, step)
    body = settled(body, plane, ball, lattice.spacing)
    tally[i] = tallied(tally[i], body, seen, worst)
    cell[i] = wp.vec2i(body.row, body.col)
    offset[i] = wp.vec2d(body.x, body.y)
    z[i] = body.z
    velocity[i] = body.v


@wp.kernel(enable_backward=False)
def stand_balls(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    upright: int,
    # In:
    material: wp.array(dtype=Material),
    cell: wp.array(dtype=wp.vec2i),
    offset: wp.array(dtype=wp.vec2d),
    # In and out:
    z: wp.array(dtype=wp.float64),
):
    """Turn a ball's height above touching ground without detail into one above the datum."""
    i = wp.tid()
    body = loaded(cell[i], offset[i], z[i], wp.vec3d(), _ZERO)
    plane = seated(plane_of(pool, table, lattice, body), upright)
    z[i] = resting_z(plane, body, material[i].radius, lattice.spacing) + z[i]
