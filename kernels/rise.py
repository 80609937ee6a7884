"""Ground that moved under balls: how far, and the balls as that ground sees them.

Between two steps the ground has risen by ``rise`` under a ball: at the rate ``rise / dt``, if it
took the step to do so. Seen from ground that goes up at that rate the ball starts from where it was
above the ground before, its velocity is less by the rate, and the ground stands still where it is
now. So the step is what it always is, and after it the rate is given back.
"""

import warp as wp

from terrasim.kernels.body import Body, Material, Step, loaded
from terrasim.kernels.contact import TOUCH, Plane, closing, plane_of, resting_z, seated, strike
from terrasim.kernels.lattice import Lattice

FIRST = 0
"""Before the ground changes, for the first time in a step."""
AGAIN = 1
"""Before it changes once more in the same step."""
AFTER = 2
"""After it changed."""

_FIRST = wp.constant(FIRST)
_AFTER = wp.constant(AFTER)
_TOUCH = wp.constant(wp.float64(TOUCH))
_ZERO = wp.constant(wp.float64(0.0))
_HALF = wp.constant(wp.float64(0.5))
_UNKNOWN = wp.constant(2 | 4)
"""In a hole, or a coarser level stood in."""


@wp.struct
class Rise:
    """What the ground under a ball did since the last step."""

    height: wp.float64
    """Height of the ground under the centre when it was last looked at [m above the datum]."""
    touch: wp.float64
    """Height at which the centre touches, then [m above the datum]."""
    clear: wp.float64
    """Clearance before anything changed [m]."""
    rise: wp.float64
    """How far the ground went up [m]."""
    lift: wp.float64
    """How far the height at which the ball touches went up [m]: more where the ground tilted."""
    known: int
    """0 where there was no ground to look at, or a coarser level stood in."""


@wp.func
def looked(
    last: Rise, plane: Plane, body: Body, radius: wp.float64, size: wp.float64, when: int
) -> Rise:
    """What is known of the ground under a ball after one more look at it."""
    touch = resting_z(plane, body, radius, size)
    height = touch - radius * plane.over
    known = wp.where((plane.state & _UNKNOWN) == 0, 1, 0)
    out = last
    if when == _FIRST:
        out.clear = body.z - touch
        out.rise = _ZERO
        out.lift = _ZERO
    if when == _AFTER and known == 1 and last.known == 1:
        out.rise = last.rise + (height - last.height)
        out.lift = last.lift + (touch - last.touch)
    out.height = height
    out.touch = touch
    out.known = known
    return out


@wp.func
def meets(rise: Rise, plane: Plane, v: wp.vec3d, step: Step) -> bool:
    """Whether a ball may touch the ground that moved under it before the step ends."""
    way = (wp.length(v) * plane.length + _HALF * step.gravity * step.dt) * step.dt
    return rise.clear <= way + wp.abs(rise.rise)


@wp.func
def boarded(
    body: Body, rise: Rise, plane: Plane, material: Material, rubs: wp.float64, step: Step
) -> Body:
    """A ball as the ground sees it that moved under it.

    One that lay on it is at once as fast as the ground along the normal, without a bounce. The part
    ``rubs`` of its friction acts then: 1, or 0 where friction does not go by the velocity alone.
    """
    out = body
    out.v[2] = body.v[2] - rise.rise / step.dt
    if rise.clear > _TOUCH:
        out.z = body.z + rise.rise
        return out
    out.z = body.z + rise.lift
    if closing(plane, out.v) < _ZERO:
        limp = material
        limp.restitution = _ZERO
        limp.friction = rubs * material.friction
        out.v = strike(plane, out.v, limp, step)
    return out


@wp.kernel(enable_backward=False)
def look(
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
    """Look at the ground without detail under a ball, before and after it changes."""
    i = wp.tid()
    lattice.factor = 1
    body = loaded(cell[i], offset[i], z[i], wp.vec3d(), _ZERO)
    plane = seated(plane_of(pool, table, lattice, body), upright)
    rise[i] = looked(rise[i], plane, body, material[i].radius, lattice.spacing, when)


@wp.kernel(enable_backward=False)
def board(
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
    """See a ball from the ground without detail that moved under it."""
    i = wp.tid()
    lattice.factor = 1
    rate[i] = _ZERO
    if rise[i].rise == _ZERO and rise[i].lift == _ZERO:
        return
    body = loaded(cell[i], offset[i], z[i], velocity[i], step.dt)
    plane = seated(plane_of(pool, table, lattice, body), step.upright)
    if meets(rise[i], plane, body.v, step):
        body = boarded(body, rise[i], plane, material[i], rubs, step)
        z[i] = body.z
        velocity[i] = body.v
        rate[i] = rise[i].rise / step.dt


@wp.kernel(enable_backward=False)
def leave_ground(
    # In:
    rate: wp.array(dtype=wp.float64),
    # In and out:
    velocity: wp.array(dtype=wp.vec3d),
):
    """See a ball from the datum again."""
    i = wp.tid()
    if rate[i] != _ZERO:
        v = velocity[i]
        velocity[i] = wp.vec3d(v[0], v[1], v[2] + rate[i])
