"""Balls in another order: the same bits, each under its own number."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

from terrasim.balls.balls import Balls, reach, step, totals
from terrasim.balls.moving import moving
from terrasim.balls.order import in_order, put_back, take
from terrasim.balls.sleep import Awake, settle
from terrasim.counts import Counts
from terrasim.deform.patch import Patch, apply_patch
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

SIDE = 600
GRID = Grid(SIDE, SIDE, 0.5, row=-300, col=-40)


def ground(**options: Any) -> Terrain:
    """Rough ground of nine blocks, around the block corner (0, 0)."""
    posts: Counts = np.random.default_rng(3).integers(0, 30_000, (SIDE, SIDE), np.int32)
    return Terrain(ArraySource(posts, GRID), **options)


def scattered(terrain: Terrain, count: int = 3000, **more: Any) -> Balls:
    """Balls anywhere, and beyond the edge."""
    rng = np.random.default_rng(4)
    places = rng.uniform(-10.0, 310.0, (count, 3))
    places[:, 2] = rng.uniform(0.0, 0.5, count)
    return Balls.at(
        terrain,
        places,
        rng.normal(0.0, 5.0, (count, 3)),
        radius=rng.uniform(0.02, 0.6, count),
        restitution=rng.uniform(0.0, 0.9, count),
        friction=rng.uniform(0.1, 1.0, count),
        anchor=(GRID.row, GRID.col),
        above_ground=True,
        **more,
    )


def bits(balls: Balls) -> list[bytes]:
    """All of their state."""
    settle(balls)
    arrays = [balls.cell, balls.offset, balls.z, balls.velocity, balls.material, balls.tally]
    return [array.numpy().tobytes() for array in arrays]


@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("every", [1, 7, 1000])
def test_sorting_changes_no_bit_of_any_ball(every: int, threads: int) -> None:
    ends = []
    for awake in (None, Awake(sleeps=False, sort_every=every)):
        with ground(threads=threads) as terrain:
            balls = scattered(terrain)
            balls.awake = awake
            for _ in range(25):
                step(terrain, balls, 0.02)
            ends.append((bits(balls), totals(balls), balls.positions(terrain).tobytes()))
    assert ends[0] == ends[1]


def test_balls_with_spin_are_sorted_with_it() -> None:
    ends = []
    for awake in (None, Awake(sleeps=False, sort_every=3)):
        with ground() as terrain:
            balls = scattered(terrain, 500, spin=[1.0, 2.0, 3.0], rolling=0.05)
            balls.awake = awake
            for _ in range(10):
                step(terrain, balls, 0.02)
            ends.append((bits(balls), balls.spin.numpy().tobytes()))
    assert ends[0] == ends[1]


def test_ground_that_moves_throws_sorted_balls_as_any() -> None:
    ends = []
    for awake in (None, Awake(sleeps=False, sort_every=3)):
        with ground() as terrain:
            balls = scattered(terrain, 500)
            balls.awake = awake
            rise = np.full((200, 200), 1500, np.int32)
            for _ in range(10):
                with moving(terrain, balls):
                    apply_patch(terrain, Patch(-100, 50, rise))
                terrain.cache.require([reach(terrain, balls, 0.02)])
                step(terrain, balls, 0.02, require=False)
            ends.append(bits(balls))
    assert ends[0] == ends[1]


def test_the_order_goes_by_blocks_and_along_mortons_curve_within() -> None:
    with ground() as terrain:
        balls = scattered(terrain)
        number = in_order(terrain, balls).numpy()
        assert sorted(number.tolist()) == list(range(balls.count))
        cell = balls.cell.numpy()[number]
        block = cell >> 8
        runs = 1 + int((np.diff(block, axis=0) != 0).any(axis=1).sum())
        assert runs == len(np.unique(block, axis=0))
        curve = np.zeros(balls.count, np.int64)
        for bit in range(8):
            curve |= ((cell[:, 1].astype(np.int64) >> bit) & 1) << (2 * bit)
            curve |= ((cell[:, 0].astype(np.int64) >> bit) & 1) << (2 * bit + 1)
        same = (np.diff(block, axis=0) == 0).all(axis=1)
        assert (np.diff(curve)[same] >= 0).all()


def test_what_is_taken_out_comes_back_to_its_place_and_nothing_else_changes() -> None:
    with ground() as terrain:
        balls = scattered(terrain, 50)
        before = balls.copy()
        part = take(balls, wp.array([40, 3, 17], dtype=wp.int32))
        step(terrain, part.balls, 0.02)
        put_back(part, balls)
        step(terrain, before, 0.02)
        changed = np.array([40, 3, 17])
        assert bits(balls.copy(changed)) == bits(before.copy(changed))
        untouched = np.setdiff1d(np.arange(50), changed)
        assert bits(balls.copy(untouched)) == bits(scattered(terrain, 50).copy(untouched))


@pytest.mark.parametrize("count", [0, 1, 2])
def test_few_balls_are_sorted_too(count: int) -> None:
    with ground() as terrain:
        balls = scattered(terrain, count)
        balls.awake = Awake(sort_every=1)
        for _ in range(40):
            step(terrain, balls, 0.02)
        assert balls.positions(terrain).shape == (count, 3)


@pytest.mark.parametrize(
    ("wrong", "told"),
    [({"sort_every": -1}, "sort_every must"), ({"still": float("nan")}, "still must")],
)
def test_wrong_numbers_are_refused(wrong: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        Awake(**wrong)
