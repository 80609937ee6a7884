"""Free flight: a parabola."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from terrasim.study.exact.motion import Motion, Solution, Vector


@dataclass(frozen=True)
class Flight(Solution):
    """A ball that meets nothing."""

    position: Vector
    """Centre at first [m]."""
    velocity: Vector
    """Velocity at first [m/s]."""
    spin: Vector = (0.0, 0.0, 0.0)
    """Spin, which stays [rad/s]."""
    gravity: float = 9.81
    """Gravity, downward [m/s^2]."""

    def at(self, time_s: npt.ArrayLike) -> Motion:
        """The motion at times from the start on [s]."""
        t = np.asarray(time_s, dtype=np.float64)[..., None]
        down = np.array([0.0, 0.0, -self.gravity])
        velocity = np.array(self.velocity)
        return Motion(
            np.array(self.position) + velocity * t + 0.5 * down * t * t,
            velocity + down * t,
            np.array(self.spin) + 0.0 * t,
        )
