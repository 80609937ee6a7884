"""All scenarios of a folder: what each was to come to, and whether it did."""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from terrasim.errors import InputError
from terrasim.progress import Progress, silent
from terrasim.scenario.scenario import load_scenario
from terrasim.study.folder import MARK, check_study_place, write_text
from terrasim.study.measures import LOOKED, MEASURES, measured
from terrasim.study.runs import DONE, FAILED, REFUSED, STOPPED, Looking, Result, Runs
from terrasim.study.settings import Expect, read_tables
from terrasim.study.study_file import Variant
from terrasim.study.table import TABLE, write_rows


@dataclass(frozen=True)
class Case:
    """A scenario of a folder."""

    path: Path
    """Its file."""
    expect: Expect | None
    """What it says it must come to; None if it says nothing."""
    table: dict[str, Any] | None
    """Its tables; None if the file is no TOML."""


def study_folder(
    folder: Path, *, out: Path | None = None, progress: Progress = silent
) -> dict[str, Any]:
    """Run all scenarios of a folder and hold each to its ``[expect]``.

    One without that table must run to its end. What is finished is kept in ``out``.

    Args:
        folder: The folder; files ``*.toml`` in it are scenarios.
        out: Folder of the results; by default ``out/<folder>-study``.
        progress: Told how far it is.

    Returns:
        One entry a scenario, and whether all held.

    Raises:
        InputError: If the folder holds no scenario, or an ``[expect]`` breaks a rule. Nothing was
            run then.
    """
    cases = _cases(folder)
    name = folder.resolve().name
    place = Path("out") / f"{name}-study" if out is None else out
    check_study_place(place)
    write_text(place / MARK, json.dumps({"finished": False}) + "\n")
    found = []
    for number, case in enumerate(cases):
        progress(number / len(cases), case.path.name)
        found.append(_judged(case, place / "runs"))
    record = {
        "name": name,
        "finished": True,
        "held": all(one["held"] for one in found),
        "folder": str(place),
        "files": sorted([MARK, TABLE]),
        "scenarios": found,
    }
    rows = [{key: value for key, value in one.items() if key != "found"} for one in found]
    write_rows(place / TABLE, rows)
    write_text(place / MARK, json.dumps(record, indent=2, allow_nan=False) + "\n")
    progress(1.0, "done")
    return record


def _cases(folder: Path) -> list[Case]:
    paths = sorted(folder.glob("*.toml"))
    if not paths:
        raise InputError(f"{folder}: holds no scenario: its files end in .toml")
    return [_case(path) for path in paths]


def _case(path: Path) -> Case:
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, tomllib.TOMLDecodeError):
        # What is wrong with it is told when it is to run.
        return Case(path, None, None)
    expect = read_tables(None, table.get("expect"), str(path)).expect
    return Case(path, expect, table)


def _judged(case: Case, runs: Path) -> dict[str, Any]:
    result = _result(case, runs)
    broken = _broken(case.expect, result)
    happened = result.status
    if result.reason:
        happened += f": {result.reason}"
    if broken:
        happened += f" (broken: {'; '.join(broken)})"
    return {
        "name": case.path.stem,
        "expected": _words(case.expect),
        "held": not broken,
        "status": result.status,
        "happened": happened,
        # JSON has no NaN: there it is null.
        "found": _without_nan(result.found),
    }


def _result(case: Case, runs: Path) -> Result:
    try:
        scenario = load_scenario(case.path)
    except InputError as error:
        # The place stands in the table already.
        reason = str(error).removeprefix(f"{case.path}: ")
        return Result(REFUSED, reason, {}, runs, False)
    table = dict(case.table or {})
    table.setdefault("name", case.path.stem)
    for name in ("study", "expect"):
        table.pop(name, None)
    expect = case.expect or Expect(outcome="done")
    wanted = {*expect.at_most, *expect.at_least}
    looked = expect.outcome == "bounded_energy" or bool(LOOKED & wanted)
    looking = Looking(frames=1, watched_balls=1, every_step=looked, longest_s=expect.longest_s)
    variant = Variant({}, table, scenario)
    return Runs(runs, case.path.parent, looking).result(variant)


def _broken(expect: Expect | None, result: Result) -> list[str]:
    """What does not hold."""
    wanted = expect or Expect(outcome="done")
    status = wanted.outcome if wanted.outcome in {REFUSED, STOPPED} else DONE
    if result.status != status or result.status == FAILED:
        return [f"expected {wanted.outcome}"]
    if wanted.reason not in result.reason:
        return [f"the reason does not hold {wanted.reason!r}"]
    if status != DONE:
        return []
    return [*_broken_outcome(wanted, result.found), *_broken_bounds(wanted, result.found)]


def _broken_outcome(expect: Expect, found: dict[str, Any]) -> list[str]:
    if expect.outcome == "done":
        return []
    if not found["balls"]:
        return [f"{expect.outcome} needs balls"]
    bounds = (
        {"fastest": (expect.speed_m_s, "m/s"), "gap": (expect.gap_m, "m")}
        if expect.outcome == "rest"
        else {"energy_gain": (expect.gain, "")}
    )
    return [
        f"{name} is {found[name]:.4g}, over {bound:g} {unit}".rstrip()
        for name, (bound, unit) in bounds.items()
        # Written so that a NaN breaks it.
        if not found[name] <= bound
    ]


def _broken_bounds(expect: Expect, found: dict[str, Any]) -> list[str]:
    broken = []
    for bounds, least in ((expect.at_most, False), (expect.at_least, True)):
        values = measured(tuple(bounds), found, None, None)
        for name, bound in bounds.items():
            value = values[name]
            if value is None:
                broken.append(f"{name} was not measured")
            elif not (value >= bound if least else value <= bound):
                rule = "under" if least else "over"
                broken.append(f"{name} is {value:.4g}, {rule} {bound:g} {MEASURES[name].unit}")
    return [one.rstrip() for one in broken]


def _words(expect: Expect | None) -> str:
    """An expectation as a person reads it."""
    if expect is None:
        return "nothing said: runs to its end"
    told = expect.outcome.replace("_", " ")
    if expect.reason:
        told += f", saying {expect.reason!r}"
    told += "".join(f", {name} <= {bound:g}" for name, bound in expect.at_most.items())
    return told + "".join(f", {name} >= {bound:g}" for name, bound in expect.at_least.items())


def _without_nan(found: dict[str, Any]) -> dict[str, Any]:
    return {
        name: None if isinstance(value, float) and math.isnan(value) else value
        for name, value in found.items()
    }
