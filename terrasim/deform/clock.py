"""The time of something that lasts for a while."""

from __future__ import annotations

import math
from dataclasses import dataclass

from terrasim.errors import InputError

_SLACK = 1e-9
"""A time this part of the duration short of the end is the end: sums of steps round."""


@dataclass
class Clock:
    """How much of a duration has gone."""

    name: str
    """What errors call it."""
    duration_s: float
    """How long it lasts [s]."""
    time_s: float = 0.0
    """How much of that has gone [s]."""

    @property
    def done(self) -> bool:
        """Whether all of it has."""
        return self.time_s >= self.duration_s

    @property
    def part(self) -> float:
        """How much has gone, 0 to 1."""
        return self.time_s / self.duration_s

    def go(self, dt_s: float) -> float:
        """Let time go on, at most to the end; returns by how much [s].

        Raises:
            InputError: If the time is negative or no finite number.
        """
        if not (math.isfinite(dt_s) and dt_s >= 0.0):
            raise InputError(f"{self.name}: dt_s must be at least 0 s and finite, got {dt_s}")
        before, after = self.time_s, self.time_s + dt_s
        if after >= self.duration_s * (1.0 - _SLACK):
            self.time_s = self.duration_s
            return min(dt_s, self.duration_s - before)
        self.time_s = after
        return dt_s


def check_duration(name: str, duration_s: float) -> None:
    """Refuse a duration of nothing.

    Raises:
        InputError: With name, field, rule and value.
    """
    if not (math.isfinite(duration_s) and duration_s > 0.0):
        raise InputError(f"{name}: duration_s must be above 0 s and finite, got {duration_s}")
