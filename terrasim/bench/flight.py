"""Flights over large terrains: does the queue keep up, within its budget, without a stall?

An agent with a need radius of 512 posts moves 8 posts a step for 2,000 steps, then climbs through
all levels and dives back while it moves on. Steps are paced at 60 Hz.
"""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from terrasim.cache.agent import Agent, ahead
from terrasim.grid import Block, Grid
from terrasim.query import sample
from terrasim.sources.source import BlockData, Source
from terrasim.terrain import Terrain

RADIUS = 512.0
"""Need radius [posts]."""
POSTS_PER_STEP = 8.0
HEADING = math.radians(37.0)
STEPS_PER_LEVEL = 60
"""Steps the climb takes from one level to the next."""
LOOKAHEAD = (4, 8, 24, 48)
"""Steps ahead at which the wanted ground is computed."""


@dataclass(frozen=True)
class FlightReport:
    """What a flight found."""

    steps: int
    """Steps after the first fill."""
    stalls: int
    """Steps after the first fill that waited for a required block."""
    fallbacks: int
    """Points inside the need radius, 256 a step, that a coarser level answered."""
    in_budget: float
    """Share of the steps whose queue work kept its budget."""
    in_budget_cpu: float
    """The same in CPU time of the stepping thread: what a busy machine does not spoil."""
    queue_ms: tuple[float, float, float]
    """Median, 99th percentile and largest queue time of a step [ms]."""
    late: int
    """Steps that ended after their time at 60 Hz."""
    passed: int
    """Distinct blocks inside the need radius over the whole path."""
    loads: int
    """Blocks read, decoded and placed."""
    evictions: int
    """Blocks that made room."""
    layers: int
    """Layers of the pool."""


class Delayed:
    """A source that adds a fixed delay to every block it reads."""

    def __init__(self, source: Source, delay_s: float) -> None:
        """Wrap a source."""
        self._source = source
        self._delay_s = delay_s
        self.grid: Grid = source.grid
        self.synthetic = source.synthetic
        self.posts = source.posts

    def block(self, key: Block) -> BlockData:
        """Read the block and wait."""
        time.sleep(self._delay_s)
        return self._source.block(key)


def flight_path(grid: Grid, steps: int) -> Iterator[Agent]:
    """The agent at every step: level flight, then a climb to the top and a dive.

    It turns back where it would come nearer than its need radius to an edge.
    """
    margin = RADIUS + POSTS_PER_STEP
    agent = Agent(grid.row + grid.rows / 4, grid.col + grid.cols / 4, RADIUS)
    rows, cols = POSTS_PER_STEP * math.sin(HEADING), POSTS_PER_STEP * math.cos(HEADING)
    climb_steps = STEPS_PER_LEVEL * (grid.top + 1)
    for step in range(steps + 2 * climb_steps):
        climb = 0.0
        if step >= steps:
            climb = (grid.top + 0.5) / climb_steps * (1 if step < steps + climb_steps else -1)
        if not grid.row + margin <= agent.row + rows <= grid.row + grid.rows - 1 - margin:
            rows = -rows
        if not grid.col + margin <= agent.col + cols <= grid.col + grid.cols - 1 - margin:
            cols = -cols
        agent = Agent(agent.row, agent.col, RADIUS, agent.height, rows, cols, climb)
        yield agent
        agent = agent.moved()


def blocks_passed(grid: Grid, steps: int) -> int:
    """Distinct blocks inside the need radius over a path."""
    passed: set[Block] = set()
    for agent in flight_path(grid, steps):
        need = agent.need(grid)
        passed.update(need.blocks(grid, need.level))
    return len(passed)


def fly(
    terrain: Terrain,
    *,
    steps: int = 2000,
    budget_ms: float = 2.0,
    hz: float = 60.0,
    progress: Callable[[float], None] | None = None,
) -> FlightReport:
    """Fly the path over a terrain and report whether its needs were met in time."""
    grid, cache = terrain.grid, terrain.cache
    # A loader thread that holds Python's lock gives it back at this interval; the default is 5 ms.
    interval = sys.getswitchinterval()
    sys.setswitchinterval(0.0002)
    try:
        path = list(flight_path(grid, steps))
        _fill(terrain, path[0])
        before = (cache.counters.stalls, cache.counters.fallbacks)
        passed: set[Block] = set()
        queue, queue_cpu, late = [], [], 0
        due = time.perf_counter()
        for step, agent in enumerate(path):
            need = agent.need(grid)
            cache.require([need])
            passed.update(need.blocks(grid, need.level))
            _look(terrain, agent)
            start, start_cpu = time.perf_counter(), time.thread_time()
            cache.want(ahead([agent], grid, LOOKAHEAD))
            cache.work(budget_ms)
            queue.append((time.perf_counter() - start) * 1e3)
            queue_cpu.append((time.thread_time() - start_cpu) * 1e3)
            due += 1.0 / hz
            rest = due - time.perf_counter()
            late += rest < 0.0
            time.sleep(max(0.0, rest))
            if progress is not None:
                progress((step + 1) / len(path))
    finally:
        sys.setswitchinterval(interval)
    times = np.array(queue)
    return FlightReport(
        steps=len(path),
        stalls=cache.counters.stalls - before[0],
        fallbacks=cache.counters.fallbacks - before[1],
        in_budget=float(np.mean(times <= budget_ms)),
        in_budget_cpu=float(np.mean(np.array(queue_cpu) <= budget_ms)),
        queue_ms=(float(np.median(times)), float(np.quantile(times, 0.99)), float(times.max())),
        late=late,
        passed=len(passed),
        loads=cache.counters.loads,
        evictions=cache.counters.evictions,
        layers=cache.pool.layers,
    )


def _look(terrain: Terrain, agent: Agent) -> None:
    """Ask for heights inside the need radius as a view does, without waiting."""
    grid, need = terrain.grid, agent.need(terrain.grid)
    radius = _VIEW * RADIUS * float(1 << need.level) * grid.spacing
    centre = (grid.x + agent.col * grid.spacing, grid.y + agent.row * grid.spacing)
    sample(terrain, np.array(centre) + radius * _DIRECTIONS, level=need.level, wait=False)


_VIEW = 0.99
"""Asked within this share of the need radius, so that rounding asks for nothing beyond it."""
_ANGLES = np.linspace(0.0, 2.0 * np.pi, 64, endpoint=False)
_DIRECTIONS = np.concatenate(
    [r * np.stack([np.cos(_ANGLES), np.sin(_ANGLES)], axis=1) for r in (0.25, 0.5, 0.75, 1.0)]
)


def _fill(terrain: Terrain, agent: Agent) -> None:
    """The first fill: what the agent needs, and what it will need soon."""
    terrain.cache.require([agent.need(terrain.grid)])
    terrain.cache.want(ahead([agent], terrain.grid, LOOKAHEAD))
    while terrain.cache.pending:
        terrain.cache.work(1e3)
        time.sleep(1e-3)
