"""A step of many balls: against a serial numba loop, by their number, asleep, over threads."""

from __future__ import annotations

from functools import partial

import numpy as np
import warp as wp

from terrasim.balls.balls import Balls, step
from terrasim.balls.sleep import Awake
from terrasim.bench.bench import Row, numba_missing
from terrasim.bench.timing import cpu_seconds, median_ratio, wall_seconds
from terrasim.grid import Grid
from terrasim.sources.analytic import Flat, Sine
from terrasim.terrain import Terrain

COUNT = 1_000_000
COUNTS = (10_000, 100_000, 1_000_000, 10_000_000)
"""Balls in the rows that say whether the cost of one grows with their number."""
GRAVITY = 9.81
DT = 1.0 / 240.0
STEPS_BEFORE = 120
"""Steps in which balls let go near the ground come to roll."""
STEPS_TO_REST = 600
"""Steps after which balls let go near level ground have come to rest."""


def measure(device: str) -> list[Row]:
    """Time steps of balls over 1,024^2 posts of a sine."""
    rows: list[Row] = []
    source = Sine(Grid(1025, 1025, 1.0), amplitude=20.0, wavelength=256.0)
    for what, above in (("in flight", 500.0), ("on the ground", 0.05)):
        with Terrain(source, device=device) as terrain:
            balls = _spread(terrain, above)
            _steps(terrain, balls, STEPS_BEFORE if above < 1.0 else 2)
            rows += _timed(terrain, balls, f"ball step, {what}")
            if not terrain.device.is_cuda and not numba_missing():
                rows.append(_against_numba(terrain, balls, f"ball step, {what}"))
    return [*rows, *_by_count(source, device), _asleep(device)]


def _steps(terrain: Terrain, balls: Balls, count: int) -> None:
    for _ in range(count):
        step(terrain, balls, DT)


def _spread(terrain: Terrain, above: float, count: int = COUNT) -> Balls:
    rng = np.random.default_rng(9)
    place = np.column_stack([rng.uniform(20.0, 1000.0, (count, 2)), np.full(count, above)])
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


def _against_numba(terrain: Terrain, balls: Balls, name: str) -> Row:
    """The same steps as a serial loop, which must end at the same places."""
    from terrasim.bench.numba_balls import balls_loop

    loop, lattice = balls_loop(), terrain.lattice
    place = (lattice.spacing, lattice.row, lattice.col, lattice.last_row, lattice.last_col)
    given = balls.material.numpy()
    material = np.column_stack([given[one] for one in ("radius", "restitution", "friction")])
    state = [one.numpy().copy() for one in (balls.cell, balls.offset, balls.z, balls.velocity)]
    tally = np.zeros((balls.count, 3), dtype=np.int64)
    pool, table = terrain.pool.numpy(), terrain.required.numpy()

    def theirs() -> None:
        loop(pool, table, place, DT, GRAVITY, material, *state, tally)

    def ours() -> None:
        step(terrain, balls, DT, gravity=GRAVITY, require=False)

    taken, other = cpu_seconds([ours, theirs], 9)
    if np.abs(balls.z.numpy() - state[2]).max() > 1e-9:
        raise RuntimeError("the numba loop and step disagree")
    return Row(
        f"{name}, against numba",
        float(np.median(other)) / balls.count * 1e9,
        "ns a ball (numba)",
        "a serial numba loop (ours over its)",
        median_ratio(taken, other),
    )


def _by_count(source: Sine, device: str) -> list[Row]:
    """Cost of a ball on the ground, by how many there are."""
    rows: list[Row] = []
    first: list[float] = []
    for count in COUNTS:
        with Terrain(source, device=device) as terrain:
            balls = _spread(terrain, 0.05, count)
            _steps(terrain, balls, 20)
            clock = wall_seconds if terrain.device.is_cuda else cpu_seconds
            [taken] = clock([partial(_one, terrain, balls)], 5)
        each = [one / count for one in taken]
        first = first or each
        rows.append(
            Row(
                f"ball step, {count} balls",
                float(np.median(each)) * 1e9,
                "ns a ball",
                f"{COUNTS[0]} balls",
                float(np.median(each) / np.median(first)),
            )
        )
    return rows


def _one(terrain: Terrain, balls: Balls) -> None:
    step(terrain, balls, DT, require=False)
    wp.synchronize_device(terrain.device)


def _asleep(device: str) -> Row:
    """Balls that came to rest, asleep and not."""
    source, count = Flat(Grid(1025, 1025, 1.0)), COUNT // 10
    with Terrain(source, device=device) as terrain:
        awake, asleep = _spread(terrain, 0.05, count), _spread(terrain, 0.05, count)
        asleep.awake = Awake()
        for balls in (awake, asleep):
            _steps(terrain, balls, STEPS_TO_REST)
        clock = wall_seconds if terrain.device.is_cuda else cpu_seconds
        moving, sleeping = clock(
            [lambda: _steps(terrain, awake, 16), lambda: _steps(terrain, asleep, 16)], 5
        )
        resting = asleep.awake.sleeping
    return Row(
        f"ball step, {resting} of {count} asleep",
        float(np.median(sleeping)) / count / 16 * 1e9,
        "ns a ball",
        "the same balls awake",
        median_ratio(sleeping, moving),
    )
