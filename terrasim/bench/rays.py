"""Oblique rays, against straight-down queries of the same number."""

from __future__ import annotations

import numpy as np

from terrasim.bench.bench import Row
from terrasim.bench.timing import cpu_seconds, median_ratio, wall_seconds
from terrasim.grid import Grid
from terrasim.query import sample
from terrasim.raycast import raycast
from terrasim.sources.analytic import Sine
from terrasim.terrain import Terrain

COUNT = 100_000


def measure(device: str) -> list[Row]:
    """Rays from 2 m above the ground, a few degrees down, as a scanner on a vehicle sends them."""
    rng = np.random.default_rng(8)
    points = rng.uniform(100.0, 900.0, (COUNT, 2))
    angle = rng.uniform(0.0, 2.0 * np.pi, COUNT)
    dip = np.radians(rng.uniform(2.0, 25.0, COUNT))
    ways = np.stack(
        [np.cos(angle) * np.cos(dip), np.sin(angle) * np.cos(dip), -np.sin(dip)], axis=1
    )
    with Terrain(
        Sine(Grid(1025, 1025, 1.0), amplitude=20.0, wavelength=256.0), device=device
    ) as terrain:
        starts = np.column_stack([points, sample(terrain, points).height + 2.0])
        clock = wall_seconds if terrain.device.is_cuda else cpu_seconds
        rays, down = clock(
            [
                lambda: raycast(terrain, starts, ways, max_distance=120.0),
                lambda: sample(terrain, points),
            ],
            5,
        )
    return [
        Row(
            "ray of a scanner",
            float(np.median(rays)) / COUNT * 1e9,
            "ns a ray",
            "a height straight down",
            median_ratio(rays, down),
        )
    ]
