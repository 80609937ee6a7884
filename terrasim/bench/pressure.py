"""A store on disk under pressure: a small pool and a slow disk.

A synthetic raster of 16,385^2 posts is built into a store; the pool is a tenth of the blocks that
the path passes, and every load takes 5 ms longer than it does.
"""

from __future__ import annotations

import tempfile
import time
from pathlib import Path

from terrasim.bench.bench import Row
from terrasim.bench.flight import Delayed, blocks_passed, fly
from terrasim.bench.flights import flight_rows
from terrasim.cache.pool import BLOCK_BYTES
from terrasim.grid import Grid
from terrasim.sources.fractal import Fractal
from terrasim.store.build import build_store
from terrasim.store.pyramid import SourceRows
from terrasim.store.store import open_store
from terrasim.terrain import Terrain

SIDE = (1 << 14) + 1
STEPS = 2000
DELAY_S = 0.005


def measure(device: str) -> list[Row]:
    """Build the store, fly over it, and report what the build and the flight took."""
    grid = Grid(SIDE, SIDE, 1.0)
    noise = Fractal(grid, amplitude=600.0, wavelength=2048, octaves=9, seed=11)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "synthetic.terrasim"
        start = time.perf_counter()
        build_store(
            SourceRows(noise),
            grid,
            path,
            provenance={"made by": "terrasim bench"},
            synthetic=noise.synthetic,
        )
        built = time.perf_counter() - start
        size = path.stat().st_size
        pool_bytes = blocks_passed(grid, STEPS) // 10 * BLOCK_BYTES
        with (
            open_store(path) as store,
            Terrain(Delayed(store, DELAY_S), device=device, pool_bytes=pool_bytes) as terrain,
        ):
            report = fly(terrain, steps=STEPS)
    raw = 4.0 * SIDE * SIDE
    return [
        Row("store of 16,385^2, built in", built, "s"),
        Row("store of 16,385^2, size", size / 2**20, "MiB", "its level-0 posts", size / raw),
        *flight_rows("store under pressure", report),
    ]
