"""Balls against balls: closed forms, conserved sums, piles, far places, any order, crowds."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

from terrasim.balls.balls import Balls, step
from terrasim.balls.neighbours import SLACK, near_pairs
from terrasim.balls.pairs import Meetings, collide
from terrasim.balls.sleep import Awake
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.sources.analytic import Flat
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

DT = 1e-3
Table = npt.NDArray[np.float64]


def flat(spacing: float = 1.0, threads: int = 1, *, row: int = 0, col: int = 0) -> Terrain:
    return Terrain(Flat(Grid(40, 40, spacing, row=row, col=col)), threads=threads)


def cloud(
    terrain: Terrain, count: int, side: float, radius: tuple[float, float], **options: Any
) -> Balls:
    """Balls at random places and speeds, high above the ground."""
    rng = np.random.default_rng(count)
    place = rng.uniform(0.0, side, (count, 3)) + np.array([5.0, 5.0, 50.0])
    size = rng.uniform(*radius, count)
    return Balls.at(terrain, place, rng.normal(0.0, 3.0, (count, 3)), radius=size, **options)


def masses(balls: Balls) -> Table:
    mass = getattr(balls, "mass", None)
    return np.asarray(balls.material.numpy()["radius"] ** 3 if mass is None else mass.numpy())


def weigh(balls: Balls, mass: npt.ArrayLike) -> None:
    """Give balls masses, as a scene may."""
    values = np.ascontiguousarray(mass, dtype=np.float64)
    given: Any = balls
    given.mass = wp.array(values, dtype=wp.float64, device=balls.cell.device)


def motion(balls: Balls) -> Table:
    """Kinetic energy of each [J]."""
    return np.asarray(0.5 * masses(balls) * np.square(balls.velocity.numpy()).sum(axis=1))


def state(balls: Balls) -> list[npt.NDArray[Any]]:
    """Everything that moves, without the cells."""
    return [array.numpy().copy() for array in (balls.offset, balls.z, balls.velocity)]


def brute(terrain: Terrain, balls: Balls, slack: float) -> npt.NDArray[np.int64]:
    """All pairs apart by at most a part of the sum of their radii."""
    place, radius = balls.positions(terrain), balls.material.numpy()["radius"]
    away = np.linalg.norm(place[:, None] - place[None], axis=2)
    near = away - (radius[:, None] + radius) <= slack * (radius[:, None] + radius)
    return np.argwhere(np.triu(near, 1))


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


@pytest.mark.parametrize(
    ("spacing", "radius"), [(1.0, (0.05, 0.2)), (0.07, (0.05, 0.2)), (1.0, (0.03, 0.031))]
)
def test_the_grid_finds_the_pairs_that_looking_at_all_finds(
    spacing: float, radius: tuple[float, float]
) -> None:
    """Balls smaller and larger than cells, across cells with negative numbers."""
    with flat(spacing, row=-20, col=-20) as terrain:
        balls = cloud(terrain, 1200, 1.5, radius, anchor=(-5, -5))
        pairs = near_pairs(terrain, balls, neighbours=128)
        expected = brute(terrain, balls, SLACK)
        assert len(expected) > 20
        np.testing.assert_array_equal(pairs, expected)
        touching = len(brute(terrain, balls, 0.0))
        met = collide(terrain, balls, DT, neighbours=128)
        assert (met.touching, met.pushed, met.crowded) == (touching, touching, 0)


def ended(terrain: Terrain, order: npt.NDArray[np.int64], anchor: tuple[int, int]) -> list[Any]:
    """Where colliding balls get to that were given in an order; by their first numbers."""
    balls = cloud(terrain, 4000, 3.0, (0.05, 0.15), anchor=anchor).copy(order)
    for _ in range(5):
        step(terrain, balls, DT, gravity=9.81)
        collide(terrain, balls, DT, restitution=0.7)
    back = np.argsort(order)
    return [array[back] for array in [*state(balls), balls.cell.numpy() - np.array(anchor)]]


def test_threads_far_places_and_the_order_of_balls_change_no_bit() -> None:
    """1, 2 and 3 threads, 10^9 cells away, and balls numbered in another order."""
    count = 4000
    same, other = np.arange(count), np.random.default_rng(1).permutation(count)
    far = 10**9
    with flat() as terrain:
        expected = ended(terrain, same, (0, 0))
        shuffled = ended(terrain, other, (0, 0))
    for found in (shuffled, *(_far(threads, far, same) for threads in (1, 2, 3))):
        for a, b in zip(found, expected, strict=True):
            assert np.array_equal(a, b)


def _far(threads: int, far: int, order: npt.NDArray[np.int64]) -> list[Any]:
    with flat(threads=threads, row=-far, col=far) as terrain:
        return ended(terrain, order, (-far, far))


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


def test_a_crowd_in_one_cell_is_counted_and_keeps_its_momentum() -> None:
    """Each ball sees few of the others, but those see it."""
    with flat() as terrain:
        balls = cloud(terrain, 3000, 0.2, (0.05, 0.06))
        mass, energy = masses(balls)[:, None], motion(balls).sum()
        start = (mass * balls.velocity.numpy()).sum(axis=0)
        met = collide(terrain, balls, DT, restitution=1.0, neighbours=8, visits=32)
        assert met.crowded == 3000
        assert met.struck > 1000
        end = (mass * balls.velocity.numpy()).sum(axis=0)
        np.testing.assert_allclose(end, start, rtol=0, atol=1e-14 * np.abs(mass).sum())
        assert motion(balls).sum() <= energy


def test_a_bad_ball_harms_no_other() -> None:
    """NaN touches nothing; a ball without neighbours keeps every bit."""
    with flat() as terrain:
        balls = Balls.at(terrain, [[9.0, 9.0, 5.0], [9.0, 9.0, 5.1], [9.3, 9.0, 5.0]], radius=0.125)
        velocity, z = balls.velocity.numpy(), balls.z.numpy()
        z[1], velocity[1] = np.nan, np.nan
        balls.z = wp.array(z, dtype=wp.float64, device=terrain.device)
        balls.velocity = wp.array(velocity, dtype=wp.vec3d, device=terrain.device)
        assert collide(terrain, balls, DT).touching == 0
        assert balls.z.numpy()[[0, 2]].tolist() == [5.0, 5.0]
        assert not balls.velocity.numpy()[[0, 2]].any()


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
