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
from terrasim.scenario.ball_parts import spinning, weighed
from terrasim.scenario.scenario import Scenario
from terrasim.scenario.schedule import BALLS, random_numbers
from terrasim.scenario.simulation import Setup
from terrasim.terrain import Terrain

Floats = npt.NDArray[np.float64]
WATER = 1000.0
"""Density of water [kg/m^3]."""


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
    mass: Floats
    """Mass [kg], shape ``(count,)``; that of water where none was given."""
    spin: Floats
    """Spin [rad/s], shape ``(count, 3)``."""
    rolling: Floats
    """Coefficient of rolling friction, shape ``(count,)``."""

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
        radii = draw_sizes(group.radius, rng, group.count)
        of_water = WATER * 4.0 / 3.0 * np.pi * radii**3
        made.append(
            (
                np.concatenate([places, height], axis=1),
                np.tile(np.array(group.velocity), (group.count, 1)),
                radii,
                np.full(group.count, group.restitution),
                np.full(group.count, group.friction),
                of_water if group.mass is None else np.full(group.count, group.mass),
                np.tile(np.array(group.spin or (0.0, 0.0, 0.0)), (group.count, 1)),
                np.full(group.count, group.rolling_friction),
            )
        )
    return Start(*(np.concatenate(column) for column in zip(*made, strict=True)))


class MovingBalls:
    """The balls of a run."""

    def __init__(self, terrain: Terrain, setup: Setup) -> None:
        """Let them go above the ground as it is now."""
        start = starts(setup.scenario).only(setup.chosen)
        self._anchor = setup.anchor
        self._pairs = setup.scenario.pairs
        turns = spinning(setup.scenario)
        self._gravity = setup.scenario.run.gravity_m_s2
        self._struck = self._crowded = self._fast = 0
        self.radii = start.radii
        """Radii [m], float64, shape ``(count,)``."""
        self._balls = Balls.at(
            terrain,
            start.places,
            start.velocities,
            radius=start.radii,
            restitution=start.restitution,
            friction=start.friction,
            mass=start.mass if weighed(setup.scenario) else None,
            spin=start.spin if turns else None,
            rolling=start.rolling if turns else None,
            collision=setup.scenario.collision,
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
        if self._pairs is not None:
            # A scene whose balls pass through one another never reads this.
            from terrasim.balls.pairs import collide

            met = collide(
                terrain,
                self._balls,
                dt_s,
                gravity=self._gravity,
                restitution=self._pairs.restitution,
                friction=self._pairs.friction,
                iterations=self._pairs.iterations,
            )
            self._struck += met.struck
            self._crowded += met.crowded
            self._fast += met.fast

    def places(self, terrain: Terrain) -> Floats:
        """Metres east and north of the anchor, and world z, shape ``(count, 3)``."""
        return self._balls.positions(terrain, self._anchor)

    def state(self) -> list[Any]:
        """All that makes a ball what it is, for a hash."""
        balls = self._balls
        settle(balls)
        arrays = [balls.cell, balls.offset, balls.z, balls.velocity]
        arrays += [] if balls.spin is None else [balls.spin]
        return [array.numpy() for array in arrays]

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
            **self._counted(),
            "coarse_error_m": error * COUNT_M,
            "at_rest": int(np.count_nonzero(speed < 1e-3)),
            "fastest_m_s": float(speed.max()),
        }

    def _counted(self) -> dict[str, Any]:
        """What was counted of what was asked for beyond the usual."""
        balls, found = self._balls, dict[str, Any]()
        if balls.limits is not None:
            found |= {"sub_steps": balls.sub_steps, "made_implicit": balls.made_implicit}
            found["explicit_limit_s"] = balls.limits.step
        if balls.awake is not None:
            found["asleep"] = balls.awake.sleeping
        if self._pairs is not None:
            found |= {"struck": self._struck, "crowded": self._crowded, "fast": self._fast}
        return found
