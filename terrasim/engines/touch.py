"""First contact: when and where, found the same way for every engine.

An engine says in which of its steps a ball first met the ground, and which plane it met. From the
ball's state there, still undisturbed, it is flown on (or back) along the parabola to the time at
which the sphere touches that plane.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


@dataclass
class Touches:
    """First contacts of balls; NaN for those that had none."""

    time_s: Floats
    """When, shape ``(count,)`` [s]."""
    centre: Floats
    """Where the centre was, shape ``(count, 3)`` [m]."""

    @classmethod
    def none(cls, count: int) -> Touches:
        """No contact yet."""
        return cls(np.full(count, np.nan), np.full((count, 3), np.nan))

    @property
    def open(self) -> npt.NDArray[np.bool_]:
        """Balls that have had none."""
        return np.isnan(self.time_s)

    def note(
        self, which: npt.NDArray[np.int64], time_s: float, later: Floats, centre: Floats
    ) -> None:
        """Enter the contacts of some balls, ``later`` than a time."""
        self.time_s[which] = time_s + later
        self.centre[which] = centre


def meeting(gap: Floats, normal: Floats, velocity: Floats, gravity: float) -> Floats:
    """In how long spheres touch planes [s]; negative if they have done so.

    Args:
        gap: Distance between sphere and plane [m], negative if they overlap.
        normal: Unit normals of the planes, shape ``(count, 3)``.
        velocity: Velocities, shape ``(count, 3)`` [m/s].
        gravity: Downward acceleration [m/s^2].

    Returns:
        The root of ``gap + rate t + pull t^2 / 2`` on the way in, in the form that does not cancel;
        0 for what does not come nearer.
    """
    rate = np.einsum("ij,ij->i", normal, velocity)
    pull = -gravity * normal[:, 2]
    root = np.sqrt(np.maximum(rate * rate - 2.0 * pull * gap, 0.0))
    nearer = root - rate
    return np.where(nearer > 0.0, 2.0 * gap / np.where(nearer > 0.0, nearer, 1.0), 0.0)


def flown(place: Floats, velocity: Floats, times: Floats, gravity: float) -> Floats:
    """Places after some time of flight, shape ``(count, 3)`` [m]."""
    later = place + velocity * times[:, None]
    later[:, 2] -= 0.5 * gravity * times * times
    return np.asarray(later)
