"""Round stamps of one height and one size: hills, or hollows where the height is negative.

All are ``height * w(r)`` with ``w`` 1 in the middle, falling to 0 at the edge; ``w`` is also the
weight by which they blend into the ground.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import ClassVar

from terrasim.counts import COUNT_M
from terrasim.deform.shapes.checks import check_height, check_size, refuse
from terrasim.deform.shapes.stamp import KINK, Bounds, Extent, Shape, Stamp, disc
from terrasim.detail.grid import MAX_FACTOR
from terrasim.kernels.shapes import CONE, GAUSSIAN, HALF_COSINE, PARABOLOID, SPHERICAL_CAP

LEAST_WEIGHT = 1e-9
"""Where a gaussian ends that is not just added: there is no rounding to end it."""


@dataclass(frozen=True)
class Gaussian(Stamp):
    """A round hill, or a hollow: ``amplitude * exp(-r^2 / (2 sigma^2))``.

    Added, it ends where it falls under half a count, 5 ``sigma`` out for an amplitude of a metre:
    there rounding makes it nothing by itself, so there is no step. In the other modes it ends at
    6.4 ``sigma``, where its weight is a billionth.
    """

    amplitude: float
    """Height at the centre [m]; negative digs."""
    sigma: float
    """Standard deviation [m]."""

    kind: ClassVar[int] = GAUSSIAN
    name: ClassVar[str] = "gaussian"
    lengths: ClassVar[tuple[str, ...]] = ("amplitude", "sigma")

    def _check(self) -> None:
        check_size(self.sigma, self.name, "sigma")
        check_height(self.amplitude, self.name, "amplitude")

    @property
    def cut(self) -> float:
        """Distance at which it ends [m]."""
        times = 1.0 / LEAST_WEIGHT
        if self.mode == "add":
            # On the detail grid it ends as on the finest there may be.
            times = 2.0 * abs(self.amplitude) / COUNT_M * (MAX_FACTOR if self.detail else 1)
        return self.sigma * math.sqrt(2.0 * math.log(times)) if times > 1.0 else 0.0

    @property
    def extent(self) -> Extent:
        """The square around where it ends [m]."""
        return disc(self.cut)

    @property
    def volume(self) -> float:
        """``2 pi sigma^2 amplitude``, all of it [m^3]."""
        return 2.0 * math.pi * self.sigma**2 * self.amplitude

    @property
    def volume_to_cut(self) -> float:
        """The same up to where it ends [m^3]."""
        return -self.volume * math.expm1(-0.5 * (self.cut / self.sigma) ** 2)

    @property
    def bounds(self) -> Bounds:
        """It is steepest at ``sigma`` and bends most at its centre."""
        height = abs(self.amplitude)
        return Bounds(
            min(0.0, self.amplitude),
            max(0.0, self.amplitude),
            height * math.exp(-0.5) / self.sigma,
            height / self.sigma**2,
        )

    @property
    def shape(self) -> Shape:
        """Amplitude [m], the factor of the squared distance [1/m^2], its square at the end."""
        return (self.amplitude, -0.5 / self.sigma**2, self.cut**2, 0.0)


@dataclass(frozen=True)
class _Mound(Stamp):
    """What ends at a radius."""

    radius: float
    """Distance from the centre at which it ends [m]."""
    height: float
    """Height at the centre [m]; negative digs."""

    lengths: ClassVar[tuple[str, ...]] = ("radius", "height")

    def _check(self) -> None:
        check_size(self.radius, self.name, "radius")
        check_height(self.height, self.name, "height")

    @property
    def extent(self) -> Extent:
        """The square around it [m]."""
        return disc(self.radius)

    @property
    def bounds(self) -> Bounds:
        """It has a kink at its edge or its top."""
        steepest = abs(self.height) / self.radius * self._steepest
        return Bounds(min(0.0, self.height), max(0.0, self.height), steepest, KINK)

    @property
    @abstractmethod
    def _steepest(self) -> float:
        """Its steepest slope in heights a radius."""


@dataclass(frozen=True)
class ConeStamp(_Mound):
    """A cone: ``height * (1 - r / radius)``."""

    kind: ClassVar[int] = CONE
    name: ClassVar[str] = "cone"

    @property
    def volume(self) -> float:
        """``pi radius^2 height / 3`` [m^3]."""
        return math.pi * self.radius**2 * self.height / 3.0

    @property
    def shape(self) -> Shape:
        """Height [m], one over the radius [1/m], squared radius."""
        return (self.height, 1.0 / self.radius, self.radius**2, 0.0)

    @property
    def _steepest(self) -> float:
        return 1.0


@dataclass(frozen=True)
class Paraboloid(_Mound):
    """The cap of a paraboloid: ``height * (1 - r^2 / radius^2)``."""

    kind: ClassVar[int] = PARABOLOID
    name: ClassVar[str] = "paraboloid"

    @property
    def volume(self) -> float:
        """``pi radius^2 height / 2`` [m^3]."""
        return math.pi * self.radius**2 * self.height / 2.0

    @property
    def shape(self) -> Shape:
        """Height [m], one over the squared radius [1/m^2], squared radius."""
        return (self.height, 1.0 / self.radius**2, self.radius**2, 0.0)

    @property
    def _steepest(self) -> float:
        return 2.0


@dataclass(frozen=True)
class SphericalCap(_Mound):
    """The cap of a sphere over a disc, at most half of the sphere.

    The sphere has the radius ``R = (radius^2 + height^2) / (2 |height|)``, and the cap is
    ``sqrt(R^2 - r^2) - (R - |height|)``, downwards where ``height`` is negative.
    """

    kind: ClassVar[int] = SPHERICAL_CAP
    name: ClassVar[str] = "spherical_cap"

    def _check(self) -> None:
        super()._check()
        if abs(self.height) > self.radius:
            rule = f"be at most the radius ({self.radius:g} m): no more than half a sphere"
            refuse(self.name, "height", rule, self.height)

    @property
    def volume(self) -> float:
        """``pi height^2 (3 R - height) / 3 = pi height (3 radius^2 + height^2) / 6`` [m^3]."""
        return math.pi * self.height * (3.0 * self.radius**2 + self.height**2) / 6.0

    @property
    def shape(self) -> Shape:
        """Height [m], squared curvature [1/m^2], squared radius, its scale [1/m^2]."""
        bend, scale = arc(self.radius, self.height)
        return (self.height, bend, self.radius**2, scale)

    @property
    def _steepest(self) -> float:
        part = (self.height / self.radius) ** 2
        return KINK if part >= 1.0 else 2.0 / (1.0 - part)


@dataclass(frozen=True)
class HalfCosine(_Mound):
    """Half a wave of a cosine turned about its crest: ``height / 2 * (1 + cos(pi r / radius))``."""

    kind: ClassVar[int] = HALF_COSINE
    name: ClassVar[str] = "half_cosine"

    @property
    def volume(self) -> float:
        """``pi radius^2 height (1/2 - 2 / pi^2)`` [m^3]."""
        return math.pi * self.radius**2 * self.height * (0.5 - 2.0 / math.pi**2)

    @property
    def bounds(self) -> Bounds:
        """Smooth to its edge, where the slope is 0; it bends most in its centre."""
        bend = abs(self.height) / 2.0 * (math.pi / self.radius) ** 2
        one = super().bounds
        return Bounds(one.lowest, one.highest, one.slope, bend)

    @property
    def shape(self) -> Shape:
        """Height [m], one over the radius [1/m], squared radius."""
        return (self.height, 1.0 / self.radius, self.radius**2, 0.0)

    @property
    def _steepest(self) -> float:
        return math.pi / 2.0


def arc(half: float, height: float) -> tuple[float, float]:
    """Squared curvature and scale [1/m^2] of a circle's arc over a chord, as the kernel has them.

    Args:
        half: Half the chord [m].
        height: Height of the arc over it [m], at most ``half``.
    """
    scale = 2.0 / (half**2 + height**2)
    return (height * scale) ** 2, scale
