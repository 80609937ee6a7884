"""How wrong a run is: levels, time step, rounding; each in metres, with what it cost to know."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.counters import Counters
from terrasim.counts import COUNT_M
from terrasim.plan import checked_balls
from terrasim.schedule import CHECK, random_numbers, schedule
from terrasim.simulation import Setup, Simulation, stamps_of
from terrasim.stages import StageTimer
from terrasim.stamps import Stamp

Places = npt.NDArray[np.float64]

FINER = 2
"""The check runs at a step smaller by this."""
_MOST_COMPARED = 2000
"""Stamps whose overlap is found exactly; for more it is bounded by their number."""


@dataclass(frozen=True)
class ErrorEstimate:
    """One way in which a run is wrong."""

    name: str
    """What makes it so."""
    metres: float | None
    """By how much at most [m]; None if it does not apply."""
    typical_m: float | None
    """By how much in the middle case [m], where that is known."""
    cost_s: float
    """Wall time it took to find out [s]."""
    note: str
    """How it was found."""


def level_errors(counters: Counters) -> list[ErrorEstimate]:
    """What coarser levels than asked for may have changed."""
    contact = counters.coarsened_error * COUNT_M
    queries = counters.fallback_error * COUNT_M
    return [
        ErrorEstimate(
            "levels, contact",
            contact,
            None,
            0.0,
            f"{counters.coarsened} needs were answered coarser: pool.bytes is too small"
            if counters.coarsened
            else "contact read the finest level everywhere",
        ),
        ErrorEstimate(
            "levels, queries",
            queries,
            None,
            0.0,
            f"{counters.fallbacks} places were answered coarser than asked for"
            if counters.fallbacks
            else "every place was answered at the level it asked for",
        ),
    ]


def rounding_error(stamps: Sequence[Stamp]) -> ErrorEstimate:
    """Bound of what rounding to counts may have changed."""
    begun = time.perf_counter()
    most = most_overlapping(stamps)
    metres = 0.5 * COUNT_M * (1 + most)
    note = "half a count for the source"
    if most:
        note += f" and for each stamp; at most {most} of them meet at one post"
    return ErrorEstimate("rounding to counts", metres, None, time.perf_counter() - begun, note)


def most_overlapping(stamps: Sequence[Stamp]) -> int:
    """Largest number of stamps whose squares share a place."""
    if len(stamps) > _MOST_COMPARED or len(stamps) < 2:
        return len(stamps)
    x = np.array([[stamp.x - stamp.reach, stamp.x + stamp.reach] for stamp in stamps])
    y = np.array([[stamp.y - stamp.reach, stamp.y + stamp.reach] for stamp in stamps])
    cols, rows = np.unique(x), np.unique(y)
    inside = np.zeros((rows.size + 1, cols.size + 1), np.int32)
    west, east = np.searchsorted(cols, x[:, 0]), np.searchsorted(cols, x[:, 1]) + 1
    south, north = np.searchsorted(rows, y[:, 0]), np.searchsorted(rows, y[:, 1]) + 1
    for row, col, sign in (
        (south, west, 1),
        (south, east, -1),
        (north, west, -1),
        (north, east, 1),
    ):
        np.add.at(inside, (row, col), sign)
    return int(inside.cumsum(axis=0).cumsum(axis=1).max())


def step_error(setup: Setup, ends: Places) -> ErrorEstimate:
    """Run some of the balls again at half the step.

    Args:
        setup: What the run was made from.
        ends: Where each ball came to, metres from the anchor, shape ``(balls, 3)``.
    """
    begun = time.perf_counter()
    scenario = setup.scenario
    count = checked_balls(scenario)
    rng = random_numbers(scenario.run.seed, CHECK, 0)
    chosen = np.sort(rng.choice(len(ends), size=count, replace=False)).astype(np.int64)
    again = Setup(scenario, setup.source, setup.anchor, FINER, chosen)
    with Simulation(again, StageTimer()) as simulation:
        simulation.run()
        places = simulation.balls.places(simulation.terrain)
    apart = np.linalg.norm(places - ends[chosen], axis=1)
    moved = int(np.count_nonzero(apart > 0.01))
    return ErrorEstimate(
        "time step",
        float(apart.max()),
        float(np.median(apart)),
        time.perf_counter() - begun,
        f"{count} of {len(ends)} balls run again at {again.dt_s * 1e3:g} ms: {moved} ended more "
        "than 1 cm away",
    )


def stage_error(shown: dict[str, Any]) -> ErrorEstimate:
    """How far the stage's finest ground may be from the surface."""
    if not shown:
        return ErrorEstimate("levels, stage", None, None, 0.0, "no stage asked for")
    note = f"the stage's finest ground is level {shown['level']}"
    if shown["level"]:
        note += ": output.usd_cells allows no finer one"
    return ErrorEstimate("levels, stage", shown["error_m"], None, 0.0, note)


def estimate(
    setup: Setup, counters: Counters, shown: dict[str, Any], ends: Places | None
) -> list[ErrorEstimate]:
    """All estimates of a run.

    Args:
        setup: What it was made from.
        counters: What its cache did.
        shown: What its stage shows; empty without one.
        ends: Where each ball came to, metres from the anchor; None if there are none.
    """
    found = [*level_errors(counters), stage_error(shown)]
    if ends is not None and checked_balls(setup.scenario) and setup.scenario.steps:
        found.append(step_error(setup, ends))
    else:
        found.append(
            ErrorEstimate("time step", None, None, 0.0, "nothing moved, or no check asked")
        )
    found.append(rounding_error(stamps_of(schedule(setup.scenario))))
    return found
