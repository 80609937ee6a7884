"""Cross-sections of trenches and berms: width, sides, area and moment."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from terrasim.deform.shapes.mounds import arc

Profile = Literal["v", "box", "round"]

_FLAT_ARC = 0.01
"""Half angle [rad] under which a segment's area comes from its series."""


@dataclass(frozen=True)
class CrossSection:
    """Half of a symmetric profile, as a function of the distance ``s`` from the middle.

    With ``half`` the half width: ``v`` is ``height * (1 - s / half)``, ``box`` is flat up to
    ``half - side`` and falls straight to 0 over ``side``, ``round`` is an arc of a circle.
    """

    profile: Profile
    """Which."""
    half: float
    """Half its width [m]."""
    height: float
    """Height in the middle [m], at least 0."""
    side: float
    """Width of a side [m]: all of a v, 0 for an upright wall; unused for an arc."""

    @property
    def area(self) -> float:
        """Area of both halves [m^2]."""
        if self.profile == "round":
            return _segment_area(self.half, self.height)
        return self.height * (2.0 * self.half - self.side)

    @property
    def moment(self) -> float:
        """Integral of ``s`` times the height over one half [m^3]: 1 / (2 pi) of it turned."""
        if self.profile == "round":
            return self.height * (3.0 * self.half**2 + self.height**2) / 12.0
        flat = self.half - self.side
        inner = flat**2 / 2.0 + flat * self.side / 2.0 + self.side**2 / 6.0
        return self.height * inner

    @property
    def slope(self) -> float:
        """Its steepest slope [-]; infinite at an upright wall."""
        if self.profile != "round":
            return self.height / self.side if self.side > 0.0 else math.inf
        bend, _ = arc(self.half, self.height)
        upright = 1.0 - bend * self.half**2
        return math.inf if upright <= 0.0 else math.sqrt(bend / upright) * self.half


def _segment_area(half: float, height: float) -> float:
    """Area between a circle's arc and its chord [m^2]."""
    angle = 2.0 * math.atan2(height, half)
    if angle == 0.0:
        return 0.0
    excess = angle - math.sin(angle) * math.cos(angle)
    if angle < _FLAT_ARC:
        # The difference above loses digits: its series, to a relative 1e-14.
        square = angle**2
        excess = angle * square * (2 / 3 - square * (2 / 15 - square * (4 / 315)))
    return (half / math.sin(angle)) ** 2 * excess
