"""Ground in a store: how fast it acknowledges, how large it grows, how soon it opens."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

from terrasim.bench.bench import Row
from terrasim.deform.commit import apply
from terrasim.deform.edits import edits_of
from terrasim.deform.stamps import Gaussian, Stamp
from terrasim.grid import Grid
from terrasim.open_terrain import open_terrain
from terrasim.sources.analytic import Flat
from terrasim.sources.fractal import Fractal
from terrasim.store.branch import open_branch
from terrasim.store.create import create_store
from terrasim.terrain import Terrain

ACKNOWLEDGED = 2_000
AT_ONCE = 500
ROWS = 5_000
ROW_BYTES = 200
ACKNOWLEDGED_A_SECOND = 1_000.0
TOUCHED = 1_000
LARGE = 1_048_577
BYTES_A_VERSION = 60_000.0
OPENS_IN_S = 1.0
"""The bars."""


def measure(device: str) -> list[Row]:
    """Time stamps on ground that is kept in a store, and look at the store."""
    with tempfile.TemporaryDirectory(prefix="terrasim-bench-") as folder:
        return [
            *_acknowledged(Path(folder) / "small.store", device),
            *_rows(Path(folder) / "rows.store"),
            *_sparse(Path(folder) / "large.store", device),
        ]


def _acknowledged(path: Path, device: str) -> list[Row]:
    """Single stamps, each with its own row on the disk before the next."""
    create_store(path, Flat(Grid(4096, 4096, 1.0)))
    rng = np.random.default_rng(6)
    stamps: list[Stamp] = [
        Gaussian(x, y, 0.01, 4.0)
        for x, y in rng.uniform(40.0, 4000.0, (ACKNOWLEDGED + AT_ONCE, 2)).tolist()
    ]
    with open_terrain(path, device=device) as terrain:
        apply(terrain, stamps[:1])
        queued = _a_second(ACKNOWLEDGED, lambda i: apply(terrain, stamps[i : i + 1], wait=False))
        begun = time.perf_counter()
        terrain.settle()
        settled = time.perf_counter() - begun
        done = _a_second(AT_ONCE, lambda i: apply(terrain, stamps[ACKNOWLEDGED + i :][:1]))
    bar = f"the bar of {ACKNOWLEDGED_A_SECOND:g}"
    return [
        Row(
            "stamps acknowledged, applied later", queued, "1/s", bar, queued / ACKNOWLEDGED_A_SECOND
        ),
        Row(f"applying those {ACKNOWLEDGED} together", settled * 1e3, "ms"),
        Row("stamps acknowledged and applied", done, "1/s", bar, done / ACKNOWLEDGED_A_SECOND),
    ]


def _rows(path: Path) -> list[Row]:
    """The journal alone."""
    create_store(path, Flat(Grid(256, 256, 1.0)))
    with open_branch(path) as branch:
        rate = _a_second(ROWS, lambda i: branch.append(i.to_bytes(ROW_BYTES, "little")))
    return [Row(f"journal rows of {ROW_BYTES} bytes, each flushed", rate, "1/s")]


def _sparse(path: Path, device: str) -> list[Row]:
    """A terrain of 1M x 1M posts of which a thousand blocks were touched."""
    create_store(path, Fractal(Grid(LARGE, LARGE, 1.0), amplitude=500.0))
    rng = np.random.default_rng(8)
    places = rng.choice(4000 * 4000, TOUCHED, replace=False)
    stamps: list[Stamp] = [
        Gaussian(256.0 * (int(one) % 4000) + 128.0, 256.0 * (int(one) // 4000) + 128.0, 2.0, 12.0)
        for one in places
    ]
    before = path.stat().st_size
    with open_terrain(path, device=device) as terrain:
        for start in range(0, TOUCHED, 100):
            apply(terrain, stamps[start : start + 100])
        edits = edits_of(terrain)
        edits.checkpoint()
        versions = sum(1 for _ in edits.require_branch().changed())
    size = (path.stat().st_size - before) / versions
    begun = time.perf_counter()
    with open_terrain(path, device=device) as terrain:
        opened = time.perf_counter() - begun
        _touch(terrain)
    return [
        Row(
            f"store a touched block version, {versions} of {LARGE:,}^2 posts",
            size,
            "bytes",
            f"the bar of {BYTES_A_VERSION:g}",
            size / BYTES_A_VERSION,
        ),
        Row("opening it", opened, "s", f"the bar of {OPENS_IN_S:g} s", opened / OPENS_IN_S),
    ]


def _touch(terrain: Terrain) -> None:
    """Read one block, so that the terrain is truly open."""
    terrain.cache.hold([terrain.cache.residents[0]])


def _a_second(count: int, work: Callable[[int], object]) -> float:
    """How many a second, wall time."""
    begun = time.perf_counter()
    for i in range(count):
        work(i)
    return count / (time.perf_counter() - begun)
