"""Which stamps fall into which step of a run."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from terrasim.deform.stamps import Stamp
from terrasim.scenario.actors import Rng
from terrasim.scenario.images import ImageFile, Images
from terrasim.scenario.scenario import Scenario

SCATTER, BALLS, SAMPLES, CHECK = range(4)
"""Each kind of thing draws its own numbers, so that adding one leaves the others as they are."""


@dataclass(frozen=True)
class Event:
    """Stamps made at one moment."""

    step: int
    """The first step that runs on the changed ground; 0 is before the run."""
    time_s: float
    """When that step begins [s]."""
    stamps: tuple[Stamp, ...]
    """What is made, places in metres from the anchor."""


def random_numbers(seed: int, kind: int, index: int) -> Rng:
    """The generator of one entry of a scenario."""
    return np.random.default_rng([seed, kind, index])


def image_files(scenario: Scenario) -> list[ImageFile]:
    """The image files that a scenario's stamps and dynamics are made of."""
    found = [file for one in (*scenario.stamps, *scenario.scatter) for file in one.files()]
    return found + [file for one in scenario.dynamics for file in one.files()]


def timed_stamps(
    scenario: Scenario, images: Images = MappingProxyType({})
) -> list[tuple[float, Stamp]]:
    """All stamps of a scenario with their times [s], in the file's order.

    Args:
        scenario: The scenario.
        images: What its stamps' image files hold.
    """
    found = [(one.time_s, one.stamp(images)) for one in scenario.stamps]
    for index, group in enumerate(scenario.scatter):
        found += group.draw(random_numbers(scenario.run.seed, SCATTER, index), images)
    return found


def schedule(
    scenario: Scenario, finer: int = 1, *, images: Images = MappingProxyType({})
) -> list[Event]:
    """The stamps of a run by step.

    A stamp waits for the first step of the scenario's own time step that begins at its time or
    later, so a run at half the step makes it at the same moment. One at the end is made after
    the last step.

    Args:
        scenario: The scenario.
        finer: Steps in one of the scenario's.
        images: What its stamps' image files hold.
    """
    own = scenario.run.dt_s
    by_step: dict[int, list[Stamp]] = {}
    for time_s, stamp in timed_stamps(scenario, images):
        # A time that is a whole number of steps up to rounding is that step.
        step = min(math.ceil(time_s / own - 1e-9), scenario.steps)
        by_step.setdefault(step, []).append(stamp)
    return [
        Event(step * finer, step * own, tuple(stamps)) for step, stamps in sorted(by_step.items())
    ]
