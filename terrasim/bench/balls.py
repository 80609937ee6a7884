"""A step of many balls: per ball, in flight and on the ground, and split over threads."""

from __future__ import annotations

import numpy as np
import warp as wp

from terrasim.balls.balls import Balls, step
from terrasim.bench.bench import Row
from terrasim.bench.timing import cpu_seconds, median_ratio, wall_seconds
from terrasim.grid import Grid
from terrasim.sources.analytic import Sine
from terrasim.terrain import Terrain

COUNT = 200_000
DT = 1.0 / 240.0
STEPS_BEFORE = 240
"""Steps in which balls let go near the ground come to roll."""


def measure(device: str) -> list[Row]:
    """Time steps of balls over 1,024^2 posts of a sine."""
    rows: list[Row] = []
    source = Sine(Grid(1025, 1025, 1.0), amplitude=20.0, wavelength=256.0)
    for what, above in (("in flight", 500.0), ("on the ground", 0.05)):
        with Terrain(source, device=device) as terrain:
            balls = _spread(terrain, above)
            for _ in range(STEPS_BEFORE if above < 1.0 else 2):
                step(terrain, balls, DT)
            rows += _timed(terrain, balls, f"ball step, {what}")
    return rows


def _spread(terrain: Terrain, above: float) -> Balls:
    rng = np.random.default_rng(9)
    place = np.column_stack([rng.uniform(20.0, 1000.0, (COUNT, 2)), np.full(COUNT, above)])
    block = (place[:, 1].astype(np.int64) >> 5) * 1024 + (place[:, 0].astype(np.int64) >> 5)
    place = place[np.argsort(block, kind="stable")]
    return Balls.at(terrain, place, radius=0.1, restitution=0.3, friction=0.4, above_ground=True)


def _timed(terrain: Terrain, balls: Balls, name: str) -> list[Row]:
    arrays = (balls.cell, balls.offset, balls.z, balls.velocity, balls.material, balls.tally)
    bytes_moved = sum(array.capacity for array in arrays)
    state = wp.empty(bytes_moved, dtype=wp.uint8, device=terrain.device)
    other = wp.empty_like(state)

    def ours() -> None:
        step(terrain, balls, DT, require=False)
        wp.synchronize_device(terrain.device)

    def copy() -> None:
        wp.copy(other, state)
        wp.synchronize_device(terrain.device)

    def split() -> None:
        terrain.threads = 2
        ours()
        terrain.threads = 1

    clock = wall_seconds if terrain.device.is_cuda else cpu_seconds
    taken, copied = clock([ours, copy], 9)
    rows = [
        Row(
            name,
            float(np.median(taken)) / COUNT * 1e9,
            "ns a ball",
            "a copy of the balls' state",
            median_ratio(taken, copied),
        )
    ]
    if not terrain.device.is_cuda:
        one, two = wall_seconds([ours, split], 9)
        rows.append(
            Row(
                f"{name}, two threads",
                float(np.median(two)) / COUNT * 1e9,
                "ns a ball (wall)",
                "one thread (wall)",
                median_ratio(two, one),
            )
        )
    return rows
