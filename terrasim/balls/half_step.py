"""How wrong a run's step of time was: a sample of its balls, run again at half the step."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from terrasim.balls.balls import Balls, step
from terrasim.errors import InputError
from terrasim.terrain import Terrain


@dataclass(frozen=True)
class HalfStep:
    """Distances between final places at a step and at half of it."""

    balls: int
    """Balls compared."""
    median: float
    """Median distance [m]; 0 without balls."""
    largest: float
    """Largest distance [m]."""


def half_step_error(
    terrain: Terrain,
    start: Balls,
    dt: float,
    steps: int,
    *,
    gravity: float = 9.81,
    sample: int = 256,
) -> HalfStep:
    """Run a sample of balls twice from their start, at ``dt`` and at half of it, and compare.

    Both runs are on the ground as it is now; the balls given are not changed. Bouncing balls on
    rough ground part exponentially: a median far below the largest is the sign of it.

    Args:
        terrain: The terrain.
        start: The balls at the start of the run.
        dt: Length of its steps [s].
        steps: Number of its steps.
        gravity: Downward acceleration [m/s^2].
        sample: Balls to compare at most, evenly taken from all.

    Raises:
        InputError: If ``steps`` or ``sample`` is below 1, or as :func:`terrasim.balls.balls.step`.
    """
    for name, value in (("steps", steps), ("sample", sample)):
        if value < 1:
            raise InputError(f"{name} must be at least 1, got {value}")
    which = np.unique(np.linspace(0, start.count - 1, min(sample, start.count)).astype(np.int64))
    whole, halved = start.copy(which), start.copy(which)
    for _ in range(steps):
        step(terrain, whole, dt, gravity=gravity)
    for _ in range(2 * steps):
        step(terrain, halved, dt / 2.0, gravity=gravity)
    # From a post among the balls, so that places far away do not lose their last digits.
    cell = whole.cell.numpy()
    anchor = (int(cell[0, 0]), int(cell[0, 1])) if len(cell) else (0, 0)
    apart = whole.positions(terrain, anchor) - halved.positions(terrain, anchor)
    distance = np.sqrt(np.square(apart).sum(axis=1))
    if not len(distance):
        return HalfStep(0, 0.0, 0.0)
    return HalfStep(len(distance), float(np.median(distance)), float(distance.max()))
