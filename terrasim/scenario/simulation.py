"""A scenario in motion: the ground, what changes it, what moves on it, and the clock."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import numpy.typing as npt

from terrasim.cache.agent import Agent, ahead
from terrasim.cache.needs import Need
from terrasim.grid import Span
from terrasim.output.stage_tiles import stamp_boxes
from terrasim.scenario.agent_path import agent_at
from terrasim.scenario.changing_ground import ChangingGround
from terrasim.scenario.images import Images
from terrasim.scenario.scenario import Scenario
from terrasim.scenario.schedule import Event, schedule
from terrasim.scenario.stages import StageTimer
from terrasim.sources.source import Source
from terrasim.terrain import Terrain

Boxes = list[Span]
"""Rectangles of level-0 cells."""
LOOKAHEAD = (4, 8, 16, 32)
"""Steps for which agents' needs are fetched ahead."""


@dataclass(frozen=True)
class Setup:
    """What a simulation is made from."""

    scenario: Scenario
    """The scenario."""
    source: Source
    """Its terrain."""
    anchor: tuple[int, int]
    """Row and column of the post that places are measured from."""
    finer: int = 1
    """Steps in one of the scenario's."""
    chosen: npt.NDArray[np.int64] | None = None
    """Which balls take part; all by default."""
    images: Images = field(default_factory=dict)
    """What the image files of its stamps hold."""
    store: Path | None = None
    """Where the ground's store is to be made, if the scenario asks for one."""

    @property
    def dt_s(self) -> float:
        """Time step [s]."""
        return self.scenario.run.dt_s / self.finer

    @property
    def steps(self) -> int:
        """Number of steps."""
        return self.scenario.steps * self.finer


class Simulation:
    """Runs a scenario step by step. Close it, or use it as a context manager."""

    def __init__(self, setup: Setup, timer: StageTimer) -> None:
        """Open the terrain and make what was there before the run.

        Args:
            setup: What it is made from.
            timer: Where its stages are counted.
        """
        self._setup = setup
        self._timer = timer
        self.step = 0
        scenario = setup.scenario
        self.ground = ChangingGround(scenario, setup.source, setup.store, timer)
        """The ground and what is done to it."""
        self.balls: Any = None
        self.dynamics: Any = None
        """What changes the ground over time; None in a scene without."""
        try:
            self._prepare_dynamics()
            self._events = {
                event.step: event for event in schedule(scenario, setup.finer, images=setup.images)
            }
            self.change_ground()
            self._place_balls()
        except BaseException:
            self.close()
            raise

    @property
    def terrain(self) -> Terrain:
        """The terrain."""
        return self.ground.terrain

    @property
    def time_s(self) -> float:
        """Simulated time [s]."""
        return self.step * self._setup.dt_s

    @property
    def agents(self) -> list[Agent]:
        """Agents where they are now."""
        setup = self._setup
        spacing = self.terrain.grid.spacing
        return [
            agent_at(one, self.time_s, setup.dt_s, setup.anchor, spacing)
            for one in setup.scenario.agents
        ]

    def run(self, see: Callable[[Boxes | None], None] | None = None) -> None:
        """Run to the end.

        Args:
            see: Called before the first step, and between steps after the ground changed, with
                where it did; once more at the end.
        """
        see = see or _look_away
        see(None)
        begun = time.perf_counter()
        while self.step < self._setup.steps:
            self.advance()
            if self._setup.scenario.run.paced:
                time.sleep(max(0.0, begun + self.time_s - time.perf_counter()))
            see(self.change_ground())

    def advance(self) -> None:
        """One step: what it reads is brought in, balls move, then the job queue works."""
        setup, cache = self._setup, self.terrain.cache
        agents = self.agents
        with self._timer.stage("bring in what steps read"):
            needs: list[Need] = [agent.need(self.terrain.grid) for agent in agents]
            if self.balls is not None:
                needs += self.balls.needs(self.terrain, setup.dt_s)
            cache.require(needs)
        if self.balls is not None:
            with self._timer.stage("step balls"):
                self.balls.step(self.terrain, setup.dt_s)
        with self._timer.stage("work the job queue"):
            cache.want(ahead(agents, self.terrain.grid, LOOKAHEAD))
            cache.work(setup.scenario.pool.budget_ms)
        self.step += 1

    def change_ground(self) -> Boxes | None:
        """Let dynamics go on, make the stamps of this step, let slump, and see to the store.

        Returns:
            Rectangles of level-0 cells in which it may have changed; None if it did not.
        """
        setup, boxes = self._setup, []
        if self.dynamics is not None:
            with self._moving():
                boxes += self.ground.go_on(self.dynamics, self.step)
        event = self._events.get(self.step)
        if event is not None:
            self.ground.stamp(event.stamps, setup.anchor)
            boxes += stamp_boxes(event.stamps, setup.anchor, self.terrain.grid.spacing)
        if setup.scenario.relaxation is not None:
            with self._moving():
                boxes += self.ground.slump()
        before_s = self.time_s - setup.dt_s if self.step else -1.0
        self.ground.keep(before_s, self.time_s)
        return boxes or None

    def close(self) -> None:
        """Write what was done to the ground, if there is a store, and end the terrain's threads."""
        self.ground.close()

    def __enter__(self) -> Self:
        """Use it as a context manager."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        value: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close."""
        self.close()

    def _moving(self) -> AbstractContextManager[None]:
        """Let what changes the ground within throw and carry the balls."""
        return nullcontext() if self.balls is None else self.balls.moving(self.terrain)

    def _prepare_dynamics(self) -> None:
        if not self._setup.scenario.dynamics:
            return
        from terrasim.scenario.running_dynamics import RunningDynamics

        with self._timer.stage("prepare dynamics"):
            self.dynamics = RunningDynamics(self.terrain, self._setup)

    def _place_balls(self) -> None:
        if not self._setup.scenario.balls:
            return
        from terrasim.scenario.ball_groups import MovingBalls

        with self._timer.stage("place balls"):
            self.balls = MovingBalls(self.terrain, self._setup)


def _look_away(boxes: Boxes | None) -> None:
    """See nothing."""


def stamps_of(events: Sequence[Event]) -> list[Any]:
    """All stamps of some events."""
    return [stamp for event in events for stamp in event.stamps]
