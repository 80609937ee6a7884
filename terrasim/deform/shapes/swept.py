"""Trenches and berms: a cross-section swept along a polyline."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from typing import ClassVar, Literal, Self

import numpy as np

from terrasim.deform.shapes.checks import (
    check_height,
    check_not_negative,
    check_size,
    refuse,
)
from terrasim.deform.shapes.cross_section import CrossSection, Profile
from terrasim.deform.shapes.polyline import (
    check_points,
    is_closed,
    length,
    tree,
    turns,
)
from terrasim.deform.shapes.stamp import KINK, Bounds, Data, Extent, Shape, Stamp
from terrasim.kernels.shapes import SWEPT


@dataclass(frozen=True)
class _Swept(Stamp):
    """What runs along a polyline.

    The height at a place is the cross-section's at the distance ``s`` from there to the nearest
    point of the polyline: bends are joined without a gap, rounded on their outside, and nothing
    counts twice where the line comes near itself or crosses itself. The weight is the height over
    that in the middle. Round ends are half of the section turned about the end point; flat ones
    stop at right angles to the line. A line that ends where it begins has no ends.
    """

    points: Sequence[tuple[float, float]]
    """Places it runs through [m from its place], at least 2: east and north."""
    width: float
    """Its whole width, at the ground before [m]."""
    _: KW_ONLY
    section: Profile = "v"
    """Its cross-section: v, box (a flat with straight sides) or round (an arc of a circle)."""
    side: float = 0.0
    """Width of each side of a box [m], at most half the width; 0 is an upright wall."""
    ends: Literal["round", "flat"] = "round"
    """How it ends: half of the section turned about the end, or cut off at right angles."""

    kind: ClassVar[int] = SWEPT

    @property
    @abstractmethod
    def middle(self) -> float:
        """Height along the line [m]."""

    def _check(self) -> None:
        object.__setattr__(self, "points", check_points(self.points, self.name))
        check_size(self.width, self.name, "width")
        check_not_negative(self.side, self.name, "side")
        if self.section != "box" and self.side != 0.0:
            refuse(self.name, "side", f"be left out of section {self.section}", self.side)
        if self.side > self.width / 2.0:
            refuse(self.name, "side", f"be at most half the width ({self.width:g} m)", self.side)
        field = self.lengths[-1]
        height = getattr(self, field)
        check_not_negative(height, self.name, field)
        check_height(height, self.name, field)
        if self.section == "round" and height > self.width / 2.0:
            rule = f"be at most half the width ({self.width:g} m) of an arc of a circle"
            refuse(self.name, field, rule, height)

    @property
    def cross_section(self) -> CrossSection:
        """Its cross-section, upwards."""
        half = self.width / 2.0
        side = half if self.section == "v" else self.side
        return CrossSection(self.section, half, abs(self.middle), side)

    @property
    def extent(self) -> Extent:
        """The box of its points and half a width around [m]."""
        places, half = np.asarray(self.points), self.width / 2.0
        west, south = (places.min(axis=0) - half).tolist()
        east, north = (places.max(axis=0) + half).tolist()
        return (west, south, east, north)

    @property
    def volume(self) -> float:
        """Section times length, and what ends and bends add [m^3].

        A bend by the angle ``t`` adds ``(t - 2 tan(t / 2))`` times the section's moment, which is
        less than nothing; a pair of round ends adds ``2 pi`` times it. NaN where a piece is
        shorter than its bends take; not exact where pieces that do not meet come nearer than the
        width.
        """
        section = self.cross_section
        bends = turns(self.points)
        taken = section.half * np.tan(np.minimum(bends, 0.999 * np.pi) / 2.0)
        ahead = np.roll(taken, 1) if is_closed(self.points) else np.append(0.0, taken)
        behind = taken if is_closed(self.points) else np.append(taken, 0.0)
        pieces = np.hypot(*np.diff(np.asarray(self.points), axis=0).T)
        if (ahead + behind > pieces).any():
            return math.nan
        round_ends = self.ends == "round" and not is_closed(self.points)
        turned = float((bends - 2.0 * np.tan(bends / 2.0)).sum()) + 2.0 * math.pi * round_ends
        volume = section.area * length(self.points) + section.moment * turned
        return math.copysign(volume, self.middle)

    @property
    def bounds(self) -> Bounds:
        """As steep as its section; it has kinks, and steps at flat ends."""
        cut = self.ends == "flat" and not is_closed(self.points)
        slope = KINK if cut else self.cross_section.slope
        return Bounds(min(0.0, self.middle), max(0.0, self.middle), slope, KINK)

    @property
    def shape(self) -> Shape:
        """Height and half width [m], width of a side [m] or -1 for an arc, 1 for flat ends."""
        section = self.cross_section
        side = -1.0 if self.section == "round" else section.side
        cut = self.ends == "flat" and not is_closed(self.points)
        return (self.middle, section.half, side, float(cut))

    @cached_property
    def data(self) -> Data:
        """Its polyline with a tree over it, as ``kernels/swept.py`` reads it."""
        return tree(self.points)

    def scaled(self, factor: float) -> Self:
        """The same with all lengths, its points' too, times a factor."""
        grown = super().scaled(factor)
        return replace(grown, points=tuple((x * factor, y * factor) for x, y in self.points))


@dataclass(frozen=True)
class Trench(_Swept):
    """A trench along a polyline: its cross-section downwards.

    The height is ``-depth`` times the section's part at the distance to the polyline: ``1 - s /
    half`` for a v, an arc for round, and for a box 1 up to ``half - side`` and straight to 0 from
    there. See :class:`CrossSection`. Its volume is section times length, and what ends and bends
    add to that.
    """

    depth: float
    """Depth of its middle under the ground before [m]."""

    name: ClassVar[str] = "trench"
    lengths: ClassVar[tuple[str, ...]] = ("width", "side", "depth")

    @property
    def middle(self) -> float:
        """Height along the line [m]."""
        return -self.depth


@dataclass(frozen=True)
class Berm(_Swept):
    """A bank along a polyline: its cross-section upwards.

    The height is ``height`` times the section's part at the distance to the polyline: ``1 - s /
    half`` for a v, an arc for round, and for a box 1 up to ``half - side`` and straight to 0 from
    there. See :class:`CrossSection`. Its volume is section times length, and what ends and bends
    add to that.
    """

    height: float
    """Height of its middle above the ground before [m]."""

    name: ClassVar[str] = "berm"
    lengths: ClassVar[tuple[str, ...]] = ("width", "side", "height")

    @property
    def middle(self) -> float:
        """Height along the line [m]."""
        return self.height
