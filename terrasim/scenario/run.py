"""Running a scenario: plan, simulation, outputs, record and report, in a folder of its own."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from terrasim.output.report import write_report
from terrasim.progress import Progress, silent
from terrasim.scenario.device_memory import counted_memory
from terrasim.scenario.estimate import estimate
from terrasim.scenario.fingerprint import hash_heights
from terrasim.scenario.ground import STORE
from terrasim.scenario.images import read_images
from terrasim.scenario.libraries import import_libraries
from terrasim.scenario.outputs import (
    write_ball_table,
    write_picture,
    write_sample_table,
    write_stage_file,
)
from terrasim.scenario.plan import Plan, make_plan
from terrasim.scenario.record import Outcome, make_record, write_record
from terrasim.scenario.recording import Recording
from terrasim.scenario.run_folder import check_place, run_folder
from terrasim.scenario.samples import Sampled, take_samples
from terrasim.scenario.scenario import Scenario, load_scenario, parse_scenario, scenario_settings
from terrasim.scenario.schedule import image_files
from terrasim.scenario.simulation import Boxes, Setup, Simulation
from terrasim.scenario.stages import StageTimer


def plan_file(file: Path, *, device: str | None = None) -> Plan:
    """The plan of a scenario file.

    Raises:
        InputError: If the file or something it names cannot be used.
    """
    scenario = changed(load_scenario(file), device=device)
    return make_plan(scenario, scenario.terrain.source(file.parent))


def run_file(
    file: Path,
    *,
    out: Path | None = None,
    device: str | None = None,
    threads: int | None = None,
    progress: Progress = silent,
) -> dict[str, Any]:
    """Run a scenario file.

    Args:
        file: The scenario.
        out: Folder of the run; by default ``out/<name>``.
        device: Instead of the scenario's.
        threads: Instead of the scenario's.
        progress: Told how far it is.

    Returns:
        The run's record, as ``run.json`` holds it.

    Raises:
        InputError: If the scenario cannot be run, or no folder can be made there.
        RunError: If the run fails.
    """
    scenario = changed(load_scenario(file), device=device, threads=threads)
    folder = Path("out") / scenario.name if out is None else out
    return run_scenario(scenario, file.parent, folder, progress=progress)


def changed(
    scenario: Scenario, *, device: str | None = None, threads: int | None = None
) -> Scenario:
    """A scenario with the command line's word on device and threads.

    Raises:
        InputError: If that is out of range.
    """
    said = {"device": device, "threads": threads}
    said = {name: value for name, value in said.items() if value is not None}
    if not said:
        return scenario
    table = scenario_settings(scenario)
    table["run"] |= said
    return parse_scenario(_without_none(table), "command line")


def run_scenario(
    scenario: Scenario, folder: Path, out: Path, *, progress: Progress = silent
) -> dict[str, Any]:
    """Run a scenario.

    Args:
        scenario: The scenario.
        folder: What paths in it are relative to.
        out: Folder of the run.
        progress: Told how far it is.

    Returns:
        The run's record, as ``run.json`` holds it.

    Raises:
        InputError: If the scenario cannot be run, or no folder can be made there.
        RunError: If the run fails.
    """
    begun, timer = time.perf_counter(), StageTimer()
    check_place(out)
    progress(0.0, "open the terrain")
    with timer.stage("open the source"):
        source = scenario.terrain.source(folder)
    plan = make_plan(scenario, source)
    with timer.stage("import libraries"):
        import_libraries(plan)
    with timer.stage("read images"):
        images = read_images(image_files(scenario), folder)
    with run_folder(out) as growing:
        setup = Setup(scenario, source, plan.anchor, images=images, store=growing / STORE)
        outcome = _simulate(growing, setup, timer, progress)
        progress(0.9, "estimate the error")
        with timer.stage("estimate the error"):
            errors = estimate(
                setup, outcome.counters, outcome.shown, outcome.ends, outcome.dynamics
            )
        wall_s = time.perf_counter() - begun
        record = make_record(scenario, plan, outcome, errors, (timer.stages, wall_s))
        record["folder"] = str(out)
        record["files"] = sorted([path.name for path in growing.iterdir()] + list(_ALWAYS))
        write_record(growing, record)
        write_report(growing, record)
    progress(1.0, "done")
    return record


_ALWAYS = ("report.html", "run.json")


def _simulate(growing: Path, setup: Setup, timer: StageTimer, progress: Progress) -> Outcome:
    """Run to the end and write what the scenario asks for; the terrain is closed afterwards."""
    with counted_memory() as memory, Simulation(setup, timer) as simulation:
        recording = Recording(setup, simulation, timer)

        def see(boxes: Boxes | None) -> None:
            recording.see(boxes)
            done = simulation.step / max(setup.steps, 1)
            progress(0.05 + 0.7 * done, f"{simulation.time_s:.2f} s simulated")

        with timer.stage("other work between steps"):
            simulation.run(see)
        device_bytes = memory.held
        sampled: list[Sampled] = []
        if setup.scenario.samples:
            with timer.stage("sample heights"):
                sampled = take_samples(setup, simulation)
        with timer.stage("hash the result"):
            heights = hash_heights(simulation.terrain)
        _write_outputs(growing, (setup, simulation, recording), sampled, timer, progress)
        return Outcome.of(simulation, recording, sampled, heights, device_bytes)


def _write_outputs(
    growing: Path,
    made: tuple[Setup, Simulation, Recording],
    sampled: list[Sampled],
    timer: StageTimer,
    progress: Progress,
) -> None:
    setup, simulation, recording = made
    output = setup.scenario.output
    if output.picture:
        progress(0.76, "draw the picture")
        with timer.stage("draw the picture"):
            write_picture(growing, setup, simulation, recording)
    if output.usd:
        progress(0.82, "write the stage")
        with timer.stage("write the stage"):
            write_stage_file(growing, setup, simulation, recording)
    if output.parquet:
        with timer.stage("write tables"):
            if recording.places.size:
                write_ball_table(growing, recording)
            if sampled:
                write_sample_table(growing, sampled)


def _without_none(table: Any) -> Any:
    """Nested tables without the keys that hold nothing, as TOML has them."""
    if isinstance(table, dict):
        return {key: _without_none(value) for key, value in table.items() if value is not None}
    if isinstance(table, list):
        return [_without_none(value) for value in table]
    return table
