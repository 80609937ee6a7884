"""Balls on a plane, straight up or down its slope: sliding without turning, slipping, rolling.

With the slope's angle ``a``: what slides down is sped up by ``g (sin a - mu cos a)``. A ball that
turns slips at first and gains ``5/2 mu g cos a`` of spin times radius; once that is the speed it
rolls, with ``5/7 g (sin a - c cos a)`` under rolling friction ``c``. It can roll where
``tan a <= 7/2 mu``. On flat ground a ball of speed ``v`` rolls from ``2 v / (7 mu g)`` on, at
``5/7 v`` after ``12 v^2 / (49 mu g)``.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from terrasim.errors import InputError
from terrasim.study.exact.motion import SOLID, Floats, Motion, Solution, Stretch, Vector, along

_STRAIGHT = 1e-9
"""Part of the speed that may point away from the line of fall."""


@dataclass(frozen=True)
class OnPlane(Solution):
    """A ball on a plane that moves along its line of fall, or any way where it is flat."""

    position: Vector
    """Centre at first [m]."""
    velocity: Vector
    """Velocity at first, along the plane's line of fall [m/s]."""
    normal: Vector = (0.0, 0.0, 1.0)
    """Upward normal of the plane."""
    friction: float = 0.5
    """Coefficient of friction."""
    radius: float = 1.0
    """Radius of the ball [m]."""
    rolling: float = 0.0
    """Coefficient of rolling friction."""
    gravity: float = 9.81
    """Gravity, downward [m/s^2]."""

    def __post_init__(self) -> None:
        """Refuse a motion that is not along a line.

        Raises:
            InputError: If the velocity points across the line of fall.
        """
        across = np.array(self.velocity) - self.speed * self.direction
        if np.linalg.norm(across) > _STRAIGHT * max(abs(self.speed), 1.0):
            raise InputError(
                "the velocity must lie along the plane's line of fall for a solution in closed "
                f"form, got {self.velocity}"
            )

    @property
    def up(self) -> Floats:
        """Unit normal."""
        normal = np.array(self.normal)
        unit: Floats = normal / np.linalg.norm(normal)
        return unit

    @property
    def direction(self) -> Floats:
        """Unit vector down the slope; on flat ground that of the velocity."""
        down = np.array([0.0, 0.0, -1.0])
        fall: Floats = down - self.up * float(down @ self.up)
        if np.linalg.norm(fall) < 1e-12:
            fall = np.array(self.velocity)
        length = float(np.linalg.norm(fall))
        return fall / length if length > 0.0 else np.array([1.0, 0.0, 0.0])

    @property
    def speed(self) -> float:
        """Speed at first, below 0 up the slope [m/s]."""
        return float(np.array(self.velocity) @ self.direction)

    @property
    def pull(self) -> float:
        """What gravity adds to the speed down the slope [m/s^2]."""
        return self.gravity * math.sqrt(max(0.0, 1.0 - float(self.up[2]) ** 2))

    @property
    def load(self) -> float:
        """What gravity presses on the plane for a kilogram [m/s^2]."""
        return self.gravity * float(self.up[2])

    @property
    @abstractmethod
    def stretches(self) -> tuple[Stretch, ...]:
        """The motion, stretch by stretch."""

    def at(self, time_s: npt.ArrayLike) -> Motion:
        """The motion at times from the start on [s]."""
        way, speed, turn = (one[..., None] for one in along(time_s, self.stretches))
        direction = self.direction
        axis = np.cross(self.up, direction)
        return Motion(
            np.array(self.position) + direction * way, direction * speed, axis * turn / self.radius
        )


@dataclass(frozen=True)
class Slide(OnPlane):
    """A body that slides and does not turn: it stays where it stops if friction holds it there."""

    @property
    def stretches(self) -> tuple[Stretch, ...]:
        """Up the slope, then down or at rest."""
        pull, brake, speed = self.pull, self.friction * self.load, self.speed
        # Under the friction that gravity just overcomes rounding must not decide.
        holds = pull <= brake * (1.0 + 1e-12)
        if speed == 0.0:
            return (Stretch(0.0, 0.0, 0.0, 0.0 if holds else pull - brake),)
        first = Stretch(0.0, 0.0, speed, pull - math.copysign(brake, speed))
        if speed > 0.0 and first.acceleration >= 0.0:
            return (first,)
        stops_s = -speed / first.acceleration
        rest = first.stopped(stops_s)
        return (first, rest if holds else Stretch(stops_s, rest.way, 0.0, pull - brake))

    @property
    def stop_s(self) -> float:
        """When it comes to rest for good [s]; infinite if it does not."""
        last = self.stretches[-1]
        return last.begins_s if last.speed == last.acceleration == 0.0 else math.inf


@dataclass(frozen=True)
class Roll(OnPlane):
    """A solid ball let go without spin, at rest or down the slope: it slips, then it rolls."""

    def __post_init__(self) -> None:
        """Refuse also a start up the slope.

        Raises:
            InputError: If the ball starts up the slope.
        """
        super().__post_init__()
        if self.speed < 0.0:
            raise InputError(f"a ball must start down the slope to be rolled, got {self.velocity}")

    @property
    def roll_s(self) -> float:
        """When it begins to roll [s]; infinite if it slips for ever."""
        # The contact point loses (1 + 1 / inertia) times what friction takes from the speed.
        loses = (1.0 + 1.0 / SOLID) * self.friction * self.load - self.pull
        if loses < -1e-12 * self.pull or (loses <= 0.0 and self.speed > 0.0):
            return math.inf
        return self.speed / loses if self.speed > 0.0 else 0.0

    @property
    def stretches(self) -> tuple[Stretch, ...]:
        """Slipping, rolling, and rest where rolling friction ends it."""
        brake, rolls_s = self.friction * self.load, self.roll_s
        slips = Stretch(0.0, 0.0, self.speed, self.pull - brake, 0.0, brake / SOLID)
        if math.isinf(rolls_s):
            return (slips,)
        gain = (self.pull - self.rolling * self.load) / (1.0 + SOLID)
        before = (slips,) if rolls_s > 0.0 else ()
        at = slips.then(rolls_s, 0.0)
        if at.speed == 0.0 and gain <= 0.0:
            return (*before, at.stopped(rolls_s))
        rolls = Stretch(rolls_s, at.way, at.speed, gain, at.speed, gain)
        if gain >= 0.0:
            return (*before, rolls)
        return (*before, rolls, rolls.stopped(rolls_s - at.speed / gain))
