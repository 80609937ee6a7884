"""Stamps: shapes that are added to the ground.

A stamp is a small frozen dataclass. It says where it stands, in metres from an anchor post, and
what it adds to a post at a distance from there. To add a stamp: write its formula into ``part`` and
``rise`` of ``kernels/stamps.py`` under a new kind, write its dataclass here with the members of
:class:`Stamp`, and enter it in :data:`REGISTRY`. Everything else follows from those.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Protocol

from terrasim.counts import COUNT_M, COUNTS_PER_M, MAX_COUNT
from terrasim.errors import InputError
from terrasim.kernels.stamps import CRATER, GAUSSIAN, RIM_END, RIM_REST

TALLEST = MAX_COUNT * COUNT_M
"""Largest height that a stamp may add or remove [m]."""
NARROWEST = 1e-6
"""Smallest size of a stamp [m]."""
WIDEST = 1e9
"""Largest size of a stamp [m]."""


@dataclass(frozen=True)
class Bounds:
    """How wild a stamp is: from these follows what a coarse level can miss of it."""

    lowest: float
    """The least it adds anywhere, at most 0 [m]."""
    highest: float
    """The most it adds anywhere, at least 0 [m]."""
    slope: float
    """Its steepest slope [-]."""
    curvature: float
    """Largest second derivative in any direction [1/m]; infinite where it has a kink."""


class Stamp(Protocol):
    """What every stamp offers."""

    kind: ClassVar[int]
    """Its formula in ``kernels/stamps.py``."""

    @property
    def x(self) -> float:
        """Centre, metres east of the anchor post."""
        ...

    @property
    def y(self) -> float:
        """Centre, metres north of the anchor post."""
        ...

    @property
    def reach(self) -> float:
        """Beyond this distance from its centre it adds nothing that a count can hold [m]."""
        ...

    @property
    def volume(self) -> float:
        """Volume it adds to ground without edges or holes, less what it removes [m^3]."""
        ...

    @property
    def bounds(self) -> Bounds:
        """How wild it is."""
        ...

    @property
    def shape(self) -> tuple[float, float, float, float]:
        """The numbers ``a`` to ``d`` of its formula, heights in counts."""
        ...


@dataclass(frozen=True)
class Gaussian:
    """A round hill, or a hollow: ``amplitude * exp(-r^2 / (2 sigma^2))``.

    It ends where it falls under half a count, 5 ``sigma`` out for an amplitude of a metre: there
    rounding makes it nothing by itself, so there is no step.
    """

    x: float
    """Centre, metres east of the anchor post."""
    y: float
    """Centre, metres north of the anchor post."""
    amplitude: float
    """Height at the centre [m]; negative digs."""
    sigma: float
    """Standard deviation [m]."""

    kind: ClassVar[int] = GAUSSIAN

    def __post_init__(self) -> None:
        """Refuse what is no gaussian."""
        _check_numbers(self, "gaussian")
        _check_size(self.sigma, "gaussian", "sigma")
        _check_height(self.amplitude, "gaussian", "amplitude")

    @property
    def reach(self) -> float:
        """Distance at which it is half a count [m]."""
        times = 2.0 * abs(self.amplitude) / COUNT_M
        return self.sigma * math.sqrt(2.0 * math.log(times)) if times > 1.0 else 0.0

    @property
    def volume(self) -> float:
        """``2 pi sigma^2 amplitude``, all of it [m^3]."""
        return 2.0 * math.pi * self.sigma**2 * self.amplitude

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
    def shape(self) -> tuple[float, float, float, float]:
        """Amplitude [counts] and the factor of the squared distance [1/m^2]."""
        return (self.amplitude * COUNTS_PER_M, -0.5 / self.sigma**2, 0.0, 0.0)


@dataclass(frozen=True)
class Crater:
    """A bowl with a raised rim.

    With ``s = r / radius``, ``q = 3^-3`` and ``t = (s^-3 - q) / (1 - q)``::

        bowl, s <= 1:      (depth + rim_height) * s^2 - depth
        rim,  1 < s < 3:   rim_height * t
        beyond:            0

    The bowl is a paraboloid that rises to the rim's crest; outside, the rim falls off as the cube
    of the distance, as the ejecta of impact craters do, down to nothing at three radii.
    """

    x: float
    """Centre, metres east of the anchor post."""
    y: float
    """Centre, metres north of the anchor post."""
    radius: float
    """Distance of the rim's crest from the centre [m]."""
    depth: float
    """Depth of the bowl's floor under the ground before [m]."""
    rim_height: float = 0.0
    """Height of the rim's crest above the ground before [m]."""

    kind: ClassVar[int] = CRATER

    def __post_init__(self) -> None:
        """Refuse what is no crater."""
        _check_numbers(self, "crater")
        _check_size(self.radius, "crater", "radius")
        for name in ("depth", "rim_height"):
            _check(
                getattr(self, name) >= 0.0, "crater", name, "be at least 0 m", getattr(self, name)
            )
            _check_height(getattr(self, name), "crater", name)

    @property
    def reach(self) -> float:
        """Where the rim ends; the bowl's edge if it has none [m]."""
        return self.radius * (RIM_END if self.rim_height > 0.0 else 1.0)

    @property
    def volume(self) -> float:
        """Rim less bowl [m^3]."""
        bowl = 0.5 * (self.rim_height - self.depth)
        rest = 0.5 * RIM_REST * (RIM_END**2 - 1.0)
        rim = 2.0 * self.rim_height * (1.0 - 1.0 / RIM_END - rest) / (1.0 - RIM_REST)
        return math.pi * self.radius**2 * (bowl + rim)

    @property
    def bounds(self) -> Bounds:
        """It is steepest at the crest, where it has a kink."""
        inside = 2.0 * (self.depth + self.rim_height) / self.radius
        outside = 3.0 * self.rim_height / (self.radius * (1.0 - RIM_REST))
        return Bounds(-self.depth, self.rim_height, max(inside, outside), math.inf)

    @property
    def shape(self) -> tuple[float, float, float, float]:
        """Squared radius [m^2], the bowl's rise a square metre, depth and rim [counts]."""
        square = self.radius**2
        return (
            square,
            (self.depth + self.rim_height) * COUNTS_PER_M / square,
            self.depth * COUNTS_PER_M,
            self.rim_height * COUNTS_PER_M / (1.0 - RIM_REST),
        )


REGISTRY: dict[str, type[Gaussian] | type[Crater]] = {"gaussian": Gaussian, "crater": Crater}
"""Every stamp by the name that scenario files give it. A stamp's dataclass fields are its schema:
enter a new class here and files can use it."""


def _check_numbers(stamp: Gaussian | Crater, name: str) -> None:
    for field in stamp.__dataclass_fields__:
        value = getattr(stamp, field)
        number = isinstance(value, int | float) and not isinstance(value, bool)
        _check(number and math.isfinite(value), name, field, "be a finite number", value)


def _check_size(value: float, stamp: str, field: str) -> None:
    rule = f"lie between {NARROWEST:g} and {WIDEST:g} m"
    _check(NARROWEST <= value <= WIDEST, stamp, field, rule, value)


def _check_height(value: float, stamp: str, field: str) -> None:
    _check(abs(value) <= TALLEST, stamp, field, f"stay within {TALLEST:.0f} m", value)


def _check(holds: bool, stamp: str, field: str, rule: str, value: object) -> None:
    if not holds:
        raise InputError(f"{stamp}: {field} must {rule}, got {value}")
