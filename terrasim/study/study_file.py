"""A scenario file with its study: read, and checked before anything runs."""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from terrasim.errors import InputError
from terrasim.scenario.scenario import Scenario, load_scenario, parse_scenario, scenario_settings
from terrasim.study.knobs import turned
from terrasim.study.measures import REFERRED
from terrasim.study.settings import (
    MOST_VARIANTS,
    ExactReference,
    SettingReference,
    Study,
    read_tables,
)
from terrasim.study.solutions import check_solution

Knobs = dict[str, Any]


@dataclass(frozen=True)
class Variant:
    """A scenario under some settings."""

    knobs: Knobs
    """What was varied, and to what."""
    table: dict[str, Any]
    """The scenario's tables under these settings."""
    scenario: Scenario
    """The scenario itself."""
    reference: Variant | None = None
    """What it is compared with, where that is the scenario under other settings."""

    @property
    def label(self) -> str:
        """What was varied, in a line."""
        return label(self.knobs)


@dataclass(frozen=True)
class StudyFile:
    """What a study is made of."""

    path: Path
    """The scenario's file."""
    scenario: Scenario
    """The scenario as it stands there."""
    study: Study
    """What is varied, measured and compared."""
    variants: tuple[Variant, ...]
    """All variants, in the order of the file's lists."""


def label(knobs: Knobs) -> str:
    """Knobs and values in a line."""
    return ", ".join(f"{name} = {shown(value)}" for name, value in knobs.items())


def shown(value: Any) -> str:
    """A value as the file would write it."""
    if isinstance(value, bool):
        return str(value).lower()
    return f"{value:g}" if isinstance(value, float) else str(value)


def read_study(path: Path) -> StudyFile:
    """Read a scenario file with a study.

    Raises:
        InputError: If there is none, or something in it breaks a rule: a knob or measure that
            there is not, a value that the scenario refuses, a reference that is missing or not
            true for the scenario.
    """
    scenario = load_scenario(path)
    if scenario.study is None:
        raise InputError(f"{path}: has no table [study]: say there what to vary and measure")
    study = read_tables(scenario.study, None, str(path)).study
    assert study is not None
    # What the scenario itself reads comes from the file, so that a knob meets its very tables.
    table = tomllib.loads(path.read_text(encoding="utf-8"))
    table.setdefault("name", path.stem)
    table.pop("study")
    table.pop("expect", None)
    combined = _combined(study, path)
    variants = tuple(_variant(table, knobs, study, path) for knobs in combined)
    for one in variants:
        _check_reference(study, one, path)
    return StudyFile(path, scenario, study, variants)


def _combined(study: Study, path: Path) -> list[Knobs]:
    """Values of the knobs, variant by variant."""
    names, lists = list(study.vary), list(study.vary.values())
    count = 1
    for values in lists:
        count *= len(values)
    if study.combine == "product" and count > MOST_VARIANTS:
        raise InputError(
            f"{path}: study.vary: {count:,} variants are more than {MOST_VARIANTS:,}; leave out "
            'values, or say combine = "zip"'
        )
    rows = zip(*lists, strict=True) if study.combine == "zip" else itertools.product(*lists)
    found = [dict(zip(names, row, strict=True)) for row in rows]
    for i, one in enumerate(found):
        if one in found[:i]:
            raise InputError(f"{path}: study.vary: {label(one)} stands there twice: name it once")
    return found


def _variant(table: dict[str, Any], knobs: Knobs, study: Study, path: Path) -> Variant:
    made = _turned(table, knobs, "study.vary", path)
    scenario = parse_scenario(made, f"{path}: study.vary: {label(knobs)}")
    if not isinstance(study.reference, SettingReference):
        return Variant(knobs, made, scenario)
    other = dict(study.reference.settings)
    where = "study.reference.settings"
    true = _turned(made, other, where, path)
    parsed = parse_scenario(true, f"{path}: {where}: {label(other)}")
    return Variant(knobs, made, scenario, Variant(other, true, parsed))


def _turned(table: dict[str, Any], knobs: Knobs, where: str, path: Path) -> dict[str, Any]:
    try:
        return turned(table, knobs)
    except InputError as error:
        raise InputError(f"{path}: {where}: {error}") from None


def _check_reference(study: Study, one: Variant, path: Path) -> None:
    """Refuse a reference that is not true for a variant, or ends at another time."""
    if not REFERRED.intersection(study.measure):
        return
    try:
        if isinstance(study.reference, ExactReference):
            check_solution(study.reference.solution, one.scenario)
        elif not one.scenario.balls and not one.scenario.samples:
            raise InputError("error needs balls or samples, to be compared with the reference's")
        if one.reference is not None:
            _check_end(one.scenario, one.reference.scenario)
    except InputError as error:
        raise InputError(f"{path}: {error} ({one.label})") from None


def _check_end(scenario: Scenario, true: Scenario) -> None:
    ends = [one.steps * one.run.dt_s for one in (scenario, true)]
    if abs(ends[0] - ends[1]) > 1e-9 * max(ends):
        raise InputError(
            f"study.reference: the variant ends at {ends[0]:.9g} s and its reference at "
            f"{ends[1]:.9g} s: choose run.dt_s that divide run.duration_s"
        )
    same: Callable[[Scenario], Any] = lambda one: [  # noqa: E731 it is two lines in one place
        (group.count, group.region) for group in (one.balls or one.samples)
    ]
    if same(scenario) != same(true):
        raise InputError("study.reference: its balls or samples are others than the variant's")


def settings_of(one: Variant) -> dict[str, Any]:
    """All settings of a variant with their defaults, ready for JSON."""
    return scenario_settings(one.scenario)
