"""Deformations that change over time, as scenario files say them."""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import Field, create_model, model_validator

from terrasim.deform.profiles import PROFILES, Profile
from terrasim.scenario.actors import AnyShape, NotNegative, Positive
from terrasim.scenario.images import BLANK, ImageFile, Images
from terrasim.scenario.settings import OneOf, Settings, fields_of, given, kind_field, names_of

if TYPE_CHECKING:
    # Only a scene that has some imports what they are made of.
    from terrasim.deform.growth import Growth
    from terrasim.deform.shock import Shock


class DynamicSettings(Settings):
    """Something that changes a rectangle of ground over time."""

    kind: str
    """Which kind."""
    time_s: NotNegative = 0.0
    """When it begins [s]."""
    duration_s: Positive
    """How long it lasts [s]."""
    end: Literal["freeze", "vanish"]
    """What becomes of it then: the ground keeps its shape, or is what it would be without it."""
    detail: bool = False
    """Whether it changes the detail instead of the terrain's own posts."""

    @property
    def end_s(self) -> float:
        """When it ends [s]."""
        return self.time_s + self.duration_s

    def deformation(self, images: Images) -> Shock | Growth:
        """What it does."""
        raise NotImplementedError

    def files(self) -> Iterator[ImageFile]:
        """The images that its shapes are made of."""
        raise NotImplementedError


class ShockSettings(DynamicSettings):
    """A stamp that is let go and crosses a rectangle of ground as a wave."""

    kind: Literal["shock"]
    """Tells it from the other kinds."""
    x: float = 0.0
    """Middle of the rectangle, metres east of the anchor post."""
    y: float = 0.0
    """Middle of the rectangle, metres north of the anchor post."""
    size_x: Positive
    """Width of the rectangle along x [m]; its edges reflect the wave."""
    size_y: Positive
    """Width along y [m]."""
    speed_m_s: Positive
    """Speed of the wave [m/s]."""
    damping_1_s: NotNegative = 0.0
    """The amplitude falls as exp(-damping t) [1/s]."""
    displacement: AnyShape | None = None
    """The shape it begins as."""
    velocity: AnyShape | None = None
    """The vertical velocity it begins with: a shape whose heights are m/s."""
    zero_mean: bool = False
    """Take the mean of the velocity off it, so that the mean height of the rectangle stays."""
    substeps: Annotated[int, Field(ge=1, le=100_000)] = 1
    """Steps of the wave in each time step; a time step may be spacing / (speed_m_s sqrt 2)."""

    @model_validator(mode="after")
    def _is_a_shock(self) -> Self:
        self.deformation(BLANK)
        return self

    def deformation(self, images: Images) -> Shock:
        """The shock of its fields."""
        from terrasim.deform.shock import Shock

        shapes = {
            name: shape.shape(images, detail=self.detail)
            for name, shape in (("displacement", self.displacement), ("velocity", self.velocity))
            if shape is not None
        }
        return Shock(**(given(self, names_of(Shock)) | shapes))

    def files(self) -> Iterator[ImageFile]:
        """The images that its shapes are made of."""
        for shape in (self.displacement, self.velocity):
            if shape is not None:
                yield from shape.files()


class ProfileSettings(Settings):
    """How much of a stamp there is, over the part of its duration that has gone."""

    kind: str
    """Which kind."""

    @model_validator(mode="after")
    def _is_a_profile(self) -> Self:
        self.profile()
        return self

    def profile(self) -> Profile:
        """The profile of its fields."""
        kind = PROFILES[self.kind]
        return kind(**given(self, names_of(kind)))


def _profiles() -> list[type[Settings]]:
    """A model of each profile."""
    found: list[type[Settings]] = []
    for name, kind in PROFILES.items():
        fields: dict[str, Any] = fields_of(kind)
        model = create_model(
            f"{kind.__name__}Profile",
            __base__=ProfileSettings,
            __doc__=kind.__doc__,
            kind=kind_field(name),
            **fields,
        )
        found.append(model)
    return found


AnyProfile = Annotated[ProfileSettings, OneOf(_profiles())]


class GrowthSettings(DynamicSettings):
    """A stamp that grows or decays."""

    kind: Literal["growth"]
    """Tells it from the other kinds."""
    stamp: AnyShape
    """The stamp; where the profile is 1 the ground has all of it."""
    profile: AnyProfile
    """How much of it there is, over the part of the duration that has gone."""

    @model_validator(mode="after")
    def _is_a_growth(self) -> Self:
        self.deformation(BLANK)
        return self

    def deformation(self, images: Images) -> Growth:
        """The growth of its fields."""
        from terrasim.deform.growth import Growth

        stamp = self.stamp.shape(images, detail=self.detail)
        return Growth(stamp, self.duration_s, self.profile.profile())

    def files(self) -> Iterator[ImageFile]:
        """The image that its stamp is made of, if any."""
        return self.stamp.files()


AnyDynamic = Annotated[DynamicSettings, OneOf((ShockSettings, GrowthSettings))]
