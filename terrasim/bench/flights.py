"""The papers' terrain of 1M x 1M posts, flown over with a fixed pool."""

from __future__ import annotations

import resource
import time

from terrasim.bench.bench import Row
from terrasim.bench.flight import FlightReport, fly
from terrasim.grid import Grid
from terrasim.sources.fractal import Fractal
from terrasim.sources.mirror import Mirrored
from terrasim.sources.source import Source
from terrasim.terrain import Terrain

SIDE = (1 << 20) + 1
POOL_BYTES = 256 << 20


def measure(device: str) -> list[Row]:
    """Open it, fly 2,000 steps, climb through all levels and dive."""
    source = endless(SIDE)
    start = time.perf_counter()
    with Terrain(source, device=device, pool_bytes=POOL_BYTES) as terrain:
        opened = time.perf_counter() - start
        report = fly(terrain)
    return [
        Row("1M x 1M, open", opened, "s", "1 s", opened),
        *flight_rows("1M x 1M", report),
        Row("1M x 1M, process", peak_mib(), "MiB", "1 GiB", peak_mib() / 1024.0),
    ]


def endless(side: int) -> Source:
    """A mirrored terrain of ``side`` posts each way from 1025 x 1025 of fractal noise."""
    grid = Grid(1025, 1025, 1.0)
    small = Fractal(grid, amplitude=400.0, seed=5)
    return Mirrored(small, rows=side, cols=side)


def flight_rows(name: str, report: FlightReport) -> list[Row]:
    """A flight's figures, each beside its bar."""
    median, high, worst = report.queue_ms
    return [
        Row(f"{name}, steps in budget", report.in_budget, "share", "99 %", report.in_budget / 0.99),
        Row(
            f"{name}, steps in budget by CPU time",
            report.in_budget_cpu,
            "share",
            "99 %",
            report.in_budget_cpu / 0.99,
        ),
        Row(f"{name}, queue a step, median", median, "ms", "2 ms", median / 2.0),
        Row(f"{name}, queue a step, 99th percentile", high, "ms", "2 ms", high / 2.0),
        Row(f"{name}, queue a step, largest", worst, "ms", "2 ms", worst / 2.0),
        Row(f"{name}, stalls after the first fill", report.stalls, "steps"),
        Row(f"{name}, fallbacks in the need radius", report.fallbacks, "points"),
        Row(f"{name}, late steps", report.late, "steps", "all steps", report.late / report.steps),
        Row(
            f"{name}, blocks passed",
            report.passed,
            "blocks",
            "layers of the pool",
            report.passed / report.layers,
        ),
        Row(f"{name}, blocks read and decoded", report.loads, "blocks"),
        Row(f"{name}, blocks evicted", report.evictions, "blocks"),
    ]


def peak_mib() -> float:
    """Largest resident size of this process so far [MiB]."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
