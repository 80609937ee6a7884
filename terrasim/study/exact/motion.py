"""Where a ball is and how it moves, and motions made of stretches of even acceleration."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Vector = tuple[float, float, float]

SOLID = 0.4
"""Moment of inertia of a solid sphere over mass and radius squared."""


@dataclass(frozen=True)
class Motion:
    """State at some times, arrays of shape ``(..., 3)`` for times of shape ``(...)``."""

    position: Floats
    """Centre [m]; z is up."""
    velocity: Floats
    """Velocity [m/s]."""
    spin: Floats
    """Spin [rad/s]."""

    def energy(self, gravity: float = 9.81, radius: float = 0.0) -> Floats:
        """Energy for a kilogram [J/kg], 0 at rest at z = 0; ``radius`` [m] is that of the spin."""
        turning = 0.5 * SOLID * radius**2 * np.sum(self.spin**2, axis=-1)
        moving = 0.5 * np.sum(self.velocity**2, axis=-1)
        found: Floats = moving + turning + gravity * self.position[..., 2]
        return found


class Solution(ABC):
    """A motion known in closed form."""

    @abstractmethod
    def at(self, time_s: npt.ArrayLike) -> Motion:
        """The motion at times from the start on [s], of any shape."""


@dataclass(frozen=True)
class Stretch:
    """Straight motion under even acceleration, until the next stretch."""

    begins_s: float
    """When it begins [s]."""
    way: float
    """Distance from the start then [m]."""
    speed: float
    """Speed then [m/s]."""
    acceleration: float
    """Acceleration [m/s^2]."""
    turn: float = 0.0
    """Spin times radius then [m/s]: the speed itself where a ball rolls."""
    turn_rate: float = 0.0
    """How fast that changes [m/s^2]."""

    def then(self, begins_s: float, acceleration: float, turn_rate: float = 0.0) -> Stretch:
        """The stretch that follows it."""
        t = begins_s - self.begins_s
        return Stretch(
            begins_s,
            self.way + self.speed * t + 0.5 * self.acceleration * t * t,
            self.speed + self.acceleration * t,
            acceleration,
            self.turn + self.turn_rate * t,
            turn_rate,
        )

    def stopped(self, begins_s: float) -> Stretch:
        """Rest from then on, without what rounding leaves of the speed."""
        return Stretch(begins_s, self.then(begins_s, 0.0).way, 0.0, 0.0)


def along(time_s: npt.ArrayLike, stretches: Sequence[Stretch]) -> tuple[Floats, Floats, Floats]:
    """Distance [m], speed [m/s] and spin times radius [m/s] at times [s]."""
    time = np.asarray(time_s, dtype=np.float64)
    begins = [one.begins_s for one in stretches]
    which = np.clip(np.searchsorted(begins, time, side="right") - 1, 0, None)
    fields = ("begins_s", "way", "speed", "acceleration", "turn", "turn_rate")
    table = np.array([[getattr(one, name) for name in fields] for one in stretches])
    begun, way, speed, acceleration, turn, turn_rate = np.moveaxis(table[which], -1, 0)
    t = time - begun
    return (
        way + speed * t + 0.5 * acceleration * t * t,
        speed + acceleration * t,
        turn + turn_rate * t,
    )
