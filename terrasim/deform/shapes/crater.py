"""A bowl with a raised rim."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from terrasim.deform.shapes.checks import check_height, check_not_negative, check_size, refuse
from terrasim.deform.shapes.stamp import KINK, Bounds, Extent, Shape, Stamp, disc
from terrasim.kernels.shapes import CRATER, RIM_END, RIM_REST

_RIM_PART = 2.0 * (1.0 - 1.0 / RIM_END - 0.5 * RIM_REST * (RIM_END**2 - 1.0)) / (1.0 - RIM_REST)
"""Volume of the rim beyond its crest over ``pi radius^2 rim_height``: 14/13."""


@dataclass(frozen=True)
class Crater(Stamp):
    """A bowl with a raised rim.

    With ``s = r / radius``, ``q = 3^-3`` and ``t = (s^-3 - q) / (1 - q)``::

        bowl, s <= 1:      (depth + rim_height) * s^2 - depth
        rim,  1 < s < 3:   rim_height * t
        beyond:            0

    The bowl is a paraboloid that rises to the rim's crest; outside, the rim falls off as the cube
    of the distance, as the ejecta of impact craters do, down to nothing at three radii.

    Its volume is ``pi radius^2 ((rim_height - depth) / 2 + 14/13 rim_height)``. A balanced crater
    has the rim that makes it 0, ``13/41 depth``: nothing is lost, as when soil is thrown aside.

    Its weight is 1 in the bowl and ``t`` on the rim.
    """

    radius: float
    """Distance of the rim's crest from the centre [m]."""
    depth: float
    """Depth of the bowl's floor under the ground before [m]."""
    rim_height: float = 0.0
    """Height of the rim's crest above the ground before [m]."""
    balanced: bool = False
    """Whether the rim holds what the bowl lost; its height then follows and is not given."""

    kind: ClassVar[int] = CRATER
    name: ClassVar[str] = "crater"
    lengths: ClassVar[tuple[str, ...]] = ("radius", "depth", "rim_height")

    def _check(self) -> None:
        check_size(self.radius, self.name, "radius")
        for field in ("depth", "rim_height"):
            check_not_negative(getattr(self, field), self.name, field)
            check_height(getattr(self, field), self.name, field)
        if self.balanced and self.rim_height != 0.0:
            rule = "be left out of a balanced crater, whose rim follows from its depth"
            refuse(self.name, "rim_height", rule, self.rim_height)

    @property
    def crest(self) -> float:
        """Height of the rim's crest above the ground before [m]."""
        return self.depth / (1.0 + 2.0 * _RIM_PART) if self.balanced else self.rim_height

    @property
    def extent(self) -> Extent:
        """Where the rim ends; the bowl's edge if it has none [m]."""
        return disc(self.radius * (RIM_END if self.crest > 0.0 else 1.0))

    @property
    def volume(self) -> float:
        """Rim less bowl [m^3]."""
        if self.balanced:
            return 0.0
        bowl = 0.5 * (self.rim_height - self.depth)
        return math.pi * self.radius**2 * (bowl + _RIM_PART * self.rim_height)

    @property
    def bounds(self) -> Bounds:
        """It is steepest at the crest, where it has a kink."""
        inside = 2.0 * (self.depth + self.crest) / self.radius
        outside = 3.0 * self.crest / (self.radius * (1.0 - RIM_REST))
        return Bounds(-self.depth, self.crest, max(inside, outside), KINK)

    @property
    def shape(self) -> Shape:
        """Squared radius [m^2], the bowl's rise a square metre [1/m], depth and rim [m]."""
        square = self.radius**2
        rim = self.crest / (1.0 - RIM_REST)
        return (square, (self.depth + self.crest) / square, self.depth, rim)
