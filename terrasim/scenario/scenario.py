"""Scenario files: what a run is made of, read from TOML and checked before anything is opened."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from pydantic import Field, ValidationError, model_validator

from terrasim.balls.collision import AS_USUAL, Collision
from terrasim.errors import InputError
from terrasim.scenario.actors import (
    AgentPath,
    AnyScattered,
    AnyStamp,
    BallGroup,
    NotNegative,
    PairSettings,
    Positive,
    SampleGroup,
)
from terrasim.scenario.dynamics import AnyDynamic
from terrasim.scenario.ground import DetailSettings, RelaxationSettings, StoreSettings
from terrasim.scenario.settings import AsDataclass, Settings, explain
from terrasim.scenario.terrain import AnyGround

LARGEST_FILE = 1 << 20
"""Bytes of a scenario file; a longer one is something else."""


class AnchorPost(Settings):
    """The level-0 post that all places of the scenario are measured from."""

    row: Annotated[int, Field(ge=-(2**30), le=2**30)]
    """Its row."""
    col: Annotated[int, Field(ge=-(2**30), le=2**30)]
    """Its column."""


class PoolSettings(Settings):
    """How much ground is held at once, and how it is brought in."""

    bytes: Annotated[int, Field(ge=1)] = 64 << 20
    """Bytes of posts held on the device; a block takes 262,144."""
    loaders: Annotated[int, Field(ge=1, le=256)] = 2
    """Threads that read blocks beside the steps."""
    budget_ms: Positive = 2.0
    """Time the job queue may take out of a step [ms]."""


class RunSettings(Settings):
    """How long and how finely."""

    duration_s: NotNegative = 0.0
    """Simulated time [s]; 0 looks at the ground as it is."""
    dt_s: Annotated[float, Field(gt=0.0, le=1.0)] = 0.005
    """Time step [s]."""
    gravity_m_s2: NotNegative = 9.81
    """Gravity, downward [m/s^2]."""
    device: str = "cpu"
    """Device that the run computes on: cpu, or a CUDA device such as cuda:0."""
    threads: Annotated[int, Field(ge=1, le=1024)] = 1
    """CPU threads that a launch may be split over; the result is the same to the bit."""
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    """Seed of everything drawn at random."""
    late: Literal["wait", "fallback"] = "wait"
    """What a step does about required ground that has not come: wait for it, or fall back to a
    coarser level and lose repeatability."""
    paced: bool = False
    """Let no step begin before its time on the clock: for trying out a job queue's budget."""
    checked_balls: Annotated[int, Field(ge=0, le=1_000_000)] = 64
    """Balls that are run again at half the step for the report; 0 leaves that out."""


class Output(Settings):
    """What the run leaves beside its record and its report."""

    picture: bool = False
    """A hillshade with balls and deformations, PNG."""
    usd: bool = False
    """A USD stage: tiles of ground, and balls over time."""
    parquet: bool = False
    """Tables of balls over time and of sampled heights, Parquet."""
    frames_per_s: Annotated[float, Field(gt=0.0, le=1000.0)] = 25.0
    """How often balls are recorded for the picture, the stage and the tables [1/s]."""
    usd_cells: Annotated[int, Field(ge=4096, le=100_000_000)] = 1_200_000
    """Most cells in the stage's ground; what happens is shown finest."""


