"""Balls in two engines on the same ground: how far apart they touch it and come to rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from terrasim.engines.hfield import Floats
from terrasim.engines.track import REST_SPEED, Flags, Track


@dataclass(frozen=True)
class Drop:
    """What both engines were given."""

    count: int
    """Number of balls."""
    dt: float
    """Step [s]."""
    duration: float
    """Time run [s]."""
    gravity: float
    """Downward acceleration [m/s^2]."""
    restitution: float
    """Asked of both; MuJoCo has a spring and a damper that give it."""
    friction: float
    """Coulomb's coefficient."""
    rolling: float | None
    """Coefficient of rolling friction; None for balls that do not turn."""
    rows: int
    """Rows of posts of the ground."""
    cols: int
    """Columns likewise."""
    spacing: float
    """Distance between posts [m]."""
    range: float
    """Heights of the ground from lowest to highest [m]."""


@dataclass(frozen=True)
class Spread:
    """Differences over balls: their number, median, nine in ten, and the largest."""

    count: int
    median: float
    most: float
    """90 of 100 are no larger."""
    largest: float

    @classmethod
    def of(cls, values: Floats) -> Spread:
        """Of sizes; NaN of none."""
        if len(values) == 0:
            return cls(0, np.nan, np.nan, np.nan)
        sizes = np.abs(values)
        quantiles = np.quantile(sizes, [0.5, 0.9])
        return cls(len(sizes), float(quantiles[0]), float(quantiles[1]), float(sizes.max()))


@dataclass(frozen=True)
class Comparison:
    """Both engines' balls, and the differences between them.

    Balls that MuJoCo buried, dropped through or that left the window at the end lie outside the
    range in which it is valid; they are counted and enter no difference at rest.
    """

    drop: Drop
    """What both were given."""
    ours: Track
    """This engine's balls."""
    theirs: Track
    """MuJoCo's."""
    version: str
    """MuJoCo's version."""

    @property
    def touched(self) -> Flags:
        """Balls that touched the ground in both."""
        return ~(self.ours.touches.open | self.theirs.touches.open)

    @property
    def rest(self) -> Flags:
        """Balls that came to rest on the ground in both."""
        return self.ours.rests & self.theirs.rests

    @property
    def late_s(self) -> Floats:
        """By how much ours touch the ground later than theirs, of those that touched [s]."""
        late = self.ours.touches.time_s - self.theirs.touches.time_s
        return np.asarray(late[self.touched])

    @property
    def touch_m(self) -> Floats:
        """Distances of the centres at first contact [m]."""
        apart = self.ours.touches.centre - self.theirs.touches.centre
        return np.asarray(np.linalg.norm(apart[self.touched], axis=1))

    @property
    def rest_m(self) -> Floats:
        """Distances of the centres at rest, seen from above [m]."""
        apart = self.ours.place - self.theirs.place
        return np.asarray(np.linalg.norm(apart[self.rest, :2], axis=1))

    @property
    def rest_high_m(self) -> Floats:
        """How much higher ours rest than theirs [m]."""
        apart = self.ours.place[:, 2] - self.theirs.place[:, 2]
        return np.asarray(apart[self.rest])

    @property
    def cost_ratio(self) -> float:
        """MuJoCo's CPU time for a ball and step over ours."""
        return self.theirs.step_us / self.ours.step_us

    def counts(self) -> dict[str, tuple[int, int]]:
        """Balls by what became of them: ours, theirs."""
        here, there = _flags(self.ours), _flags(self.theirs)
        return {name: (int(here[name].sum()), int(there[name].sum())) for name in here}


def _flags(one: Track) -> dict[str, Flags]:
    return {
        "touched the ground": ~one.touches.open,
        f"at rest (under {REST_SPEED * 1e3:g} mm/s)": one.rests,
        "buried": one.buried,
        "dropped through": one.through,
        "left the window": one.left,
    }
