"""What stands on, moves over, looks at and deforms the ground of a scenario.

All places are metres from one anchor post, so a scene far from the origin loses nothing.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Any, Self

import numpy as np
import numpy.typing as npt
from pydantic import AfterValidator, BeforeValidator, Field, create_model, model_validator

from terrasim.deform.stamps import REGISTRY, Stamp
from terrasim.scenario.images import BLANK, ImageFile, Images
from terrasim.scenario.settings import OneOf, Settings, fields_of, given, kind_field, names_of

Positive = Annotated[float, Field(gt=0.0)]
NotNegative = Annotated[float, Field(ge=0.0)]
Number = Annotated[int, Field(ge=1, le=100_000_000)]
Pair = tuple[float, float]
Rng = np.random.Generator
Points = npt.NDArray[np.float64]


class Region(Settings):
    """A rectangle around a place."""

    x: float = 0.0
    """Centre, metres east of the anchor post."""
    y: float = 0.0
    """Centre, metres north of the anchor post."""
    size_x: Positive
    """Width along x [m]."""
    size_y: Positive
    """Width along y [m]."""

    def draw(self, rng: Rng, count: int) -> Points:
        """Places spread evenly over it [m from the anchor], shape ``(count, 2)``."""
        centre, size = np.array([self.x, self.y]), np.array([self.size_x, self.size_y])
        places: Points = centre + (rng.random((count, 2)) - 0.5) * size
        return places


def _both_ends(value: Any) -> Any:
    number = isinstance(value, int | float) and not isinstance(value, bool)
    return (value, value) if number else tuple(value) if isinstance(value, list) else value


def _in_order(value: Pair) -> Pair:
    if value[0] > value[1]:
        raise ValueError(f"a range runs from low to high, got {list(value)}")
    return value


Range = Annotated[
    tuple[NotNegative, NotNegative],
    BeforeValidator(_both_ends, json_schema_input_type=float | tuple[float, float]),
    AfterValidator(_in_order),
]
"""A number, or the lowest and the highest of a range, at least 0."""
PositiveRange = Annotated[
    tuple[Positive, Positive],
    BeforeValidator(_both_ends, json_schema_input_type=float | tuple[float, float]),
    AfterValidator(_in_order),
]
"""The same above 0."""


def draw(ends: Pair, rng: Rng, count: int) -> Points:
    """Numbers spread evenly over a range, shape ``(count,)``."""
    return ends[0] + rng.random(count) * (ends[1] - ends[0])


def draw_sizes(ends: Pair, rng: Rng, count: int) -> Points:
    """Numbers above 0 whose logarithms are spread evenly, shape ``(count,)``."""
    low, high = ends
    return low * (high / low) ** rng.random(count)


class OfAKind(Settings):
    """Something that makes stamps of one kind."""

    kind: str
    """Which stamp."""

    @model_validator(mode="after")
    def _is_a_stamp(self) -> Self:
        self.shape(BLANK)
        return self

    def shape(self, images: Images, **place: float) -> Stamp:
        """The stamp of its fields, where they do not say it at a place."""
        kind = REGISTRY[self.kind]
        own = given(self, names_of(kind)) | place
        if isinstance(own.get("image"), ImageFile):
            own["image"] = images[own["image"]]
        return kind(**own)

    @property
    def on_detail(self) -> bool:
        """Whether it changes the detail instead of the terrain's own posts."""
        return bool(getattr(self, "detail", False))

    def files(self) -> Iterator[ImageFile]:
        """The image it is made of, if any."""
        image = getattr(self, "image", None)
        if isinstance(image, ImageFile):
            yield image


class Placed(OfAKind):
    """A stamp at a place and a time."""

    time_s: NotNegative = 0.0
    """When it is made [s]; 0 is before the run."""

    def stamp(self, images: Images) -> Stamp:
        """The stamp itself."""
        return self.shape(images)


