"""Balls that rest sleep until their ground changes: the same bits as without, at no cost."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from terrasim.balls.balls import Balls, step
from terrasim.balls.moving import moving
from terrasim.balls.sleep import LOOK_EVERY, Awake, rejoin, settle, wake
from terrasim.counts import Counts
from terrasim.deform.apply import apply_stamps
from terrasim.deform.patch import Patch, apply_patch
from terrasim.deform.relaxation import Rect, relax
from terrasim.deform.stamps import ConeStamp, Gaussian
from terrasim.grid import Grid
from terrasim.launch import launch
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

SIDE = 600
DT = 0.01


def ground(factor: int = 1, **options: Any) -> Terrain:
    """Gently rough ground of nine blocks."""
    posts: Counts = np.random.default_rng(3).integers(0, 20_000, (SIDE, SIDE), np.int32)
    return Terrain(ArraySource(posts, Grid(SIDE, SIDE, 1.0)), detail_factor=factor, **options)


def scattered(terrain: Terrain, sleeps: bool = True, count: int = 400, **more: Any) -> Balls:
    """Balls that come to rest soon."""
    rng = np.random.default_rng(4)
    places = rng.uniform(20.0, 580.0, (count, 3))
    places[:, 2] = 0.1
    radius = rng.uniform(0.05, 0.4, count)
    options: Any = {"restitution": 0.3, "friction": 0.9, "above_ground": True} | more
    balls = Balls.at(terrain, places, radius=radius, **options)
    if sleeps:
        balls.awake = Awake()
    return balls


def run(terrain: Terrain, balls: Balls, steps: int) -> None:
    for _ in range(steps):
        step(terrain, balls, DT)


def sleeping(balls: Balls) -> int:
    assert balls.awake is not None
    return balls.awake.sleeping


def bits(balls: Balls) -> list[bytes]:
    """All of their state."""
    settle(balls)
    arrays = [balls.cell, balls.offset, balls.z, balls.velocity, balls.tally]
    return [array.numpy().tobytes() for array in arrays]


def stamp(terrain: Terrain) -> None:
    apply_stamps(terrain, [Gaussian(300.0, 200.0, amplitude=-1.0, sigma=20.0)])


def fine(terrain: Terrain) -> None:
    apply_stamps(terrain, [Gaussian(300.0, 200.0, amplitude=0.5, sigma=5.0, detail=True)])


def heap(terrain: Terrain) -> None:
    apply_stamps(terrain, [ConeStamp(300.0, 200.0, 20.0, 25.0)])
    relax(terrain, [Rect(150, 250, 250, 350)], angle_deg=30.0, iterations=30)


CHANGES: list[Callable[[Terrain], None]] = [stamp, fine, heap]


@pytest.mark.parametrize("change", CHANGES)
@pytest.mark.parametrize("moves", [False, True])
@pytest.mark.parametrize("sort_every", [0, 50])
def test_sleep_changes_no_bit(
    change: Callable[[Terrain], None], moves: bool, sort_every: int
) -> None:
    """Rest, an edit under some, at once or as ground that moves, and rest again."""
    ends = []
    for sleeps in (False, True):
        with ground(factor=2) as terrain:
            balls = scattered(terrain, sleeps=False)
            if sleeps:
                balls.awake = Awake(sort_every=sort_every)
            run(terrain, balls, 400)
            if sleeps:
                assert sleeping(balls) > 380
            if moves:
                with moving(terrain, balls):
                    change(terrain)
            else:
                change(terrain)
            run(terrain, balls, 1)
            if sleeps:
                assert 20 < balls.count - sleeping(balls) < 390
            run(terrain, balls, 400)
            ends.append(bits(balls))
    assert ends[0] == ends[1]


def test_a_look_at_the_balls_does_not_keep_them_awake() -> None:
    with ground() as terrain:
        balls = scattered(terrain)
        for _ in range(200):
            step(terrain, balls, DT)
            balls.positions(terrain)
        assert sleeping(balls) > 380


def test_nothing_is_launched_and_no_ground_required_for_balls_that_sleep(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """One that flies on pays for itself alone; without it a step does nothing at all."""
    counts: list[int] = []

    def counted(kernel: Any, count: int, **more: Any) -> None:
        counts.append(count)
        launch(kernel, count, **more)

    with ground() as terrain:
        balls = scattered(terrain, friction=2.0)
        run(terrain, balls, 600)
        assert sleeping(balls) == balls.count
        monkeypatch.setattr("terrasim.balls.balls.launch", counted)
        run(terrain, balls, 1)
        assert counts == [0]
        rejoin(balls)
        z = balls.z.numpy()
        z[7] += 50.0
        balls.z.assign(z)
        wake(balls, [7])
        counts.clear()
        run(terrain, balls, 3)
        assert counts == [1, 1, 1]
        assert terrain.cache.residents != []
        required = [key for key in terrain.cache._requirement if key.level == 0]
        assert len(required) <= 4


def test_a_ball_that_flies_or_slides_or_hangs_for_a_moment_stays_awake() -> None:
    """At the top of its flight it is still for a moment; on a slope it starts slowly."""
    _, col = np.mgrid[0:64, 0:64]
    slope: Counts = (col * 10_100).astype(np.int32)
    with Terrain(ArraySource(slope, Grid(64, 64, 1.0))) as terrain:
        # Exact in binary: at the second look its speed is 0 to the bit.
        dt, gravity = 1.0 / 128.0, 8.0
        balls = Balls.at(
            terrain,
            [[20.3, 20.6, 30.0], [40.3, 20.6, 0.0]],
            [[0.0, 0.0, 2 * LOOK_EVERY * gravity * dt], [0.0, 0.0, 0.0]],
            radius=0.1,
            friction=0.1,
            above_ground=True,
        )
        balls.awake = Awake()
        hung = False
        for _ in range(5 * LOOK_EVERY):
            step(terrain, balls, dt, gravity=gravity)
            hung |= not balls.velocity.numpy()[0].any()
            assert sleeping(balls) == 0
        assert hung
        assert balls.velocity.numpy().any(axis=1).all()


def test_only_balls_that_reach_a_block_that_changed_wake() -> None:
    """One far off sleeps on; one whose radius reaches over the block's edge wakes."""
    posts: Counts = np.zeros((SIDE, SIDE), np.int32)
    with Terrain(ArraySource(posts, Grid(SIDE, SIDE, 1.0))) as terrain:
        places = [[100.5, 100.5, 0.0], [255.2, 100.5, 0.0], [254.5, 100.5, 0.0], [300.5, 400.5, 0]]
        radius = [0.5, 0.5, 3.0, 0.5]
        balls = Balls.at(terrain, places, radius=radius, above_ground=True)
        balls.awake = Awake()
        run(terrain, balls, 50)
        assert sleeping(balls) == 4
        apply_patch(terrain, Patch(100, 400, np.full((2, 2), 7, np.int32)))
        run(terrain, balls, 1)
        assert balls.awake.asleep is not None
        assert balls.awake.asleep.tolist() == [True, False, False, True]


def test_on_another_terrain_all_wake() -> None:
    with ground() as terrain:
        balls = scattered(terrain)
        run(terrain, balls, 200)
        assert sleeping(balls) > 380
    with ground() as terrain:
        run(terrain, balls, 1)
        assert sleeping(balls) == 0


def test_without_sleep_or_order_there_is_nothing_of_it() -> None:
    """No memory, nobody watches the ground, and the step launches all balls as they are."""
    with ground() as terrain:
        balls = scattered(terrain, sleeps=False)
        run(terrain, balls, 20)
        assert balls.awake is None
        assert len(terrain.cache.watches) == 0


def test_balls_beyond_the_edge_stay_awake() -> None:
    with ground() as terrain:
        balls = Balls.at(terrain, [[-50.0, 30.0, 0.0]], radius=0.1, friction=2.0, above_ground=True)
        balls.awake = Awake()
        run(terrain, balls, 100)
        assert not balls.velocity.numpy().any()
        assert sleeping(balls) == 0
