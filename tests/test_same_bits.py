"""One run, whatever it runs on: the same hash of heights and balls."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass

import numpy as np

from terrasim.balls.balls import Balls, step
from terrasim.cache.agent import Agent, ahead
from terrasim.cache.pool import BLOCK_BYTES
from terrasim.deform.apply import apply
from terrasim.deform.stamps import Crater
from terrasim.grid import Block, Grid
from terrasim.query import sample
from terrasim.sources.fractal import Fractal
from terrasim.sources.source import BlockData
from terrasim.terrain import Terrain

GRID = Grid(8193, 8193, 1.0)
MIDDLE = (4224, 4224)
"""A post in the middle of a level-0 block."""


@dataclass(frozen=True)
class Way:
    """One way to run the same thing."""

    layers: int
    threads: int = 1
    delay_s: float = 0.0


class Slow(Fractal):
    """Fractal ground from a disk that takes its time."""

    delay_s = 0.0

    def block(self, key: Block) -> BlockData:
        time.sleep(self.delay_s)
        return super().block(key)


def run(way: Way) -> tuple[str, int, int]:
    """Balls roll into a crater while an agent flies by; the hash, loads and evictions."""
    source = Slow(GRID, amplitude=60.0, seed=3)
    object.__setattr__(source, "delay_s", way.delay_s)
    rng = np.random.default_rng(1)
    place = np.column_stack([rng.uniform(-40.0, 40.0, (2500, 2)), rng.uniform(0.0, 3.0, 2500)])
    with Terrain(source, pool_bytes=way.layers * BLOCK_BYTES, threads=way.threads) as terrain:
        balls = Balls.at(terrain, place, radius=0.2, anchor=MIDDLE, above_ground=True)
        flier = Agent(float(MIDDLE[0]), float(MIDDLE[1]), 60.0, 0.0, 40.0, 90.0)
        for number in range(40):
            if number == 10:
                apply(terrain, [Crater(5.0, -3.0, 15.0, 4.0, 1.0)], anchor=MIDDLE)
            step(terrain, balls, 0.02)
            # Somewhere else each time: a small pool has to give a block away.
            sample(terrain, [[200.0 * number, 300.0]])
            terrain.cache.want(ahead([flier], GRID, (1, 2)))
            terrain.cache.work(2.0)
            flier = flier.moved()
        states = [array.numpy() for array in (balls.cell, balls.offset, balls.z, balls.velocity)]
        around = np.array(MIDDLE[::-1]) + rng.uniform(-60.0, 60.0, (5000, 2))
        states.append(sample(terrain, around).height)
        digest = hashlib.blake2b(b"".join(state.tobytes() for state in states)).hexdigest()
        counters = terrain.cache.counters
        return digest, counters.loads, counters.evictions


def test_threads_pools_and_slow_disks_change_no_bit() -> None:
    """1, 2 and 3 threads; a pool of 8 that evicts and one of 800 that never does; delayed reads."""
    ways = [Way(800), Way(800, 2), Way(800, 3), Way(8), Way(8, 2, 0.003), Way(800, 1, 0.003)]
    found = [run(way) for way in ways]
    assert {digest for digest, _, _ in found} == {found[0][0]}
    evictions = {way: evicted for way, (_, _, evicted) in zip(ways, found, strict=True)}
    assert evictions[Way(8)] > 20
    assert evictions[Way(800)] == 0
