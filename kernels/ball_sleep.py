"""Balls that rest: which of them may sleep."""

import warp as wp

from terrasim.kernels.balls import Tally


@wp.struct
class Seen:
    """A ball when it was last looked at."""

    z: wp.float64
    """Centre above the datum [m]."""
    odd: int
    """Steps off the terrain, over holes or on coarser levels until then."""


@wp.kernel(enable_backward=False)
def doze(
    still: wp.float64,
    # In and out, of all balls:
    seen: wp.array(dtype=Seen),
    # In:
    number: wp.array(dtype=int),
    z: wp.array(dtype=wp.float64),
    velocity: wp.array(dtype=wp.vec3d),
    tally: wp.array(dtype=Tally),
    # Out:
    rests: wp.array(dtype=wp.uint8),
):
    """Whether a ball rests: as slow as ``still``, no higher or lower than last time.

    Ground that is not the terrain's own at level 0 may change without an edit: not on that.
    """
    i = wp.tid()
    now = Seen()
    now.z = z[i]
    now.odd = tally[i].off + tally[i].hole + tally[i].coarse
    last = seen[number[i]]
    slow = wp.length(velocity[i]) <= still and wp.abs(now.z - last.z) <= still
    rests[i] = wp.uint8(wp.where(slow and now.odd == last.odd, 1, 0))
    seen[number[i]] = now
