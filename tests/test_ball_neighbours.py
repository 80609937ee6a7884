"""Which balls are near which: an oracle, any order, far places, threads, crowds."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp
from ball_clouds import DT, brute, cloud, flat, masses, motion, state

from terrasim.balls.balls import Balls, step
from terrasim.balls.neighbours import SLACK, near_pairs
from terrasim.balls.pairs import collide
from terrasim.terrain import Terrain


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


def test_balls_elsewhere_change_no_bit() -> None:
    """Not even on a lattice, where neighbours are equally near, though they change the buckets."""
    side = np.arange(9) * 0.25 + 9.0
    place = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
    speed = np.random.default_rng(3).normal(0.0, 1.0, place.shape)
    more = np.random.default_rng(4).uniform(25.0, 30.0, (3000, 3))
    ends = []
    for others in (more[:0], more):
        with flat() as terrain:
            moving = np.concatenate([speed, others * 0.0])
            balls = Balls.at(terrain, np.concatenate([place, others]), moving, radius=0.125)
            collide(terrain, balls, DT)
            ends.append(balls.velocity.numpy()[: len(place)].copy())
    assert np.array_equal(*ends)


def test_a_crowd_in_one_cell_is_counted_and_keeps_its_momentum() -> None:
    """Each ball sees few of the others, but those see it."""
    with flat(row=-(10**9)) as terrain:
        far = cloud(terrain, 3000, 0.2, (0.05, 0.06), anchor=(-(10**9), 0))
        collide(terrain, far, DT, restitution=1.0, neighbours=8, visits=32)
    with flat() as terrain:
        balls = cloud(terrain, 3000, 0.2, (0.05, 0.06))
        mass, energy = masses(balls)[:, None], motion(balls).sum()
        start = (mass * balls.velocity.numpy()).sum(axis=0)
        met = collide(terrain, balls, DT, restitution=1.0, neighbours=8, visits=32)
        assert met.crowded == 3000
        assert all(np.array_equal(a, b) for a, b in zip(state(balls), state(far), strict=True))
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
