"""What a run keeps for its pictures, stage and tables while it runs."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.grid import Span
from terrasim.output.stage_tiles import StageTiles, stamp_boxes
from terrasim.output.tiles import choose_tiles
from terrasim.scenario.plan import frame_steps
from terrasim.scenario.schedule import schedule
from terrasim.scenario.simulation import Boxes, Setup, Simulation, stamps_of
from terrasim.scenario.stages import StageTimer

_MARGIN_M = 10.0
"""Ground around what happens that is shown at full detail too [m]."""


class Recording:
    """Places of balls at every frame, and the states of the stage's ground."""

    def __init__(self, setup: Setup, simulation: Simulation, timer: StageTimer) -> None:
        """Begin before the first step."""
        self._setup = setup
        self._simulation = simulation
        self._timer = timer
        self._frames = frozenset(frame_steps(setup.scenario))
        self._places: list[npt.NDArray[np.float64]] = []
        self.times_s: list[float] = []
        """Time of each frame [s]."""
        self.tiles: StageTiles | None = None
        """The stage's ground, if the scenario asks for a stage."""
        if setup.scenario.output.usd:
            with timer.stage("read the stage's ground"):
                self.tiles = self._stage_tiles()

    @property
    def places(self) -> npt.NDArray[np.float64]:
        """Centres of balls [m from the anchor], float64, shape ``(frames, balls, 3)``."""
        if not self._places:
            return np.zeros((0, 0, 3))
        return np.stack(self._places)

    def see(self, boxes: Boxes | None) -> None:
        """Look at the ground where it changed, and at the balls where it is time."""
        simulation = self._simulation
        if boxes is not None and self.tiles is not None:
            with self._timer.stage("read the stage's ground"):
                self.tiles.changed(self.time_code(simulation.time_s), boxes)
        if simulation.step in self._frames and simulation.balls is not None:
            with self._timer.stage("record balls"):
                self._places.append(simulation.balls.places(simulation.terrain))
                self.times_s.append(simulation.time_s)

    def time_code(self, time_s: float) -> float:
        """Time code of a time [s]: frames from the start."""
        # Rounded, so that a whole number of frames is one.
        return round(time_s * self._setup.scenario.output.frames_per_s, 6)

    def _stage_tiles(self) -> StageTiles:
        simulation, scenario = self._simulation, self._setup.scenario
        grid, anchor = simulation.terrain.grid, self._setup.anchor
        stamps = stamps_of(schedule(scenario, images=self._setup.images))
        struck = stamp_boxes(stamps, anchor, grid.spacing)
        if simulation.dynamics is not None:
            struck += simulation.dynamics.boxes
        focus = [*struck, *ball_boxes(self._setup, grid.spacing)]
        choice = choose_tiles(grid, focus, most_cells=scenario.output.usd_cells)
        return StageTiles(simulation.terrain, choice, struck)


def ball_boxes(setup: Setup, spacing: float) -> list[Span]:
    """Level-0 cells over which balls are let go, and some around them."""
    boxes = []
    for group in setup.scenario.balls:
        region = group.region
        row = (np.array([-0.5, 0.5]) * region.size_y + region.y) / spacing
        col = (np.array([-0.5, 0.5]) * region.size_x + region.x) / spacing
        more = np.array([-1.0, 1.0]) * _MARGIN_M / spacing
        rows: Any = np.rint(setup.anchor[0] + row + more).astype(np.int64).tolist()
        cols: Any = np.rint(setup.anchor[1] + col + more).astype(np.int64).tolist()
        boxes.append(Span(rows[0], rows[1], cols[0], cols[1]))
    return boxes
