"""Ground with detail that moved under balls; as ``rise``."""

import warp as wp

from terrasim.kernels.body import Material, Step, loaded
from terrasim.kernels.contact import seated
from terrasim.kernels.footing import divided, footing_of, plane_under
from terrasim.kernels.lattice import Lattice
from terrasim.kernels.rise import Rise, boarded, looked, meets

_ZERO = wp.constant(wp.float64(0.0))


@wp.kernel(enable_backward=False)
def look_at_detail(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    upright: int,
    when: int,
    # In:
    material: wp.array(dtype=Material),
    cell: wp.array(dtype=wp.vec2i),
    offset: wp.array(dtype=wp.vec2d),
    z: wp.array(dtype=wp.float64),
    # In and out:
    rise: wp.array(dtype=Rise),
):
    """Look at the ground under a ball, before and after it changes."""
    i = wp.tid()
    body = loaded(cell[i], offset[i], z[i], wp.vec3d(), _ZERO)
    ground = footing_of(table, lattice, body.row, body.col)
    if ground.fine == 1:
        body = divided(body, ground, lattice.factor)
    plane = seated(plane_under(pool, table, lattice, body, ground), upright)
    rise[i] = looked(rise[i], plane, body, material[i].radius, ground.size, when)


@wp.kernel(enable_backward=False)
def board_on_detail(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    step: Step,
    rubs: wp.float64,
    # In:
    material: wp.array(dtype=Material),
    rise: wp.array(dtype=Rise),
    cell: wp.array(dtype=wp.vec2i),
    offset: wp.array(dtype=wp.vec2d),
    # In and out:
    z: wp.array(dtype=wp.float64),
    velocity: wp.array(dtype=wp.vec3d),
    # Out:
    rate: wp.array(dtype=wp.float64),
):
    """See a ball from the ground that moved under it."""
    i = wp.tid()
    rate[i] = _ZERO
    if rise[i].rise == _ZERO and rise[i].lift == _ZERO:
        return
    body = loaded(cell[i], offset[i], z[i], velocity[i], step.dt)
    ground = footing_of(table, lattice, body.row, body.col)
    if ground.fine == 1:
        body = divided(body, ground, lattice.factor)
    plane = seated(plane_under(pool, table, lattice, body, ground), step.upright)
    if meets(rise[i], plane, body.v, step):
        body = boarded(body, rise[i], plane, material[i], rubs, step)
        z[i] = body.z
        velocity[i] = body.v
        rate[i] = rise[i].rise / step.dt
