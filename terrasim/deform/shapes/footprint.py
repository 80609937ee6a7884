"""Stamps that have a footprint of their own: a disc or a turned rectangle, fading out around it."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass

import numpy as np

from terrasim.deform.shapes.checks import check_not_negative, check_size, refuse
from terrasim.deform.shapes.stamp import Data, Extent, Stamp


@dataclass(frozen=True)
class Windowed(Stamp):
    """A stamp on a footprint: either a radius or two sizes.

    Its weight is 1 there and falls outside over the fade as ``t^2 (3 - 2 t)``, ``t`` from 1 to 0.
    """

    _: KW_ONLY
    radius: float | None = None
    """Radius of a footprint that is a disc [m]."""
    size_x: float | None = None
    """Width of one that is a rectangle, along x before it is turned [m]."""
    size_y: float | None = None
    """Its width along y before it is turned [m]."""
    turn_deg: float = 0.0
    """By how much the rectangle is turned, counter-clockwise from above [degrees]."""
    fade: float = 0.0
    """Width outside the footprint over which it fades [m]; 0 is a step."""

    def _check(self) -> None:
        sizes = {"size_x": self.size_x, "size_y": self.size_y}
        if self.radius is not None:
            check_size(self.radius, self.name, "radius")
            for field, size in sizes.items():
                if size is not None:
                    refuse(self.name, field, "be left out beside radius", size)
        for field, size in sizes.items():
            if self.radius is None:
                if size is None:
                    rule = "be given: a footprint has a radius, or size_x and size_y"
                    refuse(self.name, field, rule, None)
                check_size(size, self.name, field)
        check_not_negative(self.fade, self.name, "fade")
        if self.fade > 0.0:
            check_size(self.fade, self.name, "fade")

    @property
    def halves(self) -> tuple[float, float]:
        """Half its sides [m]; 0 for a disc."""
        return (self.size_x or 0.0) / 2.0, (self.size_y or 0.0) / 2.0

    @property
    def extent(self) -> Extent:
        """The box of the footprint with its fade [m]."""
        wide, high = turned_box(*self.halves, self.turn_deg)
        more = (self.radius or 0.0) + self.fade
        return (-wide - more, -high - more, wide + more, high + more)

    @property
    def footprint(self) -> Data:
        """The footprint as ``kernels/footprint.py`` reads it."""
        turn = turn_of(self.turn_deg)
        return np.array([*self.halves, self.radius or 0.0, self.fade, *turn])

    @property
    def fade_slope(self) -> float:
        """Steepest slope of the weight [1/m]."""
        return 1.5 / self.fade if self.fade > 0.0 else math.inf


def turn_of(degrees: float) -> tuple[float, float]:
    """Cosine and sine of an angle, exact for right angles."""
    angle = math.fmod(degrees, 360.0)
    quarter = round(angle / 90.0)
    rest = math.radians(angle - 90.0 * quarter)
    cosine, sine = math.cos(rest), math.sin(rest)
    return ((cosine, sine), (-sine, cosine), (-cosine, -sine), (sine, -cosine))[quarter % 4]


def turned_box(half_x: float, half_y: float, degrees: float) -> tuple[float, float]:
    """Half the sides of the box that holds a turned rectangle [m]."""
    cosine, sine = (abs(part) for part in turn_of(degrees))
    return half_x * cosine + half_y * sine, half_x * sine + half_y * cosine
