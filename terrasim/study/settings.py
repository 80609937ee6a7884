"""The tables ``[study]`` and ``[expect]`` of a scenario file."""

from __future__ import annotations

import json
from typing import Annotated, Any, Literal, Self

from pydantic import AfterValidator, BeforeValidator, Field, ValidationError, model_validator

from terrasim.errors import InputError
from terrasim.scenario.settings import Settings, explain
from terrasim.study.engines import ENGINES
from terrasim.study.knobs import flat_knobs
from terrasim.study.measures import MEASURES, REFERRED
from terrasim.study.solutions import SOLUTIONS

MOST_VARIANTS = 10_000

Value = bool | int | float | str | list[Any]


def _known(name: str) -> str:
    if name not in MEASURES:
        raise ValueError(f"{name!r} is no measure: choose from {', '.join(MEASURES)}")
    return name


def _one_of(names: Any, what: str) -> Any:
    def check(name: str) -> str:
        if name not in names:
            listed = ", ".join(names) or "none is installed"
            raise ValueError(f"{name!r} is no {what}: choose from {listed}")
        return name

    return AfterValidator(check)


Measure = Annotated[str, AfterValidator(_known)]
Values = Annotated[list[Value], Field(min_length=1)]
Knobs = Annotated[dict[str, Values], BeforeValidator(flat_knobs), Field(min_length=1)]


class SettingReference(Settings):
    """Every variant is compared with itself under some other settings, as the finest step."""

    kind: Literal["setting"]
    """The scenario under other settings."""
    settings: Annotated[dict[str, Value], BeforeValidator(flat_knobs), Field(min_length=1)]
    """Knobs and their values."""


class ExactReference(Settings):
    """Every variant is compared with a solution in closed form."""

    kind: Literal["exact"]
    """A closed form."""
    solution: Annotated[str, _one_of(SOLUTIONS, "solution")]
    """Its name."""


class EngineReference(Settings):
    """Every variant is compared with the same scene in another engine."""

    kind: Literal["engine"]
    """Another engine."""
    engine: Annotated[str, _one_of(ENGINES, "engine that terrasim can ask")]
    """Its name."""


AnyReference = Annotated[
    SettingReference | ExactReference | EngineReference, Field(discriminator="kind")
]


class Study(Settings):
    """What is varied, what is measured and what it is held against."""

    vary: Knobs
    """Knobs and their values: a knob is the path of a setting, such as ``run.dt_s``, or
    ``balls[1].radius`` for the first group (``balls.radius`` for all of them)."""
    combine: Literal["product", "zip"] = "product"
    """Every value with every other, or the first with the first and so on."""
    measure: Annotated[tuple[Measure, ...], Field(min_length=1)] = (
        "energy_drift",
        "penetration",
        "run_time_per_ball_step",
        "memory",
    )
    """What is measured."""
    reference: AnyReference | None = None
    """What errors are taken against; needed by ``error`` and its kin."""
    repeats: Annotated[int, Field(ge=1, le=1000)] = 3
    """How often each variant is run, each time in a process of its own."""
    frames: Annotated[int, Field(ge=1, le=10_000)] = 32
    """Times, evenly spread, at which places are compared."""
    watched_balls: Annotated[int, Field(ge=1, le=1_000_000)] = 1000
    """Balls whose places are compared, evenly chosen; energy and depth are those of all."""
    longest_s: Annotated[float, Field(gt=0.0)] = 3600.0
    """Wall time after which a variant is ended and said to have failed [s]."""

    @model_validator(mode="after")
    def _zips_evenly(self) -> Self:
        lengths = {name: len(values) for name, values in self.vary.items()}
        if self.combine == "zip" and len(set(lengths.values())) > 1:
            told = ", ".join(f"{name} has {count}" for name, count in lengths.items())
            raise ValueError(f'vary: lists must be equally long for combine = "zip": {told}')
        return self

    @model_validator(mode="after")
    def _has_its_reference(self) -> Self:
        wanting = [name for name in self.measure if name in REFERRED]
        if wanting and self.reference is None:
            raise ValueError(
                f"measure: {wanting[0]!r} needs a reference: add a table [study.reference] with "
                "kind setting, exact or engine"
            )
        return self


Bound = Annotated[dict[Measure, float], Field()]


class Expect(Settings):
    """What must come of a scenario."""

    outcome: Literal["done", "rest", "bounded_energy", "refused", "stopped"]
    """It runs to its end; so that all balls lie still on the ground; so that no ball gains
    energy; it is refused before its first step; or it is stopped on its way."""
    reason: str = ""
    """Text that the refusal, or what it says when it stops, must hold."""
    speed_m_s: Annotated[float, Field(ge=0.0)] = 1e-3
    """Speed of a ball that lies still, at most [m/s]."""
    gap_m: Annotated[float, Field(ge=0.0)] = 1e-3
    """Distance of such a ball from touching the ground, at most [m]."""
    gain: Annotated[float, Field(ge=0.0)] = 1e-9
    """What a ball may gain of its largest kinetic energy where energy is bounded."""
    at_most: Bound = Field(default_factory=dict)
    """Measures and what they may be at most."""
    at_least: Bound = Field(default_factory=dict)
    """Measures and what they must be at least."""
    longest_s: Annotated[float, Field(gt=0.0)] = 600.0
    """Wall time after which it is ended, and the expectation broken [s]."""

    @model_validator(mode="after")
    def _can_be_told(self) -> Self:
        ends = self.outcome not in {"refused", "stopped"}
        if self.reason and ends:
            raise ValueError(
                f"reason: {self.outcome!r} says nothing, got {self.reason!r}: reasons belong to "
                'outcome = "refused" or "stopped"'
            )
        if not ends and (self.at_most or self.at_least):
            raise ValueError(f"at_most and at_least: what is {self.outcome} measures nothing")
        for name in (*self.at_most, *self.at_least):
            if name in REFERRED:
                raise ValueError(f"{name!r} needs a reference, which only a study has")
        return self


class Tables(Settings):
    """Both tables, so that errors name them as the file does."""

    study: Study | None = None
    """What a study varies and measures."""
    expect: Expect | None = None
    """What must come of the scenario."""


def read_tables(study: Any, expect: Any, name: str) -> Tables:
    """The two tables of a file, checked; ``name`` stands in errors.

    Raises:
        InputError: If something in them breaks a rule.
    """
    table = {"study": study, "expect": expect}
    given = {key: value for key, value in table.items() if value is not None}
    try:
        return Tables.model_validate_json(json.dumps(given, default=str), strict=True)
    except ValidationError as error:
        raise InputError(f"{name}: {explain(error, Tables)}") from None


def tables_schema() -> dict[str, Any]:
    """JSON Schema of both tables."""
    return Tables.model_json_schema()
