"""Spinning balls: one step of time, walked from event to event.

As ``balls`` and ``balls_detail``, with a ball's spin beside its velocity and its rolling friction
beside its material.
"""

import warp as wp

from terrasim.kernels.balls import Tally, calmed, most_events, pulled, tallied
from terrasim.kernels.body import Material, Step, beyond, loaded
from terrasim.kernels.contact import seated, unburied
from terrasim.kernels.footing import (
    carried,
    divided,
    finer,
    footing_of,
    next_footing,
    plane_under,
    stored,
)
from terrasim.kernels.lattice import Lattice
from terrasim.kernels.spin import speed_with_spin
from terrasim.kernels.spin_contact import Roller, spun_advance, spun_loaded, spun_pass

_ZERO = wp.constant(wp.float64(0.0))
_COARSER = wp.constant(4)
_NO_EDGE = wp.constant(-1)


@wp.struct
class Walk:
    """A ball after a step, and what it met."""

    ball: Roller
    """The ball, as it is stored."""
    seen: int
    """The states of the planes it met, joined."""
    error: int
    """Largest error bound [counts] of a coarser level among them."""


@wp.func
def spun_walk(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    error: wp.array(dtype=int),
    used_out: wp.array(dtype=wp.uint8),
    lattice: Lattice,
    ball: Roller,
    material: Material,
    step: Step,
) -> Walk:
    """Walk a ball through a step."""
    # Over the limit: the loop of ``step_balls_on_detail``.
    body = ball.body
    ground = footing_of(table, lattice, body.row, body.col)
    if ground.fine == 1:
        body = divided(body, ground, lattice.factor)
    plane = seated(plane_under(pool, table, lattice, body, ground), step.upright)
    ball.body = pulled(unburied(body, plane, material.radius, ground.size), step)
    # Friction can turn all of its spin into speed.
    fastest = wp.vec3d(speed_with_spin(body.v, ball.w, material.radius), _ZERO, _ZERO)
    most = most_events(fastest, step, ground.size)
    most_fine = most_events(fastest, step, finer(ground, lattice).size)
    events = int(0)
    out = Walk()
    out.seen = plane.state
    while ball.body.left > _ZERO and events < most:
        events += 1
        used_out[plane.layer] = wp.uint8(1)
        if (plane.state & _COARSER) != 0:
            out.error = wp.max(out.error, error[plane.layer])
        ball = spun_advance(ball, plane, material, step, ground.size)
        if ball.body.edge != _NO_EDGE:
            edge = ball.body.edge
            side = ball.body.side
            ahead = beyond(ball.body, edge, ground.size)
            beside = next_footing(table, lattice, ahead, ground)
            ahead = carried(ahead, edge, ground, beside, lattice.factor)
            there = seated(plane_under(pool, table, lattice, ahead, beside), step.upright)
            ball = spun_pass(ball, ahead, plane, there, material, step, beside.size)
            if ball.body.side != side:
                plane = there
                ground = beside
                out.seen = out.seen | plane.state
            elif ball.body.rail != _NO_EDGE and beside.fine > ground.fine:
                # Wedged against detail: the next detail cell along the edge may let it go.
                ground = finer(ground, lattice)
                ball.body = divided(ball.body, ground, lattice.factor)
                ball.body.side = side
                plane = seated(plane_under(pool, table, lattice, ball.body, ground), step.upright)
            most = wp.where(ground.fine == 1, most_fine, most)
        left = ball.body.left
        ball.body = calmed(ball.body, most - events, step)
        if ball.body.left < left:
            ball.w = wp.vec3d(_ZERO, _ZERO, _ZERO)
    ball.body = unburied(ball.body, plane, material.radius, ground.size)
    if ball.body.left > _ZERO:
        ball.body.v = wp.vec3d(_ZERO, _ZERO, _ZERO)
        ball.w = wp.vec3d(_ZERO, _ZERO, _ZERO)
    ball.body = stored(ball.body, ground, lattice.spacing)
    out.ball = ball
    return out


@wp.kernel(enable_backward=False)
def step_spinning_balls(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    error: wp.array(dtype=int),
    lattice: Lattice,
    step: Step,
    used_out: wp.array(dtype=wp.uint8),
    # In:
    material: wp.array(dtype=Material),
    rolling: wp.array(dtype=wp.float64),
    # In and out:
    cell: wp.array(dtype=wp.vec2i),
    offset: wp.array(dtype=wp.vec2d),
    z: wp.array(dtype=wp.float64),
    velocity: wp.array(dtype=wp.vec3d),
    spin: wp.array(dtype=wp.vec3d),
    tally: wp.array(dtype=Tally),
):
    """Move one spinning ball by one step, over ground without detail."""
    # Over the limit: spin and rolling friction are arrays beside those of ``step_balls``.
    i = wp.tid()
    lattice.factor = 1
    body = loaded(cell[i], offset[i], z[i], velocity[i], step.dt)
    ball = spun_loaded(body, spin[i], rolling[i])
    walk = spun_walk(pool, table, error, used_out, lattice, ball, material[i], step)
    body = walk.ball.body
    tally[i] = tallied(tally[i], body, walk.seen, walk.error)
    cell[i] = wp.vec2i(body.row, body.col)
    offset[i] = wp.vec2d(body.x, body.y)
    z[i] = body.z
    velocity[i] = body.v
    spin[i] = walk.ball.w


@wp.kernel(enable_backward=False)
def step_spinning_balls_on_detail(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    error: wp.array(dtype=int),
    lattice: Lattice,
    step: Step,
    used_out: wp.array(dtype=wp.uint8),
    # In:
    material: wp.array(dtype=Material),
    rolling: wp.array(dtype=wp.float64),
    # In and out:
    cell: wp.array(dtype=wp.vec2i),
    offset: wp.array(dtype=wp.vec2d),
    z: wp.array(dtype=wp.float64),
    velocity: wp.array(dtype=wp.vec3d),
    spin: wp.array(dtype=wp.vec3d),
    tally: wp.array(dtype=Tally),
):
    """Move one spinning ball by one step."""
    # Over the limit: spin and rolling friction are arrays beside those of ``step_balls``.
    i = wp.tid()
    body = loaded(cell[i], offset[i], z[i], velocity[i], step.dt)
    ball = spun_loaded(body, spin[i], rolling[i])
    walk = spun_walk(pool, table, error, used_out, lattice, ball, material[i], step)
    body = walk.ball.body
    tally[i] = tallied(tally[i], body, walk.seen, walk.error)
    cell[i] = wp.vec2i(body.row, body.col)
    offset[i] = wp.vec2d(body.x, body.y)
    z[i] = body.z
    velocity[i] = body.v
    spin[i] = walk.ball.w
