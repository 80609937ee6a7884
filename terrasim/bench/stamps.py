"""Stamps: one large, many small, and whether the cost of one grows with what was done before."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import warp as wp

from terrasim.bench.bench import Row
from terrasim.bench.timing import cpu_seconds, median_ratio, wall_seconds
from terrasim.counts import COUNTS_PER_M
from terrasim.deform.apply import apply_stamps
from terrasim.deform.stamps import Crater, Gaussian, Stamp
from terrasim.grid import Grid
from terrasim.sources.analytic import Flat
from terrasim.terrain import Terrain

SIDE = 1024
MANY = 10_000
RADIUS = 16.0
LARGE_MS, MANY_MS = 6.0, 500.0
"""The bars [ms]."""
BEFORE = (10, 100, 1_000, 10_000, 100_000)
BLOCKS_BEFORE = (1, 100, 10_000)
SMALL_BATCH = 100


def measure(device: str) -> list[Row]:
    """Time stamps on level ground, their ledgers and all levels included."""
    return [
        *_large(device),
        *_many(device),
        *_after_stamps(device),
        *_after_blocks(device),
    ]


def _clock(terrain: Terrain) -> Callable[..., list[list[float]]]:
    return wall_seconds if terrain.device.is_cuda else cpu_seconds


def _stamping(terrain: Terrain, stamps: list[Stamp]) -> Callable[[], None]:
    def work() -> None:
        apply_stamps(terrain, stamps)
        wp.synchronize_device(terrain.device)

    return work


def _large(device: str) -> list[Row]:
    """A gaussian over all of 1,024^2 posts, beside NumPy doing the sum alone."""
    heights = np.zeros((SIDE, SIDE), dtype=np.int32)
    sigma = SIDE / 10.0
    along = np.exp(-((np.arange(SIDE) - SIDE / 2) ** 2) / (2.0 * sigma**2))

    def numpy_does() -> None:
        rise = np.outer(along * (0.01 * COUNTS_PER_M), along)
        np.add(heights, np.rint(rise).astype(np.int32), out=heights)

    with Terrain(Flat(Grid(SIDE, SIDE, 1.0)), device=device) as terrain:
        stamps: list[Stamp] = [Gaussian(SIDE / 2.0, SIDE / 2.0, 0.01, sigma)]
        ours, numpys = _clock(terrain)([_stamping(terrain, stamps), numpy_does], 15)
        wide: list[Stamp] = [Gaussian(SIDE / 2.0, SIDE / 2.0, 10.0, 1.5 * sigma)]
        [every] = _clock(terrain)([_stamping(terrain, wide)], 15)
    return [
        _bar(f"gaussian over {SIDE}^2 posts, all levels, ledger and bounds", every, LARGE_MS),
        Row(
            "gaussian of 1 cm over 700^2 of them",
            float(np.median(ours)) * 1e3,
            "ms",
            "NumPy's level 0 alone",
            median_ratio(ours, numpys),
        ),
    ]


def _many(device: str) -> list[Row]:
    """Ten thousand craters of 16 posts in one call."""
    rng = np.random.default_rng(3)
    places = rng.uniform(20.0, 1000.0, (MANY, 2)).tolist()
    stamps: list[Stamp] = [Crater(x, y, RADIUS, 0.1) for x, y in places]
    with Terrain(Flat(Grid(SIDE, SIDE, 1.0)), device=device) as terrain:
        [taken] = _clock(terrain)([_stamping(terrain, stamps)], 5)
    return [_bar(f"{MANY} stamps of radius 16 posts", taken, MANY_MS)]


def _after_stamps(device: str) -> list[Row]:
    """Cost of a stamp after 10 to 100,000 others on the same ground."""
    rng = np.random.default_rng(4)
    rows: list[Row] = []
    first: list[float] = []
    done = 0
    with Terrain(Flat(Grid(4 * SIDE, 4 * SIDE, 1.0)), device=device) as terrain:
        for before in BEFORE:
            while done < before:
                count = min(before - done, 10_000)
                apply_stamps(terrain, _small(rng, count, 4.0 * SIDE))
                done += count
            [taken] = _clock(terrain)([_stamping(terrain, _small(rng, 1, 4.0 * SIDE))], 25)
            first = first or taken
            rows.append(_grown(f"one stamp after {before} others", taken, first, BEFORE[0]))
    return rows


def _after_blocks(device: str) -> list[Row]:
    """Cost of a stamp after 1 to 10,000 blocks were touched, most of them out of the pool."""
    side = 105 * 256
    rng = np.random.default_rng(5)
    rows: list[Row] = []
    first: list[float] = []
    done = 0
    with Terrain(Flat(Grid(side, side, 1.0)), device=device) as terrain:
        for before in BLOCKS_BEFORE:
            places = [(done + i) for i in range(before - done)]
            stamps: list[Stamp] = [
                Gaussian(256.0 * (i % 104) + 128.0, 256.0 * (i // 104) + 128.0, 0.1, 4.0)
                for i in places
            ]
            for start in range(0, len(stamps), 200):
                apply_stamps(terrain, stamps[start : start + 200])
            done = before
            [taken] = _clock(terrain)([_stamping(terrain, _small(rng, 1, 1000.0))], 25)
            first = first or taken
            name = f"one stamp after {before} blocks were touched"
            rows.append(_grown(name, taken, first, BLOCKS_BEFORE[0]))
    return rows


def _small(rng: np.random.Generator, count: int, side: float) -> list[Stamp]:
    places = rng.uniform(40.0, side - 40.0, (count, 2)).tolist()
    return [Gaussian(x, y, 0.01, 4.0) for x, y in places]


def _bar(name: str, taken: list[float], bar_ms: float) -> Row:
    value = float(np.median(taken)) * 1e3
    return Row(name, value, "ms", f"the bar of {bar_ms:g} ms", value / bar_ms)


def _grown(name: str, taken: list[float], first: list[float], smallest: int) -> Row:
    value = float(np.median(taken)) * 1e3
    return Row(name, value, "ms", f"after {smallest}", value / (float(np.median(first)) * 1e3))