class Scenario(Settings):
    """A scenario: terrain, actors, deformations, outputs. Lengths are metres."""

    name: Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")] = "scenario"
    """What the run is called; by default the file's name."""
    description: str = ""
    """What it shows, in a sentence or two; stands on the report."""
    terrain: AnyGround
    """Where heights come from."""
    anchor: AnchorPost | None = None
    """The post that places are measured from; by default the middle of the terrain."""
    pool: PoolSettings = PoolSettings()
    """How much ground is held at once."""
    detail: DetailSettings | None = None
    """A finer grid where something changed the ground; by default there is none."""
    relaxation: RelaxationSettings | None = None
    """Ground that slumps where stamps made it too steep; by default it stays as it is."""
    store: StoreSettings | None = None
    """Keep the ground in a store; by default it lasts as long as the run."""
    stamps: tuple[AnyStamp, ...] = ()
    """Deformations, each at a place and a time."""
    scatter: tuple[AnyScattered, ...] = ()
    """Many deformations of one shape, spread over a region."""
    dynamics: tuple[AnyDynamic, ...] = ()
    """Deformations that change over time."""
    balls: tuple[BallGroup, ...] = ()
    """Balls that are let go above the ground."""
    collision: Annotated[Collision, AsDataclass()] = AS_USUAL
    """How balls meet the ground, and how their steps are taken."""
    pairs: PairSettings | None = None
    """How balls meet one another; by default they pass through."""
    agents: tuple[AgentPath, ...] = ()
    """What moves over the ground and needs it around itself."""
    samples: tuple[SampleGroup, ...] = ()
    """Places whose height is asked for at the end."""
    run: RunSettings = RunSettings()
    """How long and how finely."""
    output: Output = Output()
    """What the run leaves beside its record and its report."""
    study: Annotated[dict[str, Any] | None, Field(exclude=True)] = None
    """What `terrasim study` varies and measures. A run does not look at it."""
    expect: Annotated[dict[str, Any] | None, Field(exclude=True)] = None
    """What must come of it, for `terrasim study` of a folder. A run does not look at it."""

    @model_validator(mode="after")
    def _ends_after_its_stamps(self) -> Self:
        ends = [(f"stamps[{i + 1}]", one.time_s) for i, one in enumerate(self.stamps)]
        ends += [(f"scatter[{i + 1}]", one.time_s[1]) for i, one in enumerate(self.scatter)]
        for name, time_s in ends:
            if time_s > self.run.duration_s:
                raise ValueError(
                    f"{name}.time_s must be within the run of {self.run.duration_s:g} s "
                    f"(run.duration_s), got {time_s:g}"
                )
        return self

    @model_validator(mode="after")
    def _balls_can_step(self) -> Self:
        for i, one in enumerate(self.balls, 1):
            if self.collision.sprung and one.mass is None:
                raise ValueError(f"balls[{i}].mass is missing: balls on springs need it [kg]")
            if self.collision.sprung and (one.spin is not None or one.rolling_friction):
                raise ValueError(
                    f"balls[{i}]: balls on springs have no spin: take collision.integrator = "
                    "'event' or 'projected'"
                )
        return self

    @model_validator(mode="after")
    def _ends_after_its_dynamics(self) -> Self:
        for i, one in enumerate(self.dynamics, 1):
            # A sum of times is good to rounding.
            if one.end_s > self.run.duration_s * (1.0 + 1e-9):
                raise ValueError(
                    f"dynamics[{i}] must end within the run of {self.run.duration_s:g} s "
                    f"(run.duration_s), got {one.end_s:g} (time_s + duration_s)"
                )
        return self

    @model_validator(mode="after")
    def _keeps_time(self) -> Self:
        times = (*self.store.reopen_s, *self.store.snapshots_s) if self.store else ()
        for time_s in times:
            if time_s > self.run.duration_s:
                raise ValueError(
                    f"store: times must be within the run of {self.run.duration_s:g} s "
                    f"(run.duration_s), got {time_s:g}"
                )
        return self

    @model_validator(mode="after")
    def _has_its_detail(self) -> Self:
        fine = [f"stamps[{i}]" for i, one in enumerate(self.stamps, 1) if one.on_detail]
        fine += [f"scatter[{i}]" for i, one in enumerate(self.scatter, 1) if one.on_detail]
        fine += [f"dynamics[{i}]" for i, one in enumerate(self.dynamics, 1) if one.detail]
        if self.relaxation is not None and self.relaxation.detail:
            fine.append("relaxation")
        if fine and self.detail is None:
            raise ValueError(
                f"{fine[0]}.detail is true but the terrain has no detail: add a table [detail] "
                "with a factor"
            )
        return self

    @property
    def steps(self) -> int:
        """Number of time steps."""
        return round(self.run.duration_s / self.run.dt_s)


def load_scenario(path: str | Path) -> Scenario:
    """Read a scenario file.

    Raises:
        InputError: If there is no such file, it is no TOML, or something in it breaks a rule: one
            line with the place, the rule and the value.
    """
    file = Path(path)
    try:
        table = tomllib.loads(_text(file))
    except tomllib.TOMLDecodeError as error:
        reason = " ".join(str(error).split())
        raise InputError(f"{path}: is no TOML ({reason})") from None
    table.setdefault("name", file.stem)
    return parse_scenario(table, str(path))


def parse_scenario(table: dict[str, Any], name: str = "scenario") -> Scenario:
    """A scenario from nested tables; ``name`` stands in errors.

    Raises:
        InputError: If something in it breaks a rule.
    """
    try:
        # Read as JSON: there a number is no text and a flag no number, but a list may be a pair.
        return Scenario.model_validate_json(json.dumps(table, default=str), strict=True)
    except ValidationError as error:
        raise InputError(f"{name}: {explain(error, Scenario)}") from None


def scenario_schema() -> dict[str, Any]:
    """JSON Schema of scenario files, with the tables that only a study reads."""
    from terrasim.study.settings import tables_schema

    schema = Scenario.model_json_schema()
    tables = tables_schema()
    schema["properties"] |= tables["properties"]
    schema["$defs"] |= tables["$defs"]
    return {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema}


def scenario_settings(scenario: Scenario) -> dict[str, Any]:
    """All settings with their defaults, ready for JSON."""
    settings: dict[str, Any] = json.loads(scenario.model_dump_json(serialize_as_any=True))
    return settings


def flat_settings(settings: dict[str, Any], above: str = "") -> Iterator[tuple[str, Any]]:
    """Settings as paths and values, as the file would write them."""
    for key, value in settings.items():
        path = f"{above}.{key}" if above else key
        if isinstance(value, dict):
            yield from flat_settings(value, path)
        elif isinstance(value, list) and value and isinstance(value[0], dict):
            for number, entry in enumerate(value, 1):
                yield from flat_settings(entry, f"{path}[{number}]")
        elif value is not None and value != []:
            yield path, value


def _text(file: Path) -> str:
    try:
        if file.is_dir():
            raise InputError(f"{file}: is a folder; name the scenario file in it")
        with file.open("rb") as opened:
            content = opened.read(LARGEST_FILE + 1)
    except (FileNotFoundError, NotADirectoryError):
        raise InputError(f"{file}: no such file; check the name") from None
    except PermissionError:
        raise InputError(f"{file}: no permission to read it") from None
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: cannot be read ({error})") from None
    if len(content) > LARGEST_FILE:
        raise InputError(f"{file}: is longer than {LARGEST_FILE} bytes: no scenario file")
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        raise InputError(f"{file}: is no text in UTF-8, as TOML has to be") from None
