"""Ground made even: level, or a plane."""

from __future__ import annotations

import math
from dataclasses import KW_ONLY, dataclass
from typing import ClassVar

from terrasim.deform.shapes.checks import TALLEST, refuse
from terrasim.deform.shapes.footprint import Windowed
from terrasim.deform.shapes.stamp import Bounds, Data, Mode, Shape
from terrasim.kernels.shapes import FLATTEN


@dataclass(frozen=True)
class Flatten(Windowed):
    """Ground made even, to a height or to a plane, over a disc or a turned rectangle.

    Its surface is ``z + slope_x * dx + slope_y * dy`` at the distances ``dx`` east and ``dy`` north
    of its place. Blended, as it is by default, the ground becomes that within the footprint and
    goes over into what was there within the fade around it. Dug, only what stands above is taken
    away, up to the end of the fade; filled, only what lies below is raised.
    """

    _: KW_ONLY
    mode: Mode = "blend"
    """How it meets the ground: dig (never raise), fill (never lower), replace or blend."""
    slope_x: float = 0.0
    """Rise of the plane for each metre east [-]."""
    slope_y: float = 0.0
    """Rise of the plane for each metre north [-]."""

    kind: ClassVar[int] = FLATTEN
    name: ClassVar[str] = "flatten"
    lengths: ClassVar[tuple[str, ...]] = ("radius", "size_x", "size_y", "fade")
    modes: ClassVar[tuple[str, ...]] = ("blend", "dig", "fill", "replace")

    def _check(self) -> None:
        super()._check()
        if self._rise > TALLEST:
            field = "slope_x" if abs(self.slope_x) >= abs(self.slope_y) else "slope_y"
            rule = f"keep the plane within {TALLEST:.0f} m of z over its footprint"
            refuse(self.name, field, rule, getattr(self, field))

    @property
    def _rise(self) -> float:
        """The most that the plane rises from its place within its extent [m]."""
        _, _, east, north = self.extent
        return abs(self.slope_x) * east + abs(self.slope_y) * north

    @property
    def volume(self) -> float:
        """NaN: it depends on the ground."""
        return math.nan

    @property
    def bounds(self) -> Bounds:
        """Those of its plane over the ground's ``z``; without a fade it has a step."""
        slope = math.hypot(self.slope_x, self.slope_y) + self._rise * self.fade_slope
        return Bounds(-self._rise, self._rise, slope, math.inf)

    @property
    def shape(self) -> Shape:
        """The slopes of its plane [-]."""
        return (self.slope_x, self.slope_y, 0.0, 0.0)

    @property
    def data(self) -> Data:
        """Its footprint."""
        return self.footprint
