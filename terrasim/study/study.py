"""A study: every variant run and measured, then one table, one record and one page."""

from __future__ import annotations

import json
import statistics
import time
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from terrasim.errors import InputError, RunError
from terrasim.progress import Progress, silent
from terrasim.scenario.scenario import scenario_settings
from terrasim.study.folder import MARK, check_study_place, write_text
from terrasim.study.frames import Frames
from terrasim.study.measures import LOOKED, MEASURES, REFERRED, measured
from terrasim.study.report import REPORT, write_study_report
from terrasim.study.runs import DONE, FAILED, REFUSED, Looking, Result, Runs, machine, version_told
from terrasim.study.settings import EngineReference, ExactReference, SettingReference, Study
from terrasim.study.solutions import solve
from terrasim.study.study_file import StudyFile, Variant, label, read_study
from terrasim.study.table import TABLE, write_rows
from terrasim.study.verdicts import find_orders, find_pareto

FORMAT = 1
ALWAYS = ("run_time",)
"""Measured whether the study says so or not: what errors are drawn against."""
APART = ("first_step_s", "start_up_s", "modules_compiled")
"""What compiling and cold caches took, kept apart from the measures."""


def study_file(
    path: Path, *, out: Path | None = None, progress: Progress = silent
) -> dict[str, Any]:
    """Run the study of a scenario file.

    What is finished is kept in the folder: the same study goes on where it was ended.

    Args:
        path: The scenario.
        out: Folder of the study; by default ``out/<name>-study``.
        progress: Told how far it is.

    Returns:
        The study's record, as ``study.json`` holds it.

    Raises:
        InputError: If the file, a knob, a measure or the reference cannot be used, or something
            else is in the folder. Nothing was run then.
        RunError: If the reference fails, or no variant could be run.
    """
    begun, read = time.perf_counter(), read_study(path)
    folder = Path("out") / f"{read.scenario.name}-study" if out is None else out
    check_study_place(folder)
    write_text(folder / MARK, json.dumps({"format": FORMAT, "finished": False}) + "\n")
    runs = Runs(folder / "runs", path.parent, _looking(read.study))
    rows, kept = _rows(read, runs, progress)
    record = _record(read, rows, kept) | {
        "folder": str(folder),
        "files": sorted([MARK, REPORT, TABLE]),
        # A refusal is an answer; a process that failed is none.
        "held": all(row["status"] != FAILED for row in rows),
        "wall_s": time.perf_counter() - begun,
    }
    progress(0.98, "write the report")
    write_rows(folder / TABLE, rows)
    write_study_report(folder, record)
    write_text(folder / MARK, json.dumps(record, indent=2, allow_nan=False) + "\n")
    progress(1.0, "done")
    if all(row["status"] == FAILED for row in rows):
        raise RunError(f"{path}: no variant could be run: {rows[0]['reason']}")
    return record


def _looking(study: Study) -> Looking:
    every_step = bool(LOOKED.intersection(study.measure))
    return Looking(study.frames, study.watched_balls, every_step, study.longest_s)


def _rows(read: StudyFile, runs: Runs, progress: Progress) -> tuple[list[dict[str, Any]], int]:
    """One row a variant and repeat; and how many processes were finished before."""
    study, variants = read.study, read.variants
    jobs = len(variants) * study.repeats
    true = _others(read, runs, progress)
    rows, kept = [], 0
    # Repeats are spread over the whole time, so that a busy minute does not fall on one variant.
    for repeat in range(study.repeats):
        for number, one in enumerate(variants):
            done = (repeat * len(variants) + number) / jobs
            progress(0.1 + 0.85 * done, f"{one.label} ({repeat + 1} of {study.repeats})")
            result = runs.result(one, repeat)
            kept += result.kept
            values = _values(study, one, result, true[number])
            rows.append(_row(one, number, repeat, result) | values)
    return rows, kept


