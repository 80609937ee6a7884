"""The same balls on the same ground here and in MuJoCo: where they land, and what a step costs."""

from __future__ import annotations

import sys

import numpy as np

from terrasim.bench.bench import Row
from terrasim.engines.comparison import Comparison, Spread
from terrasim.engines.mujoco_balls import drop_beside
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.query import sample
from terrasim.sources.analytic import Sine
from terrasim.sources.fractal import Fractal
from terrasim.sources.source import Source
from terrasim.terrain import Terrain

COUNT = 1_000
SIDE = 513
"""Posts along a side of the ground, 0.25 m apart."""
DT = 1e-3
DURATION = 6.0
"""Time run [s]: all that slides has come to rest, and most of what rolls."""


def grounds() -> dict[str, Source]:
    """A smooth ground, and one whose every cell is a facet of its own."""
    grid = Grid(SIDE, SIDE, 0.25)
    return {
        "sine": Sine(grid, amplitude=0.5, wavelength=16.0),
        "fractal": Fractal(grid, amplitude=8.0, wavelength=256, octaves=8),
    }


def measure(device: str) -> list[Row]:
    """Drop 1,000 balls of 0.1 to 0.2 m from 0.2 to 2 m above each ground."""
    rows: list[Row] = []
    for name, source in grounds().items():
        for kind, rolling in (("sliding", None), ("rolling", 0.1)):
            try:
                with Terrain(source, device=device) as terrain:
                    found = dropped(terrain, rolling=rolling)
            except InputError as error:
                print(f"terrasim: {error}: its comparison is left out", file=sys.stderr)
                return rows
            rows += _rows(f"MuJoCo, {name}, {kind}", found)
    return rows


def dropped(
    terrain: Terrain,
    count: int = COUNT,
    *,
    rolling: float | None = None,
    restitution: float = 0.3,
    duration: float = DURATION,
) -> Comparison:
    """Drop balls over the middle half of a ground, at random."""
    rng = np.random.default_rng(4)
    grid, radii = terrain.grid, rng.uniform(0.1, 0.2, count)
    size = (SIDE - 1) * grid.spacing
    across = rng.uniform(0.25 * size, 0.75 * size, (count, 2))
    ground = sample(terrain, across + np.array([grid.x, grid.y])).height
    z = ground + 1.5 * radii + rng.uniform(0.2, 2.0, count)
    return drop_beside(
        terrain,
        np.column_stack([across, z]),
        radii,
        restitution=restitution,
        friction=0.5,
        rolling=rolling,
        dt=DT,
        duration=duration,
    )


def _rows(name: str, found: Comparison) -> list[Row]:
    """Differences beside the step and the radius that they are to be seen against."""
    late, touch = Spread.of(found.late_s * 1e3), Spread.of(found.touch_m * 1e6)
    rest = Spread.of(found.rest_m * 1e3)
    half, radius, count = 0.5e3 * found.drop.dt, 150.0, found.drop.count
    lost = sum(found.counts()[what][1] for what in ("buried", "dropped through"))
    unit = "us a ball" if found.ours.cpu else "us a ball (wall)"
    return [
        Row(f"{name}: first contact", late.median, "ms apart", "half a step", late.median / half),
        Row(f"{name}: its place", touch.median, "um apart"),
        Row(f"{name}: its place, worst", touch.largest, "um apart"),
        Row(f"{name}: rest", rest.median, "mm apart", "a radius", rest.median / radius),
        Row(f"{name}: rest, 9 of 10 within", rest.most, "mm apart", "a radius", rest.most / radius),
        Row(f"{name}: at rest in both", rest.count, "balls", "all", rest.count / count),
        Row(f"{name}: buried or through", lost, "balls in MuJoCo", "all", lost / count),
        Row(f"{name}: step", found.ours.step_us, unit, "MuJoCo's", 1.0 / found.cost_ratio),
        Row(f"{name}: MuJoCo's step", found.theirs.step_us, "us a ball", "ours", found.cost_ratio),
    ]
