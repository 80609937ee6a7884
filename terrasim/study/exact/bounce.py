"""Bounces on a flat floor without friction: parabolas between impacts, then rest.

After impact ``k`` the upward speed is ``e^k u``, with ``u`` the speed of the first impact, and the
flight lasts ``2 e^k u / g``: so heights are ``e^2k h``, and for ``e < 1`` the flights add up to a
time of rest, ``sqrt(2 h / g) (1 + e) / (1 - e)`` for a ball let go at rest from a height ``h``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from terrasim.study.exact.motion import Floats, Motion, Solution, Vector


@dataclass(frozen=True)
class Bounce(Solution):
    """A ball that bounces on a flat floor and keeps its speed along it."""

    position: Vector
    """Centre at first [m]."""
    velocity: Vector
    """Velocity at first [m/s]."""
    floor: float
    """Height of the centre where the ball touches the floor [m]."""
    restitution: float
    """Normal speed after an impact over that before, 0 to 1."""
    gravity: float = 9.81
    """Gravity, downward, above 0 [m/s^2]."""

    @property
    def impact_speed(self) -> float:
        """Speed downward of the first impact [m/s]."""
        gap = max(self.position[2] - self.floor, 0.0)
        return math.sqrt(self.velocity[2] ** 2 + 2.0 * self.gravity * gap)

    @property
    def first_impact_s(self) -> float:
        """Time of the first impact [s]."""
        return (self.velocity[2] + self.impact_speed) / self.gravity

    @property
    def rest_s(self) -> float:
        """Time from which it lies on the floor [s]; infinite if every bounce is as the last."""
        if self.restitution >= 1.0:
            return math.inf
        flights = 2.0 * self.impact_speed / self.gravity
        e = self.restitution
        return self.first_impact_s + flights * e / (1.0 - e)

    def apex(self, bounce: int) -> float:
        """Height over touching the floor that bounce ``bounce`` reaches, 1 the first [m]."""
        speed = self.restitution**bounce * self.impact_speed
        return speed * speed / (2.0 * self.gravity)

    def impact_s(self, number: npt.ArrayLike) -> Floats:
        """Times of impacts [s], 1 the first."""
        before = np.asarray(number, dtype=np.float64) - 1.0
        e, flight = self.restitution, 2.0 * self.impact_speed / self.gravity
        flights = before if e == 1.0 else e * (1.0 - e**before) / (1.0 - e)
        found: Floats = self.first_impact_s + flight * flights
        return found

    def impacts(self, time_s: npt.ArrayLike) -> Floats:
        """How many impacts there were by times before the rest, shape as ``time_s``."""
        t = np.asarray(time_s, dtype=np.float64) - self.first_impact_s
        e, flight = self.restitution, 2.0 * self.impact_speed / self.gravity
        done = np.clip(t, 0.0, None) / flight if flight > 0.0 else np.zeros_like(t)
        if e == 0.0:
            found = np.zeros_like(t)
        elif e == 1.0:
            found = np.floor(done)
        else:
            left = np.clip(1.0 - done * (1.0 - e) / e, 1e-300, None)
            found = np.floor(np.log(left) / math.log(e))
        return np.where(t >= 0.0, found + 1.0, 0.0)

    def at(self, time_s: npt.ArrayLike) -> Motion:
        """The motion at times from the start on [s]; at an impact it is that after it."""
        t = np.asarray(time_s, dtype=np.float64)
        rests = t >= self.rest_s
        count = self.impacts(np.where(rests, 0.0, t))
        # A count that rounding made one too high or low is found by the time it began.
        count = np.where(
            (count > 0) & (t < self.impact_s(np.maximum(count, 1.0))), count - 1, count
        )
        begun = np.where(count > 0, self.impact_s(np.maximum(count, 1.0)), 0.0)
        up = np.where(count > 0, self.restitution**count * self.impact_speed, self.velocity[2])
        height = np.where(count > 0, self.floor, self.position[2])
        flown = t - begun
        z = height + up * flown - 0.5 * self.gravity * flown**2
        vz = up - self.gravity * flown
        flat = np.ones_like(t)
        return Motion(
            np.stack(
                [
                    self.position[0] + self.velocity[0] * t,
                    self.position[1] + self.velocity[1] * t,
                    np.where(rests, self.floor, z),
                ],
                axis=-1,
            ),
            np.stack(
                [self.velocity[0] * flat, self.velocity[1] * flat, np.where(rests, 0.0, vz)],
                axis=-1,
            ),
            np.zeros((*t.shape, 3)),
        )