class Scattered(OfAKind):
    """Stamps of one shape and different sizes, spread over a region."""

    count: Number
    """How many."""
    region: Region
    """Where."""
    size: PositiveRange = (1.0, 1.0)
    """Factor on all lengths of the shape, or a range of them, drawn evenly in the logarithm."""
    time_s: Range = (0.0, 0.0)
    """When they are made [s], or a range of times; 0 is before the run."""

    def shape(self, images: Images, **place: float) -> Stamp:
        """The shape that all have, at the anchor."""
        return super().shape(images, x=0.0, y=0.0, **place)

    def draw(self, rng: Rng, images: Images) -> list[tuple[float, Stamp]]:
        """Times [s] and stamps."""
        places = self.region.draw(rng, self.count)
        sizes = draw_sizes(self.size, rng, self.count)
        times = draw(self.time_s, rng, self.count)
        shape = self.shape(images)
        return [
            (float(time), replace(shape.scaled(float(size)), x=float(x), y=float(y)))
            for time, size, (x, y) in zip(times, sizes, places, strict=True)
        ]


class BallGroup(Settings):
    """Balls that are let go above the ground."""

    count: Number
    """How many."""
    region: Region
    """Over what ground."""
    height: NotNegative = 0.0
    """Gap between the ground and a ball's lowest point at first [m]."""
    radius: PositiveRange
    """Radius [m], or a range, drawn evenly in the logarithm."""
    velocity: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Velocity at first [m/s]: east, north, up."""
    restitution: Annotated[float, Field(ge=0.0, le=1.0)] = 0.5
    """Normal speed after an impact over that before, 0 to 1."""
    friction: NotNegative = 0.5
    """Coefficient of friction between a ball and the ground: it slides on slopes above that."""
    mass: Positive | None = None
    """Mass [kg]; springs need it. By default, where others have one, that of water."""
    spin: tuple[float, float, float] | None = None
    """Spin at first [rad/s] around east, north and up; by default balls do not turn."""
    rolling_friction: NotNegative = 0.0
    """Coefficient of rolling friction: a ball that turns stays on slopes up to that."""


class PairSettings(Settings):
    """Balls touch one another, too."""

    restitution: Annotated[float, Field(ge=0.0, le=1.0)] = 0.5
    """Speed along the line of centres after an impact over that before, 0 to 1."""
    friction: NotNegative = 0.5
    """Coefficient of friction between two balls."""
    iterations: Annotated[int, Field(ge=1, le=1000)] = 16
    """Rounds in which impacts and overlaps of many are settled, in a step."""


class AgentPath(Settings):
    """An agent that needs the ground around it and moves along a path.

    One place and no speed: a region that is always resident.
    """

    path: Annotated[tuple[Pair, ...], Field(min_length=1)]
    """Places it passes, metres east and north of the anchor post; it stays at the last."""
    speed_m_s: NotNegative = 0.0
    """Its speed along the path [m/s]."""
    radius: Annotated[float, Field(gt=0.0, le=100_000.0)]
    """Need radius [posts of its level]."""
    level: Annotated[int, Field(ge=0, le=30)] = 0
    """Level it needs at first."""
    climb_levels_per_s: float = 0.0
    """How fast the level it needs changes."""


class SampleGroup(Settings):
    """Places whose height is asked for at the end of the run."""

    count: Number
    """How many."""
    region: Region
    """Where."""
    level: Annotated[int, Field(ge=0, le=30)] = 0
    """Level to answer from."""


_CENTRE = frozenset({"x", "y"})


def _models(
    base: type[Settings],
    ending: str,
    skip: frozenset[str],
    names: frozenset[str] = frozenset(REGISTRY),
) -> list[type[Settings]]:
    """A model of each registered stamp, or of those of some names."""
    return [
        create_model(
            f"{kind.__name__}{ending}",
            __base__=base,
            __doc__=kind.__doc__,
            kind=kind_field(name),
            **_fields(kind, skip),
        )
        for name, kind in REGISTRY.items()
        if name in names
    ]


def _fields(kind: type[Stamp], skip: frozenset[str]) -> dict[str, Any]:
    """Fields of a stamp; a file names an image where the stamp holds it."""
    found = fields_of(kind, skip)
    if "image" in found:
        found["image"] = (ImageFile, Field(description="The image of its heights."))
    return found


_GIVEN = frozenset({"mode", "z", "detail"})
_ADDING = frozenset(name for name, kind in REGISTRY.items() if "add" in kind.modes)

AnyStamp = Annotated[Placed, OneOf(_models(Placed, "Placed", frozenset()))]
AnyScattered = Annotated[Scattered, OneOf(_models(Scattered, "Scattered", _CENTRE))]
AnyShape = Annotated[OfAKind, OneOf(_models(OfAKind, "Shape", _GIVEN, _ADDING))]
"""A stamp of mode add for what changes over time, which says when and to which posts."""
