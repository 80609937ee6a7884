"""Balls against balls: closed forms, conserved sums, a pile, sleep, bad input."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import pytest
from ball_clouds import DT, brute, cloud, flat, masses, motion, state, weigh

from terrasim.balls.balls import Balls, step
from terrasim.balls.pairs import Meetings, collide
from terrasim.balls.sleep import Awake
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("mass", [(1.0, 1.0), (1.0, 3.0), (1e6, 1e-6)])
def test_two_balls_head_on_leave_as_the_closed_form_says(
    restitution: float, mass: tuple[float, float]
) -> None:
    """``v1 = (m1 u1 + m2 u2 + m2 e (u2 - u1)) / (m1 + m2)``, up to the last bits."""
    (m1, m2), (u1, u2) = mass, (3.0, -2.0)
    with flat() as terrain:
        balls = Balls.at(
            terrain,
            [[9.95, 9.0, 5.0], [10.2, 9.0, 5.0]],
            [[u1, 0.0, 0.0], [u2, 0.0, 0.0]],
            radius=0.125,
        )
        weigh(balls, mass)
        met = collide(terrain, balls, DT, restitution=restitution)
        speed = balls.velocity.numpy()
    both, bounce = m1 * u1 + m2 * u2, restitution * (u2 - u1)
    expected = [(both + m2 * bounce) / (m1 + m2), (both - m1 * bounce) / (m1 + m2)]
    np.testing.assert_allclose(speed[:, 0], expected, rtol=0, atol=4e-15)
    assert not speed[:, 1:].any()
    assert (met.touching, met.struck, met.pushed) == (1, 1, 0)


def test_the_cube_of_the_radius_stands_in_for_a_mass() -> None:
    """A ball of twice the radius counts eight times."""
    with flat() as terrain:
        balls = Balls.at(
            terrain,
            [[9.0, 9.0, 5.0], [9.75, 9.0, 5.0]],
            [[1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
            radius=[0.25, 0.5],
        )
        collide(terrain, balls, DT, restitution=0.0)
        np.testing.assert_allclose(balls.velocity.numpy()[:, 0], 1.0 / 9.0, rtol=1e-15)


@pytest.mark.parametrize("moving", [1, 2, 3])
def test_as_many_balls_leave_a_cradle_as_strike_it(moving: int) -> None:
    """Five equal balls that touch: exact, as each impact swaps two velocities."""
    speed = np.zeros((5, 3))
    speed[:moving, 0] = 1.0
    with flat() as terrain:
        places = [[9.0 + 0.25 * i, 9.0, 5.0] for i in range(5)]
        balls = Balls.at(terrain, places, speed, radius=0.125)
        met = collide(terrain, balls, DT, restitution=1.0)
        assert balls.velocity.numpy().tolist() == speed[::-1].tolist()
    assert (met.touching, met.struck) == (4, 1)


def test_friction_between_balls_is_coulombs_up_to_sticking() -> None:
    """Across the line of centres: friction times the push, or what stops the slip."""
    for friction, slip in ((0.0, 4.0), (0.1, 4.0 - 2 * 0.1), (5.0, 0.0)):
        with flat() as terrain:
            balls = Balls.at(
                terrain,
                [[9.0, 9.0, 5.0], [9.25, 9.0, 5.0]],
                [[2.0, 4.0, 0.0], [0.0, 0.0, 0.0]],
                radius=0.125,
            )
            collide(terrain, balls, DT, restitution=0.0, friction=friction)
            speed = balls.velocity.numpy()
        assert speed[0, 1] - speed[1, 1] == pytest.approx(slip, abs=1e-15)
        assert speed[:, 0].tolist() == [1.0, 1.0]


def test_balls_that_part_or_keep_apart_are_left_alone() -> None:
    with flat() as terrain:
        balls = Balls.at(
            terrain,
            [[9.0, 9.0, 5.0], [9.25, 9.0, 5.0], [20.0, 9.0, 5.0], [20.26, 9.0, 5.0]],
            [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
            radius=0.125,
        )
        before = state(balls)
        met = collide(terrain, balls, DT)
        assert met == Meetings(touching=1)
        assert all((a == b).all() for a, b in zip(state(balls), before, strict=True))


def test_a_thousand_collisions_keep_momentum_and_lose_energy() -> None:
    """Also with masses from 1 g to 1 t; the momentum is off by rounding of each velocity."""
    with flat() as terrain:
        for seed in range(4):
            balls = cloud(terrain, 1500 + seed, 3.0, (0.05, 0.2))
            if seed % 2:
                weigh(balls, 10.0 ** np.random.default_rng(seed).uniform(-3, 3, balls.count))
            mass, energy = masses(balls)[:, None], motion(balls).sum()
            start = (mass * balls.velocity.numpy()).sum(axis=0)
            scale = np.abs(mass * balls.velocity.numpy()).sum()
            met = collide(terrain, balls, DT, restitution=(0.0, 0.3, 0.9, 1.0)[seed])
            assert met.struck > 1000
            end = (mass * balls.velocity.numpy()).sum(axis=0)
            np.testing.assert_allclose(end, start, rtol=0, atol=1e-15 * scale)
            assert motion(balls).sum() <= energy


@pytest.mark.parametrize("restitution", [0.0, 0.5, 1.0])
def test_energy_never_grows_in_a_gas(restitution: float) -> None:
    """In any collision of many, with every restitution; without gravity nothing else adds any."""
    with flat() as terrain:
        balls = cloud(terrain, 600, 2.0, (0.05, 0.15))
        energy = [motion(balls).sum()]
        for _ in range(60):
            step(terrain, balls, 5e-3, gravity=0.0)
            collide(terrain, balls, 5e-3, restitution=restitution, friction=0.3, gravity=0.0)
            energy.append(motion(balls).sum())
        assert (np.diff(energy) <= 1e-12 * energy[0]).all()
        assert energy[-1] < energy[0]


def test_an_overlap_is_shared_as_the_masses_ask() -> None:
    """The centre of mass stays; the speeds stay; places go on into the next cell."""
    with flat() as terrain:
        balls = Balls.at(terrain, [[9.9, 9, 5], [10.05, 9, 5]], radius=0.125)
        weigh(balls, [1.0, 4.0])
        met = collide(terrain, balls, DT)
        place = balls.positions(terrain)
        assert met.pushed == 1
        assert met.deepest == pytest.approx(0.1)
        assert met.left < 1e-12
        np.testing.assert_allclose(place[:, 0], [9.82, 10.07], rtol=0, atol=1e-14)
        assert balls.offset.numpy().min() >= 0.0
        balls = Balls.at(terrain, [[9.98, 9, 5], [9.79, 9, 5]], radius=0.125)
        collide(terrain, balls, DT)
        assert balls.cell.numpy()[:, 1].tolist() == [10, 9]
        assert balls.offset.numpy()[0, 0] == pytest.approx(0.01)
        assert not balls.velocity.numpy().any()


def test_balls_on_one_spot_part_by_number() -> None:
    with flat() as terrain:
        balls = Balls.at(terrain, [[9, 9, 5], [9, 9, 5]], radius=0.125)
        collide(terrain, balls, DT)
        assert balls.z.numpy().tolist() == [4.875, 5.125]


def pit(rows: int = 40) -> Terrain:
    """A pyramid turned upside down, sides of 1 in 2."""
    row, col = np.mgrid[0:rows, 0:rows]
    height = 50_000 * np.maximum(np.abs(row - rows // 2), np.abs(col - rows // 2))
    return Terrain(ArraySource(height.astype(np.int32), Grid(rows, rows, 1.0)))


def test_a_pile_in_a_pit_settles_with_little_overlap() -> None:
    """200 balls of 0.15 to 0.25 m, 4 s: no pair is left overlapping by more than ``12 g dt^2``.

    That is 3 mm. Half of them are no faster than gravity makes a ball in three steps.
    """
    rng = np.random.default_rng(2)
    place = np.column_stack([rng.uniform(18.5, 21.5, (200, 2)), rng.uniform(2.0, 8.0, 200)])
    dt, worst = 5e-3, 0.0
    with pit() as terrain:
        balls = Balls.at(terrain, place, radius=rng.uniform(0.15, 0.25, 200))
        for number in range(800):
            step(terrain, balls, dt)
            met = collide(terrain, balls, dt)
            assert met.crowded == 0
            worst = max(worst, met.left if number >= 600 else 0.0)
        speed = np.linalg.norm(balls.velocity.numpy(), axis=1)
        left = brute(terrain, balls, -2 * 12 * 9.81 * dt**2 / 0.3)
    assert worst < 12 * 9.81 * dt**2
    assert len(left) == 0
    assert met.touching > 250
    assert np.median(speed) < 3 * 9.81 * dt
    assert speed.max() < 1.0


def test_balls_too_fast_to_be_sure_of_are_counted() -> None:
    with flat() as terrain:
        balls = Balls.at(
            terrain, [[9, 9, 5], [12, 9, 5]], [[200.0, 0.0, 0.0], [50.0, 0.0, 0.0]], radius=0.125
        )
        assert collide(terrain, balls, DT).fast == 1
        assert collide(terrain, balls.copy(np.arange(0)), DT) == Meetings()


def test_ground_is_required_anew_once_balls_have_met() -> None:
    """A light ball that a heavy one strikes is faster than any was before."""
    with flat() as terrain:
        balls = Balls.at(
            terrain, [[9.0, 9.0, 5.0], [9.25, 9.0, 5.0]], [[9.0, 0.0, 0.0], [0.0] * 3], radius=0.125
        )
        weigh(balls, [1e6, 1.0])
        step(terrain, balls, 1e-9)
        assert balls.reach is not None
        collide(terrain, balls, DT, restitution=1.0)
        assert balls.reach is None


def test_a_sleeping_ball_wakes_when_it_is_struck() -> None:
    """And only that one: the other keeps its bits."""
    with flat() as terrain:
        place = [[9.0, 9.0, 0.0], [20.0, 9.0, 0.0], [11.0, 9.0, 0.0]]
        speed = [[0.0, 0.0, 0.0], [0.0, 0.0, 0.0], [-4.0, 0.0, 0.0]]
        balls = Balls.at(terrain, place, speed, radius=0.125, friction=0.0, above_ground=True)
        balls.awake = Awake()
        slept = 0
        for _ in range(100):
            step(terrain, balls, 0.01)
            slept = max(slept, balls.awake.sleeping)
            collide(terrain, balls, 0.01, restitution=1.0)
        assert slept == 2
        assert balls.awake.asleep is not None
        # What struck it stopped there.
        assert balls.awake.asleep.tolist() == [False, True, True]
        end = balls.positions(terrain)
        assert end[1].tolist() == [20.0, 9.0, 0.125]
        assert end[0, 0] == pytest.approx(7.0, abs=0.26)
        assert balls.velocity.numpy()[:, 0] == pytest.approx([-4.0, 0.0, 0.0])


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"dt": 0.0}, "dt must be above 0 s and finite, got 0.0"),
        ({"restitution": 1.5}, "restitution must be from 0 to 1, got 1.5"),
        ({"restitution": float("nan")}, "restitution must be from 0 to 1, got nan"),
        ({"friction": -1.0}, "friction must be at least 0 and finite, got -1.0"),
        ({"gravity": float("inf")}, "gravity must be at least 0 and finite, got inf"),
        ({"iterations": 0}, "iterations must be at least 1, got 0"),
        ({"neighbours": 0}, "neighbours must be at least 1, got 0"),
        ({"visits": 1}, "visits must be at least 2, got 1"),
    ],
)
def test_numbers_out_of_range_are_refused(options: dict[str, Any], said: str) -> None:
    with flat() as terrain:
        balls = Balls.at(terrain, [[9, 9, 5]], radius=0.125)
        with pytest.raises(InputError, match=said):
            collide(terrain, balls, **{"dt": DT, **options})


def test_what_is_not_asked_for_is_not_imported() -> None:
    code = (
        "import sys, terrasim, terrasim.balls.balls, terrasim.cli\n"
        "parts = ('pairs', 'neighbours', 'ball_grid', 'ball_near')\n"
        "bad = [name for name in sys.modules if 'terrasim' in name and name.endswith(parts)]\n"
        "assert not bad, bad\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
