"""How much of a stamp there is at each time of its growth or decay."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from terrasim.deform.shapes.checks import check_fields, finite, refuse

MOST_POINTS = 100_000
"""Points of a table."""


@dataclass(frozen=True)
class Profile(ABC):
    """A factor over the part of the time that has gone, 0 to 1."""

    name: ClassVar[str]
    """What files and errors call it."""

    def __post_init__(self) -> None:
        """Refuse what is no such profile."""
        check_fields(self, self.name)
        self._check()

    @abstractmethod
    def _check(self) -> None:
        """Refuse what the profile alone forbids."""

    @abstractmethod
    def factor(self, part: float) -> float:
        """How much of the stamp there is."""

    @abstractmethod
    def rate(self, part: float) -> float:
        """How fast that changes, for each whole duration."""

    @property
    @abstractmethod
    def largest(self) -> float:
        """The largest magnitude of the factor."""


@dataclass(frozen=True)
class _Ramp(Profile):
    """From one factor to another."""

    start: float = 0.0
    """Factor at the beginning."""
    finish: float = 1.0
    """Factor at the end."""

    def _check(self) -> None:
        """Any two factors will do."""

    def factor(self, part: float) -> float:
        """From ``start`` to ``finish``, both of them exact."""
        way = self._way(part)
        return self.start * (1.0 - way) + self.finish * way

    def rate(self, part: float) -> float:
        """The way's slope times the distance."""
        return (self.finish - self.start) * self._slope(part)

    @property
    def largest(self) -> float:
        """That of its ends."""
        return max(abs(self.start), abs(self.finish))

    @abstractmethod
    def _way(self, part: float) -> float:
        """How much of the way is behind it, 0 to 1."""

    @abstractmethod
    def _slope(self, part: float) -> float:
        """The slope of that."""


@dataclass(frozen=True)
class Linear(_Ramp):
    """Evenly from one factor to another."""

    name: ClassVar[str] = "linear"

    def _way(self, part: float) -> float:
        return part

    def _slope(self, part: float) -> float:
        return 1.0


@dataclass(frozen=True)
class Smoothstep(_Ramp):
    """From rest to rest: ``s^2 (3 - 2 s)`` of the way."""

    name: ClassVar[str] = "smoothstep"

    def _way(self, part: float) -> float:
        return part * part * (3.0 - 2.0 * part)

    def _slope(self, part: float) -> float:
        return 6.0 * part * (1.0 - part)


@dataclass(frozen=True)
class Exponential(Profile):
    """Falling from one factor towards another, as fast as it is away from it.

    ``finish + (start - finish) exp(-s / time_constant)``. It ends where the time does, short of
    ``finish``.
    """

    start: float = 1.0
    """Factor at the beginning."""
    finish: float = 0.0
    """Factor that it falls towards."""
    time_constant: float = 0.2
    """Part of the duration in which the distance falls to 1/e."""

    name: ClassVar[str] = "exponential"

    def _check(self) -> None:
        if self.time_constant <= 0.0:
            refuse(self.name, "time_constant", "be above 0", self.time_constant)

    def factor(self, part: float) -> float:
        """What is left of the distance."""
        left = math.exp(-part / self.time_constant)
        return self.start * left + self.finish * (1.0 - left)

    def rate(self, part: float) -> float:
        """The distance over the time constant."""
        left = math.exp(-part / self.time_constant)
        return (self.finish - self.start) * left / self.time_constant

    @property
    def largest(self) -> float:
        """That of its ends."""
        return max(abs(self.start), abs(self.finish))


@dataclass(frozen=True)
class Table(Profile):
    """Factors at some times, and straight lines between them."""

    times: tuple[float, ...]
    """Parts of the duration, rising, the first 0 and the last 1."""
    factors: tuple[float, ...]
    """The factor at each."""

    name: ClassVar[str] = "table"

    def _check(self) -> None:
        for field in ("times", "factors"):
            values = getattr(self, field)
            if not isinstance(values, tuple | list):
                refuse(self.name, field, "be a list of numbers", values)
            if not 2 <= len(values) <= MOST_POINTS:
                refuse(self.name, field, f"hold 2 to {MOST_POINTS} numbers", len(values))
            numbers = tuple(finite(one, self.name, field) for one in values)
            object.__setattr__(self, field, numbers)
        if len(self.times) != len(self.factors):
            rule = f"be as many as the times ({len(self.times)})"
            refuse(self.name, "factors", rule, len(self.factors))
        if self.times[0] != 0.0 or self.times[-1] != 1.0:
            refuse(self.name, "times", "run from 0 to 1", f"{self.times[0]} to {self.times[-1]}")
        if not (np.diff(self.times) > 0.0).all():
            refuse(self.name, "times", "rise", list(self.times))

    def factor(self, part: float) -> float:
        """Between its points, exact at them."""
        return float(np.interp(part, self.times, self.factors))

    def rate(self, part: float) -> float:
        """The slope of the line; at a point of the one that begins there, at the end the last."""
        i = int(np.searchsorted(self.times, part, side="right")) - 1
        i = min(max(i, 0), len(self.times) - 2)
        return (self.factors[i + 1] - self.factors[i]) / (self.times[i + 1] - self.times[i])

    @property
    def largest(self) -> float:
        """That of its points."""
        return max(abs(one) for one in self.factors)


PROFILES: dict[str, type[Profile]] = {
    kind.name: kind for kind in (Linear, Smoothstep, Exponential, Table)
}
"""Every profile by the name that files give it."""
