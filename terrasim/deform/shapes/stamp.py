"""What every stamp has: a place, a way of meeting the ground, and the members of its formula."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import KW_ONLY, dataclass, replace
from typing import ClassVar, Literal, Self, get_args

import numpy as np
import numpy.typing as npt

from terrasim.deform.shapes.checks import check_fields, refuse

Mode = Literal["add", "dig", "fill", "replace", "blend"]
Extent = tuple[float, float, float, float]
Shape = tuple[float, float, float, float]
Data = npt.NDArray[np.float64]

HIGHEST_Z = 1e9
"""Largest distance of ``z`` from 0 [m]."""


@dataclass(frozen=True)
class Bounds:
    """How wild a stamp is: from these follows what a coarse level can miss of it."""

    lowest: float
    """The least it adds anywhere, at most 0 [m]."""
    highest: float
    """The most it adds anywhere, at least 0 [m]."""
    slope: float
    """Its steepest slope [-]; infinite where it has a step."""
    curvature: float
    """Largest second derivative in any direction [1/m]; infinite where it has a kink."""


@dataclass(frozen=True)
class Stamp(ABC):
    """A shape at a place.

    A shape has a height and a weight from 0 to 1 at each place of its footprint. At a post of
    height ``h``, with ``t = z + height`` the stamp's own surface, the modes make of it::

        add:     h + height
        dig:     min(h, t)
        fill:    max(h, t)
        replace: t
        blend:   h + weight * (t - h)

    Adding is free of order to the bit and can be undone; the others take effect one after another.
    """

    x: float
    """Its place, metres east of the anchor post."""
    y: float
    """Its place, metres north of the anchor post."""
    _: KW_ONLY
    mode: Mode = "add"
    """How it meets the ground: add, dig (never raise), fill (never lower), replace or blend."""
    z: float | None = None
    """World height that its heights are counted from [m]; what is added has none."""
    detail: bool = False
    """Whether it changes the detail grid instead of the terrain's own posts."""

    kind: ClassVar[int]
    """Its formula in ``kernels/shapes.py``."""
    name: ClassVar[str]
    """What files and errors call it."""
    lengths: ClassVar[tuple[str, ...]]
    """Its own fields that grow with its size."""
    modes: ClassVar[tuple[str, ...]] = get_args(Mode)
    """How it can meet the ground."""

    def __post_init__(self) -> None:
        """Refuse what is no such stamp."""
        check_fields(self, self.name)
        if self.mode not in self.modes:
            refuse(self.name, "mode", f"be {' or '.join(self.modes)}", repr(self.mode))
        if self.mode == "add" and self.z is not None:
            refuse(self.name, "z", "be left out for mode add, which starts from the ground", self.z)
        if self.mode != "add" and self.z is None:
            refuse(self.name, "z", f"be given for mode {self.mode}: a world height [m]", None)
        if self.z is not None and abs(self.z) > HIGHEST_Z:
            refuse(self.name, "z", f"stay within {HIGHEST_Z:g} m", self.z)
        self._check()

    @abstractmethod
    def _check(self) -> None:
        """Refuse what the shape alone forbids; the fields have their types by then."""

    @property
    @abstractmethod
    def extent(self) -> Extent:
        """Where it may change anything: west, south, east and north end [m from its place]."""

    @property
    @abstractmethod
    def volume(self) -> float:
        """Volume that it adds to ground without edges or holes, less what it removes [m^3].

        NaN where there is no closed form.
        """

    @property
    @abstractmethod
    def bounds(self) -> Bounds:
        """How wild it is."""

    @property
    @abstractmethod
    def shape(self) -> Shape:
        """The numbers ``a`` to ``d`` of its formula; heights in metres."""

    @property
    def data(self) -> Data:
        """What else its formula reads, float64, shape ``(count,)``; nothing for most."""
        return np.empty(0)

    @property
    def reach(self) -> float:
        """Half the side of the square around its place that holds its extent [m]."""
        return max(map(abs, self.extent))

    def scaled(self, factor: float) -> Self:
        """The same shape with all its lengths, heights included, times a factor."""
        own = {name: getattr(self, name) for name in self.lengths}
        return replace(self, **{name: v * factor for name, v in own.items() if v is not None})


def disc(radius: float) -> Extent:
    """The extent of what is round."""
    return (-radius, -radius, radius, radius)


KINK = math.inf
"""The curvature of a kink, and the slope of a step."""
