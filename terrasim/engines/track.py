"""What an engine made of balls let go on the ground."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from terrasim.engines.hfield import Floats
from terrasim.engines.touch import Touches

REST_SPEED = 1e-3
"""Speed under which a ball counts as at rest [m/s]."""

Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Track:
    """One engine's balls; places in metres from the anchor, z in world metres."""

    touches: Touches
    """First contacts."""
    place: Floats
    """Centres at the end, shape ``(count, 3)`` [m]."""
    speed: Floats
    """Speeds at the end [m/s]."""
    through: Flags
    """Balls that ended under the ground's underside: dropped through."""
    buried: Flags
    """Balls whose centre ended in the ground: under its surface, over its underside."""
    left: Flags
    """Balls that ended beside the window."""
    step_s: Floats
    """Time of each step [s]."""
    setup_s: float
    """Time before the first step [s]: compiling, or loading kernels and ground."""
    cpu: bool = True
    """Whether times are CPU time of the calling thread; on a GPU they are wall time."""

    @property
    def count(self) -> int:
        """Number of balls."""
        return len(self.place)

    @property
    def valid(self) -> Flags:
        """Balls that are on the ground, or over it."""
        return ~(self.through | self.buried | self.left)

    @property
    def rests(self) -> Flags:
        """Valid balls that ended at rest."""
        return self.valid & (self.speed < REST_SPEED)

    @property
    def step_us(self) -> float:
        """Time of a ball and step [us], over all steps."""
        return float(self.step_s.mean()) / self.count * 1e6


def track(
    touches: Touches,
    place: Floats,
    velocity: Floats,
    *,
    height: Floats,
    floor: float,
    inside: Flags,
    step_s: Floats,
    setup_s: float,
    cpu: bool = True,
) -> Track:
    """Sort where balls ended: on the ground, in it, through it, beside it.

    Args:
        touches: First contacts.
        place: Centres at the end [m], shape ``(count, 3)``.
        velocity: Velocities at the end [m/s].
        height: World z of the ground under the centres [m].
        floor: World z of the ground's underside [m].
        inside: Balls that ended over or under the window.
        step_s: Time of each step [s].
        setup_s: Time before the first [s].
        cpu: Whether that is CPU time.
    """
    z = place[:, 2]
    return Track(
        touches,
        place,
        np.linalg.norm(velocity, axis=1),
        through=inside & (z <= floor),
        buried=inside & (z > floor) & (z < height),
        left=~inside,
        step_s=step_s,
        setup_s=setup_s,
        cpu=cpu,
    )
