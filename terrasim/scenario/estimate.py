"""How wrong a run is: levels, time step, rounding; each in metres, with what it cost to know."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.cache.counters import Counters
from terrasim.counts import COUNT_M
from terrasim.deform.stamps import Stamp
from terrasim.scenario.plan import checked_balls
from terrasim.scenario.schedule import CHECK, random_numbers, schedule
from terrasim.scenario.simulation import Setup, Simulation, stamps_of
from terrasim.scenario.stages import StageTimer

Places = npt.NDArray[np.float64]

FINER = 2
"""The check runs at a step smaller by this."""
_BINS = 1024
"""Bins along a side in which overlapping stamps are counted."""


@dataclass(frozen=True)
class ErrorEstimate:
    """One way in which a run is wrong."""

    name: str
    """What makes it so."""
    metres: float | None
    """By how much: a bound, or the largest that was found [m]; None if it does not apply."""
    typical_m: float | None
    """The median of what was found [m], where there is one."""
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


def dynamic_errors(dynamics: Sequence[dict[str, Any]]) -> list[ErrorEstimate]:
    """What posts and steps may have made of waves, from what became of all dynamics."""
    return [
        ErrorEstimate(
            f"posts and steps, dynamics[{index}]",
            one["error_m"],
            one["typical_error_m"],
            one["error_cost_s"],
            "a third of the difference to the same wave on every second post at twice the step",
        )
        for index, one in enumerate(dynamics, 1)
        if "error_m" in one
    ]


def rounding_error(stamps: Sequence[Stamp], dynamics: int = 0) -> ErrorEstimate:
    """Bound of what rounding to counts may have changed; a dynamic is rounded once, as a total."""
    begun = time.perf_counter()
    most = most_overlapping(stamps) + dynamics
    metres = 0.5 * COUNT_M * (1 + most)
    note = "half a count for the source"
    if most:
        what = "stamp and dynamic" if dynamics else "stamp"
        note += f" and for each {what}; at most {most} of them meet at one post"
    return ErrorEstimate("rounding to counts", metres, None, time.perf_counter() - begun, note)


def most_overlapping(stamps: Sequence[Stamp]) -> int:
    """Bound of how many stamps share a post: those whose squares touch one bin of a coarse grid."""
    if len(stamps) < 2:
        return len(stamps)
    spans = []
    extents = np.array([one.extent for one in stamps])
    for axis, centre in ((1, [one.y for one in stamps]), (0, [one.x for one in stamps])):
        low, high = centre + extents[:, axis], centre + extents[:, axis + 2]
        size = max(float(high.max() - low.min()) / _BINS, 1e-300)
        first, last = (((end - low.min()) / size).astype(np.int64) for end in (low, high))
        spans.append((np.clip(first, 0, _BINS - 1), np.clip(last, 0, _BINS - 1) + 1))
    (row0, row1), (col0, col1) = spans
    count = np.zeros((_BINS + 1, _BINS + 1), np.int64)
    for row, col, sign in ((row0, col0, 1), (row0, col1, -1), (row1, col0, -1), (row1, col1, 1)):
        np.add.at(count, (row, col), sign)
    return int(count.cumsum(axis=0).cumsum(axis=1).max())


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
    again = Setup(scenario, setup.source, setup.anchor, FINER, chosen, setup.images)
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
    if shown.get("detail_parts", 0) < shown.get("detail_factor", 0):
        note += (
            f"; of its detail's {shown['detail_factor']} cells along a side it shows "
            f"{shown['detail_parts']}: raise output.usd_cells to show more"
        )
    return ErrorEstimate("levels, stage", shown["error_m"], None, 0.0, note)


def estimate(
    setup: Setup,
    counters: Counters,
    shown: dict[str, Any],
    ends: Places | None,
    dynamics: Sequence[dict[str, Any]] = (),
) -> list[ErrorEstimate]:
    """All estimates of a run.

    Args:
        setup: What it was made from.
        counters: What its cache did.
        shown: What its stage shows; empty without one.
        ends: Where each ball came to, metres from the anchor; None if there are none.
        dynamics: What became of each dynamic.
    """
    found = [*level_errors(counters), stage_error(shown)]
    if ends is not None and checked_balls(setup.scenario) and setup.scenario.steps:
        found.append(step_error(setup, ends))
    else:
        found.append(
            ErrorEstimate("time step", None, None, 0.0, "nothing moved, or no check asked")
        )
    found += dynamic_errors(dynamics)
    stamps = stamps_of(schedule(setup.scenario, images=setup.images))
    found.append(rounding_error(stamps, len(dynamics)))
    return found
