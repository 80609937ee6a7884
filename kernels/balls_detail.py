"""Balls over ground that may have detail: one step of time, walked from event to event.

As ``balls``, but a ball's cell may be one of the detail's. Where there is no detail its way is the
same to the bit.
"""

import warp as wp

from terrasim.kernels.balls import Tally, advance, calmed, most_events, pulled, tallied
from terrasim.kernels.body import Body, Material, Step, beyond, loaded
from terrasim.kernels.contact import Plane, resting_z, seated, unburied
from terrasim.kernels.footing import (
    Footing,
    carried,
    divided,
    finer,
    footing_of,
    next_footing,
    pass_on,
    plane_under,
    stored,
)
from terrasim.kernels.lattice import Lattice

_ZERO = wp.constant(wp.float64(0.0))
_COARSER = wp.constant(4)
_NO_EDGE = wp.constant(-1)


@wp.struct
class Trip:
    """A ball on its way, and what it met."""

    body: Body
    """The ball; in a detail cell where its ground has detail."""
    ground: Footing
    """The cell of the base under it."""
    plane: Plane
    """The plane under it."""
    seen: int
    """The states of the planes it met, joined."""
    error: int
    """Largest error bound [counts] of a coarser level among them."""


@wp.func
def begun(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    ball: Body,
    upright: int,
) -> Trip:
    """A ball before its way."""
    trip = Trip()
    trip.body = ball
    trip.ground = footing_of(table, lattice, ball.row, ball.col)
    if trip.ground.fine == 1:
        trip.body = divided(ball, trip.ground, lattice.factor)
    trip.plane = seated(plane_under(pool, table, lattice, trip.body, trip.ground), upright)
    trip.seen = trip.plane.state
    return trip


@wp.func
def walked(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    error: wp.array(dtype=int),
    used_out: wp.array(dtype=wp.uint8),
    lattice: Lattice,
    start: Trip,
    ball: Material,
    step: Step,
) -> Trip:
    """Walk a ball to the end of a step; its cell is one of the base again."""
    # Over the limit: the loop of ``step_balls`` with the ground's kind beside its plane.
    body = start.body
    ground = start.ground
    plane = start.plane
    out = start
    most = most_events(body.v, step, ground.size)
    most_fine = most_events(body.v, step, finer(ground, lattice).size)
    events = int(0)
    while body.left > _ZERO and events < most:
        events += 1
        used_out[plane.layer] = wp.uint8(1)
        if (plane.state & _COARSER) != 0:
            out.error = wp.max(out.error, error[plane.layer])
        body = advance(body, plane, ball, step, ground.size)
        if body.edge != _NO_EDGE:
            edge = body.edge
            side = body.side
            ahead = beyond(body, edge, ground.size)
            beside = next_footing(table, lattice, ahead, ground)
            ahead = carried(ahead, edge, ground, beside, lattice.factor)
            there = seated(plane_under(pool, table, lattice, ahead, beside), step.upright)
            body = pass_on(body, ahead, plane, there, ball, step, beside.size)
            if body.side != side:
                plane = there
                ground = beside
                out.seen = out.seen | plane.state
            elif body.rail != _NO_EDGE and beside.fine > ground.fine:
                # Wedged against detail: the next detail cell along the edge may let it go.
                ground = finer(ground, lattice)
                body = divided(body, ground, lattice.factor)
                body.side = side
                plane = seated(plane_under(pool, table, lattice, body, ground), step.upright)
            most = wp.where(ground.fine == 1, most_fine, most)
        body = calmed(body, most - events, step)
    body = unburied(body, plane, ball.radius, ground.size)
    if body.left > _ZERO:
        body.v = wp.vec3d(_ZERO, _ZERO, _ZERO)
    out.body = stored(body, ground, lattice.spacing)
    return out


@wp.kernel(enable_backward=False)
def step_balls_on_detail(
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
    """Move one ball by one step."""
    i = wp.tid()
    body = loaded(cell[i], offset[i], z[i], velocity[i], step.dt)
    trip = begun(pool, table, lattice, body, step.upright)
    ball = material[i]
    trip.body = pulled(unburied(trip.body, trip.plane, ball.radius, trip.ground.size), step)
    trip = walked(pool, table, error, used_out, lattice, trip, ball, step)
    body = trip.body
    tally[i] = tallied(tally[i], body, trip.seen, trip.error)
    cell[i] = wp.vec2i(body.row, body.col)
    offset[i] = wp.vec2d(body.x, body.y)
    z[i] = body.z
    velocity[i] = body.v


@wp.kernel(enable_backward=False)
def stand_balls_on_detail(
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
    """Turn a ball's height above touching the ground into one above the datum."""
    i = wp.tid()
    body = loaded(cell[i], offset[i], z[i], wp.vec3d(), _ZERO)
    ground = footing_of(table, lattice, body.row, body.col)
    if ground.fine == 1:
        body = divided(body, ground, lattice.factor)
    plane = seated(plane_under(pool, table, lattice, body, ground), upright)
    z[i] = resting_z(plane, body, material[i].radius, ground.size) + z[i]
