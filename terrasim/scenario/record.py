"""The record of a run: all that it was made from and all that came of it, as one JSON object."""

from __future__ import annotations

import json
import platform
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.cache.counters import Counters
from terrasim.counts import COUNT_M
from terrasim.deform.ledger import Ledger
from terrasim.errors import RunError
from terrasim.scenario.estimate import ErrorEstimate
from terrasim.scenario.fingerprint import hash_arrays
from terrasim.scenario.plan import DEVICE, Plan
from terrasim.scenario.recording import Recording
from terrasim.scenario.run_folder import RECORD
from terrasim.scenario.samples import Sampled
from terrasim.scenario.scenario import Scenario, scenario_settings
from terrasim.scenario.simulation import Simulation
from terrasim.scenario.stages import Stage

FORMAT = 1
"""Version of the record's form."""
LIBRARIES = ("numpy", "warp-lang", "matplotlib", "usd-core", "rasterio", "pyarrow", "pydantic")


@dataclass(frozen=True)
class Outcome:
    """What came of a simulation."""

    counters: Counters
    """What the cache did."""
    ledger: Ledger
    """What was done to the ground."""
    heights: int | None
    """What the heights themselves say was added [counts / unit of the ledger]; None unchanged."""
    ground: dict[str, Any]
    """What slumped and what is kept, ready for JSON."""
    ends: npt.NDArray[np.float64] | None
    """Where balls came to [m from the anchor; world z], shape ``(balls, 3)``; None without any."""
    balls: dict[str, Any]
    """What happened to the balls, ready for JSON; empty without any."""
    dynamics: list[dict[str, Any]]
    """What became of each dynamic, ready for JSON."""
    samples: list[dict[str, Any]]
    """What was asked for at the end, ready for JSON."""
    hashes: dict[str, str]
    """Of the deformed ground, and of the balls' state."""
    device_bytes: int
    """What Warp's allocator counted on the device when the run ended; 0 if nobody counted."""
    shown: dict[str, Any]
    """What the stage shows, ready for JSON; empty without one."""
    frames: int
    """Times at which balls were recorded."""
    simulated_s: float
    """Simulated time [s]."""

    @classmethod
    def of(
        cls,
        simulation: Simulation,
        recording: Recording,
        sampled: list[Sampled],
        heights: str,
        device_bytes: int,
    ) -> Outcome:
        """Take down what a simulation came to."""
        balls, tiles = simulation.balls, recording.tiles
        hashes = {"heights": heights}
        if balls is not None:
            hashes["balls"] = hash_arrays(*balls.state())
        shown: dict[str, Any] = {}
        if tiles is not None:
            error_m = tiles.error * COUNT_M
            shown = {"cells": tiles.cells, "level": tiles.finest, "error_m": error_m}
            if tiles.parts is not None:
                shown["detail_parts"], shown["detail_factor"] = tiles.parts
        return cls(
            counters=simulation.terrain.cache.counters,
            ledger=simulation.ground.ledger,
            heights=simulation.ground.height_difference(),
            ground=simulation.ground.summary(),
            ends=None if balls is None else balls.places(simulation.terrain),
            balls={} if balls is None else balls.summary(),
            dynamics=[] if simulation.dynamics is None else simulation.dynamics.summary(),
            samples=[one.summary() for one in sampled],
            hashes=hashes,
            device_bytes=device_bytes,
            shown=shown,
            frames=len(recording.times_s),
            simulated_s=simulation.time_s,
        )


def make_record(
    scenario: Scenario,
    plan: Plan,
    outcome: Outcome,
    errors: Sequence[ErrorEstimate],
    timings: tuple[list[Stage], float],
) -> dict[str, Any]:
    """The record of a run, ready for JSON."""
    stages, wall_s = timings
    spacing = plan.grid.spacing
    return {
        "format": FORMAT,
        "terrasim": _version("terrasim"),
        "name": scenario.name,
        "description": scenario.description,
        "settings": scenario_settings(scenario),
        "synthetic": plan.synthetic,
        "repeatable": scenario.run.late == "wait",
        "plan": plan.as_json(),
        "device": plan.device,
        "seed": scenario.run.seed,
        "versions": {name: _version(name) for name in LIBRARIES},
        "machine": {
            "system": platform.system(),
            "processor": platform.machine(),
            "python": platform.python_version(),
        },
        "simulated_s": outcome.simulated_s,
        "steps": plan.steps,
        "frames": outcome.frames,
        "counters": asdict(outcome.counters),
        "balls": outcome.balls,
        "dynamics": outcome.dynamics,
        "samples": outcome.samples,
        "ledger": {
            **asdict(outcome.ledger),
            "net": outcome.ledger.net,
            "heights": outcome.heights,
            "net_m3": outcome.ledger.volume(spacing),
            "removed_m3": outcome.ledger.removed / outcome.ledger.unit * COUNT_M * spacing**2,
            "added_m3": outcome.ledger.added / outcome.ledger.unit * COUNT_M * spacing**2,
        },
        **outcome.ground,
        "stage": outcome.shown,
        "memory": {
            "planned_device_bytes": plan.total_bytes(DEVICE),
            "counted_device_bytes": outcome.device_bytes or None,
        },
        "timings": {"wall_s": wall_s, "stages": [asdict(stage) for stage in stages]},
        "errors": [asdict(error) for error in errors],
        "hashes": outcome.hashes,
    }


def write_record(folder: Path, record: dict[str, Any]) -> None:
    """Write ``run.json``.

    Raises:
        RunError: If it cannot be written.
    """
    text = json.dumps(record, indent=2, allow_nan=False)
    try:
        (folder / RECORD).write_text(text + "\n", encoding="utf-8")
    except OSError as error:
        raise RunError(f"{RECORD} cannot be written ({error.strerror}); make room") from None


def _version(library: str) -> str | None:
    """Installed version of a library, without importing it."""
    try:
        return version(library)
    except PackageNotFoundError:
        return None
