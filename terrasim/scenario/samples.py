"""Heights that a scenario asks for at the end of its run."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.scenario.scenario import Scenario
from terrasim.scenario.schedule import SAMPLES, random_numbers
from terrasim.scenario.simulation import Setup, Simulation


@dataclass(frozen=True)
class Sampled:
    """Answers for one group of places."""

    level: int
    """Level that was asked for."""
    places: npt.NDArray[np.float64]
    """Places [m from the anchor], shape ``(count, 2)``."""
    height: npt.NDArray[np.float64]
    """World z of the ground [m], shape ``(count,)``; NaN in holes."""
    state: npt.NDArray[np.uint8]
    """As :class:`terrasim.query.Sample` has it, shape ``(count,)``."""

    def summary(self) -> dict[str, Any]:
        """Lowest, mean and highest height, ready for JSON."""
        known = self.height[np.isfinite(self.height)]
        empty = known.size == 0
        return {
            "count": len(self.height),
            "level": self.level,
            "lowest_m": None if empty else float(known.min()),
            "mean_m": None if empty else float(known.mean()),
            "highest_m": None if empty else float(known.max()),
            "without_ground": int(len(self.height) - known.size),
        }


def take_samples(setup: Setup, simulation: Simulation) -> list[Sampled]:
    """Ask for the heights of all groups of places."""
    from terrasim.query import sample

    scenario: Scenario = setup.scenario
    grid = simulation.terrain.grid
    origin = np.array([grid.post_x(setup.anchor[1]), grid.post_y(setup.anchor[0])])
    found = []
    for index, group in enumerate(scenario.samples):
        rng = random_numbers(scenario.run.seed, SAMPLES, index)
        places = group.region.draw(rng, group.count)
        answer = sample(simulation.terrain, origin + places, level=group.level)
        found.append(Sampled(group.level, places, answer.height, answer.state))
    return found
