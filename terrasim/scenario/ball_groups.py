"""The balls of a scenario: where they start, and what a run asks of them."""

from __future__ import annotations

from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.balls.balls import Balls, reach, step, totals
from terrasim.balls.moving import moving
from terrasim.balls.sleep import settle
from terrasim.cache.needs import Boxes
from terrasim.counts import COUNT_M
from terrasim.scenario.actors import draw_sizes
from terrasim.scenario.scenario import Scenario
from terrasim.scenario.schedule import BALLS, random_numbers
from terrasim.scenario.simulation import Setup
from terrasim.terrain import Terrain

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Start:
    """Balls before the first step."""

    places: Floats
    """Metres east and north of the anchor, and above touching the ground, ``(count, 3)``."""
    velocities: Floats
    """Velocities [m/s], shape ``(count, 3)``."""
    radii: Floats
    """Radii [m], shape ``(count,)``."""
    restitution: Floats
    """Part of the normal speed that a bounce gives back, shape ``(count,)``."""
    friction: Floats
    """Coefficient of friction, shape ``(count,)``."""

    def only(self, chosen: npt.NDArray[np.int64] | None) -> Start:
        """Some of them."""
        if chosen is None:
            return self
        return Start(*(values[chosen] for values in vars(self).values()))


def starts(scenario: Scenario) -> Start:
    """All balls of a scenario, group by group."""
    made: list[tuple[Floats, ...]] = []
    for index, group in enumerate(scenario.balls):
        rng = random_numbers(scenario.run.seed, BALLS, index)
        places = group.region.draw(rng, group.count)
        height = np.full((group.count, 1), group.height)
        made.append(
            (
                np.concatenate([places, height], axis=1),
                np.tile(np.array(group.velocity), (group.count, 1)),
                draw_sizes(group.radius, rng, group.count),
                np.full(group.count, group.restitution),
                np.full(group.count, group.friction),
            )
        )
    return Start(*(np.concatenate(column) for column in zip(*made, strict=True)))


class MovingBalls:
    """The balls of a run."""

    def __init__(self, terrain: Terrain, setup: Setup) -> None:
        """Let them go above the ground as it is now."""
        start = starts(setup.scenario).only(setup.chosen)
        self._anchor = setup.anchor
        self._gravity = setup.scenario.run.gravity_m_s2
        self.radii = start.radii
        """Radii [m], float64, shape ``(count,)``."""
        self._balls = Balls.at(
            terrain,
            start.places,
            start.velocities,
            radius=start.radii,
            restitution=start.restitution,
            friction=start.friction,
            anchor=setup.anchor,
            above_ground=True,
        )

    @property
    def balls(self) -> Balls:
        """Their state."""
        return self._balls

    def needs(self, terrain: Terrain, dt_s: float) -> list[Boxes]:
        """Ground that they may touch within a step."""
        return [reach(terrain, self._balls, dt_s, gravity=self._gravity)]

    def moving(self, terrain: Terrain) -> AbstractContextManager[None]:
        """Let what changes the ground within throw and carry them."""
        return moving(terrain, self._balls)

    def step(self, terrain: Terrain, dt_s: float) -> None:
        """Move them; what they need has been required."""
        step(terrain, self._balls, dt_s, gravity=self._gravity, require=False)

    def places(self, terrain: Terrain) -> Floats:
        """Metres east and north of the anchor, and world z, shape ``(count, 3)``."""
        return self._balls.positions(terrain, self._anchor)

    def state(self) -> list[Any]:
        """All that makes a ball what it is, for a hash."""
        balls = self._balls
        settle(balls)
        return [array.numpy() for array in (balls.cell, balls.offset, balls.z, balls.velocity)]

    def summary(self) -> dict[str, Any]:
        """What happened to them, ready for JSON."""
        balls = self._balls
        settle(balls)
        speed = np.linalg.norm(balls.velocity.numpy(), axis=1)
        counted = asdict(totals(balls))
        error = counted.pop("error")
        return {
            "count": balls.count,
            **counted,
            "coarse_error_m": error * COUNT_M,
            "at_rest": int(np.count_nonzero(speed < 1e-3)),
            "fastest_m_s": float(speed.max()),
        }