def _others(read: StudyFile, runs: Runs, progress: Progress) -> list[Frames | None]:
    """What each variant is compared with, where that has to be run first."""
    found: list[Frames | None] = []
    reference = read.study.reference
    for number, one in enumerate(read.variants):
        progress(0.1 * number / len(read.variants), "run the reference")
        if not REFERRED.intersection(read.study.measure):
            found.append(None)
        elif isinstance(reference, SettingReference) and one.reference is not None:
            found.append(_reference(runs.result(one.reference), one.reference.label))
        elif isinstance(reference, EngineReference):
            result = runs.result(one, engine=reference.engine)
            found.append(_reference(result, reference.engine))
        else:
            found.append(None)
    return found


def _reference(result: Result, name: str) -> Frames:
    if result.status == DONE:
        return result.load()
    message = f"study.reference: {name}: was {result.status} ({result.reason})"
    raise InputError(message) if result.status == REFUSED else RunError(message)


def _values(
    study: Study, one: Variant, result: Result, true: Frames | None
) -> dict[str, float | None]:
    names = tuple(dict.fromkeys((*study.measure, *ALWAYS)))
    if result.status != DONE:
        return dict.fromkeys(names)
    referred = bool(REFERRED.intersection(names))
    seen = result.load() if referred else None
    if seen is not None and isinstance(study.reference, ExactReference):
        try:
            true = solve(study.reference.solution, seen, one.scenario.run.gravity_m_s2)
        except InputError as error:
            raise InputError(f"study.reference: {error} ({one.label})") from None
    return measured(names, result.found, seen, true)


def _row(one: Variant, number: int, repeat: int, result: Result) -> dict[str, Any]:
    return {
        "variant": number + 1,
        "repeat": repeat + 1,
        **one.knobs,
        "status": result.status,
        "reason": result.reason,
        "end": ":".join(result.found.get("hashes", {}).values()),
        **{name: result.found.get(name) for name in APART},
    }


def _record(read: StudyFile, rows: list[dict[str, Any]], kept: int) -> dict[str, Any]:
    study = read.study
    names = tuple(dict.fromkeys((*study.measure, *ALWAYS)))
    variants = [_summary(read, rows, number, names) for number in range(len(read.variants))]
    return {
        "format": FORMAT,
        "finished": True,
        "terrasim": _version(),
        "code": version_told(),
        "name": read.scenario.name,
        "description": read.scenario.description,
        "study": json.loads(study.model_dump_json()),
        "reference": _told(study),
        "settings": scenario_settings(read.scenario),
        "machine": machine(),
        "measures": {
            name: {"unit": MEASURES[name].unit, "meaning": MEASURES[name].meaning} for name in names
        },
        "processes": len(rows),
        "kept": kept,
        "variants": variants,
        "orders": find_orders(study, variants),
        "pareto": find_pareto(study, variants),
    }


def _summary(
    read: StudyFile, rows: list[dict[str, Any]], number: int, names: tuple[str, ...]
) -> dict[str, Any]:
    """A variant over its repeats: medians, lowest and highest."""
    one = read.variants[number]
    mine = [row for row in rows if row["variant"] == number + 1]
    bad = [row for row in mine if row["status"] != DONE]
    summary: dict[str, Any] = {
        "knobs": one.knobs,
        "label": one.label,
        "status": bad[0]["status"] if bad else DONE,
        "reason": bad[0]["reason"] if bad else "",
        "repeats": len(mine),
        "repeatable": len({row["end"] for row in mine}) == 1,
    }
    for name in (*names, *APART):
        known = [row[name] for row in mine if row[name] is not None]
        summary[name] = (
            {"median": statistics.median(known), "lowest": min(known), "highest": max(known)}
            if known
            else None
        )
    return summary


def _told(study: Study) -> str:
    """The reference in words."""
    reference = study.reference
    if isinstance(reference, ExactReference):
        return f"the exact solution {reference.solution!r}"
    if isinstance(reference, SettingReference):
        return f"the same run with {label(dict(reference.settings))}"
    return f"the engine {reference.engine}" if reference is not None else ""


def _version() -> str:
    try:
        return version("terrasim")
    except PackageNotFoundError:
        return "unknown"
