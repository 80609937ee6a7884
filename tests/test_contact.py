"""Contact from one triangle to the next: edges, walls, valleys, ridges, holes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.balls.balls import Balls, step, totals
from terrasim.counts import COUNT_M, HOLE, Counts
from terrasim.grid import Grid
from terrasim.query import sample
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

G = 9.81
Table = npt.NDArray[np.float64]


def ground(posts: Counts, spacing: float = 1.0, **options: Any) -> Terrain:
    return Terrain(ArraySource(posts, Grid(posts.shape[0], posts.shape[1], spacing)), **options)


def plane(rows: int, cols: int, per_row: int = 0, per_col: int = 0) -> Counts:
    """A plane that is exact in counts."""
    row, col = np.mgrid[0:rows, 0:cols]
    heights: Counts = (row * per_row + col * per_col).astype(np.int32)
    return heights


def rough(rows: int, cols: int, tall: float = 1.0, seed: int = 0) -> Counts:
    """Independent random heights up to ``tall`` metres."""
    return np.random.default_rng(seed).integers(0, int(tall * 1e5) + 1, (rows, cols), np.int32)


def run(terrain: Terrain, balls: Balls, dt: float, steps: int, gravity: float = G) -> None:
    for _ in range(steps):
        step(terrain, balls, dt, gravity=gravity)


def clearance(terrain: Terrain, balls: Balls) -> Table:
    """Height of the centres above the surface [m]."""
    place = balls.positions(terrain)
    return np.asarray(place[:, 2] - sample(terrain, place[:, :2]).height)


def energy(balls: Balls, gravity: float = G) -> Table:
    """Energy of a kilogram [J]."""
    kinetic = 0.5 * np.square(balls.velocity.numpy()).sum(axis=1)
    return np.asarray(kinetic + gravity * balls.z.numpy())


@pytest.mark.parametrize("rise", [(0, 0), (1_234, -2_345)])
def test_edges_of_a_plane_are_not_felt(rise: tuple[int, int]) -> None:
    """Ten thousand crossings at odd angles change the velocity by gravity along the plane alone."""
    rng = np.random.default_rng(3)
    way = rng.uniform(0.0, 2 * np.pi, 60)
    velocity = np.column_stack([np.cos(way), np.sin(way), np.zeros(60)]) * 30.0
    slope = np.array([rise[1], rise[0]]) * COUNT_M
    velocity[:, 2] = velocity[:, :2] @ slope
    time = 2.0
    with ground(plane(300, 300, *rise)) as terrain:
        place = np.column_stack([rng.uniform(149, 151, (60, 2)), np.zeros(60)])
        balls = Balls.at(
            terrain, place, velocity, radius=0.3, friction=0.0, restitution=0.9, above_ground=True
        )
        run(terrain, balls, 0.01, 200)
        crossed = np.abs(velocity[:, :2] * time)
        assert (2 * crossed.sum() + np.abs(crossed[:, 0] - crossed[:, 1]).sum()) > 10_000
        pull = -G * slope / (1.0 + slope @ slope)
        expected = velocity[:, :2] + pull * time
        np.testing.assert_allclose(balls.velocity.numpy()[:, :2], expected, rtol=0, atol=1e-9)
        assert totals(balls).impacts == totals(balls).projected == 0


@pytest.mark.parametrize(("restitution", "friction"), [(1.0, 0.0), (0.4, 0.3), (0.0, 0.1)])
def test_no_step_ends_below_the_ground_nor_gains_energy(
    restitution: float, friction: float
) -> None:
    """Fast balls among spikes of 80 degrees; at the end they lie wedged between them."""
    posts = rough(120, 120, 5.0)
    rng = np.random.default_rng(4)
    place = np.column_stack([rng.uniform(30, 90, (400, 2)), rng.uniform(0, 5, 400)])
    velocity = rng.normal(0, 1, (400, 3)) * np.exp(rng.uniform(-2, 3, (400, 1)))
    with ground(posts) as terrain:
        balls = Balls.at(
            terrain,
            place,
            velocity,
            radius=np.exp(rng.uniform(-6, 0, 400)),
            restitution=restitution,
            friction=friction,
            above_ground=True,
        )
        highest = energy(balls)
        for _ in range(600):
            step(terrain, balls, 0.01)
            now = energy(balls)
            assert (now <= highest * (1 + 1e-12) + 1e-9).all()
            highest = now
        assert (clearance(terrain, balls) >= 0.0).all()
        offset = balls.offset.numpy()
        assert ((offset >= 0.0) & (offset < 1.0)).all()
    assert totals(balls).impacts > 1500


@pytest.mark.parametrize("restitution", [0.0, 0.6])
@pytest.mark.parametrize("way", [(1, 0), (-1, 0), (0, 1), (0, -1), (1, -1), (-1, 1)])
def test_a_wall_turns_back_a_ball_too_slow_to_climb_it(
    way: tuple[int, int], restitution: float
) -> None:
    """Level ground that meets a slope along an edge or a diagonal: never lifted, never thrown."""
    row, col = np.mgrid[-30:31, -30:31]
    posts = (np.maximum(0, col * way[0] + row * way[1]) * 100_000).astype(np.int32)
    with ground(posts) as terrain:
        balls = Balls.at(
            terrain,
            [[30.21 - 0.4 * way[0], 30.34 - 0.4 * way[1], 0.0]],
            [[0.5 * way[0], 0.5 * way[1], 0.0]],
            radius=0.2,
            restitution=restitution,
            friction=0.01,
            above_ground=True,
        )
        last = energy(balls)
        met = False
        for _ in range(500):
            step(terrain, balls, 0.01)
            assert (energy(balls) <= last + 1e-12).all()
            last = energy(balls)
            met |= totals(balls).impacts > 0
        assert met
        assert totals(balls).projected == 0
        assert balls.z.numpy()[0] == pytest.approx(0.2, abs=1e-12)
        assert np.abs(balls.velocity.numpy()).max() <= 0.5 * restitution


def test_a_thin_ridge_stops_a_fast_ball() -> None:
    """A post 3 m high in its way, at 500 m/s and a step of 20 m."""
    posts = plane(60, 60)
    posts[:, 30] = 300_000
    with ground(posts) as terrain:
        balls = Balls.at(
            terrain,
            [[20.0, 30.3, 1.0]],
            [[500.0, 0.0, 0.0]],
            radius=0.05,
            restitution=0.0,
            friction=0.0,
        )
        step(terrain, balls, 0.04)
        assert totals(balls).impacts == 1
        # What is left goes up the slope of 3: cos^2 and sin cos of its angle.
        np.testing.assert_allclose(balls.velocity.numpy(), [[50.0, 0.0, 150.0]], atol=0.5)


def test_a_ball_in_a_valley_comes_to_rest_at_its_bottom() -> None:
    """Between slopes of 30 degrees it touches both: the middle, up to the ball's radius."""
    posts = (np.abs(np.arange(61) - 30) * 57_735)[None, :].repeat(61, axis=0).astype(np.int32)
    with ground(posts) as terrain:
        balls = Balls.at(
            terrain,
            [[27.2, 30.3, 0.5]],
            radius=0.2,
            restitution=0.5,
            friction=0.1,
            above_ground=True,
        )
        run(terrain, balls, 2e-3, 5000)
        np.testing.assert_allclose(balls.velocity.numpy(), 0.0, atol=1e-9)
        place = balls.positions(terrain)[0]
        # Half the angle between the walls is 60 degrees.
        np.testing.assert_allclose(
            place[[0, 2]], [30.0, 0.2 / math.sin(math.radians(60))], atol=1e-4
        )


@pytest.mark.parametrize("diagonal", [False, True])
@pytest.mark.parametrize("friction", [0.0, 0.1])
def test_a_ball_slides_along_a_valley_on_both_its_sides(diagonal: bool, friction: float) -> None:
    """Gravity along the line, less friction for the two forces that carry it across."""
    row, col = np.mgrid[-30:171, -30:171]
    across, along = (col - row, col + row) if diagonal else (col, row)
    posts = (np.abs(across) * 50_000 - along * 20_000).astype(np.int32)
    line = np.array([1.0, 1.0, -0.4] if diagonal else [0.0, 1.0, -0.2])
    line /= np.linalg.norm(line)
    slopes = [[-0.7, 0.3], [0.3, -0.7]] if diagonal else [[0.5, -0.2], [-0.5, -0.2]]
    sides = np.array([[-x, -y, 1.0] for x, y in slopes])
    sides /= np.linalg.norm(sides, axis=1)[:, None]
    carried = np.array([0.0, 0.0, G]) - G * line[2] * line
    forces = np.linalg.lstsq(sides.T, carried, rcond=None)[0]
    expected = -G * line[2] - friction * forces.sum()
    with ground(posts) as terrain:
        balls = Balls.at(
            terrain, [[30.0, 30.0, 0.0]], radius=0.2, friction=friction, above_ground=True
        )
        run(terrain, balls, 0.01, 300)
        velocity = balls.velocity.numpy()[0]
        np.testing.assert_allclose(velocity, 3.0 * expected * line, rtol=1e-4, atol=1e-4)
        assert totals(balls).held == 0


def test_balls_in_pits_are_at_rest() -> None:
    """Where six planes meet lower than all around: no motion, and no impact is counted there."""
    posts = plane(60, 60)
    posts[3::6, 3::6] = -rough(10, 10) - 20_000
    with ground(posts) as terrain:
        place = [[x + 0.05, y - 0.1, 0.5] for x in range(9, 50, 6) for y in range(9, 50, 6)]
        balls = Balls.at(
            terrain, place, radius=0.2, restitution=0.5, friction=0.05, above_ground=True
        )
        run(terrain, balls, 5e-3, 3000)
        before = totals(balls), balls.z.numpy().copy()
        run(terrain, balls, 5e-3, 50)
        assert not balls.velocity.numpy().any()
        assert totals(balls) == before[0]
        np.testing.assert_allclose(balls.z.numpy(), before[1], rtol=0, atol=1e-12)
        bottom = np.rint(balls.positions(terrain)[:, :2])
        np.testing.assert_array_equal(bottom, np.array(place)[:, :2].round())
        assert totals(balls).held == 0


def test_a_slow_ball_crosses_many_small_cells_in_one_step() -> None:
    """Slower than gravity makes it in half a step, and yet not taken for one in a pit."""
    with ground(plane(200, 200), 0.01) as terrain:
        balls = Balls.at(
            terrain,
            [[0.502, 0.503, 0.0]],
            [[0.35, 0.2, 0.0]],
            radius=0.1,
            friction=0.0,
            above_ground=True,
        )
        run(terrain, balls, 0.2, 10)
        expected = [[1.202, 0.903, 0.1]]
        np.testing.assert_allclose(balls.positions(terrain), expected, rtol=0, atol=1e-12)


def test_a_ball_falls_through_a_hole_and_is_counted() -> None:
    """It is not lifted back when it meets the hole's edge from below."""
    posts = plane(40, 40)
    posts[18:23, 18:23] = HOLE
    with ground(posts) as terrain:
        balls = Balls.at(
            terrain, [[20.3, 20.6, 1.0], [5.0, 5.0, 1.0]], [[3.0, 1.0, 0.0]], radius=0.1
        )
        run(terrain, balls, 0.01, 300)
        tally = balls.tally.numpy()
        assert balls.z.numpy()[0] < -20.0
        assert tally["hole"].tolist()[0] > 290
        assert tally["hole"][1] == 0
        place = balls.positions(terrain)[0]
        assert 17.0 <= place[0] <= 23.0


def test_off_the_terrain_the_edge_goes_on() -> None:
    """Balls that slide over each edge and a corner, at the edge's height, counted."""
    posts = plane(21, 31, 700, 900)
    velocity = [[40.0, 1, 0], [-40.0, 1, 0], [1, 40.0, 0], [1, -40.0, 0], [40.0, 40.0, 0]]
    with ground(posts) as terrain:
        balls = Balls.at(
            terrain,
            [[15.0, 10.0, 2.0]] * 5,
            velocity,
            radius=0.1,
            restitution=0.0,
            friction=1.0,
            above_ground=True,
        )
        run(terrain, balls, 0.01, 800)
        assert not balls.velocity.numpy().any()
        place = balls.positions(terrain)
        inside = np.clip(place[:, :2], [0, 0], [30, 20])
        assert (inside != place[:, :2]).any(axis=1).all()
        expected = (inside @ [900, 700]) * COUNT_M
        slope2 = np.where(inside != place[:, :2], 0.0, np.array([900, 700]) * COUNT_M) ** 2
        rest = expected + 0.1 * np.sqrt(1 + slope2.sum(axis=1))
        np.testing.assert_allclose(place[:, 2], rest, rtol=0, atol=1e-12)
        assert (balls.tally.numpy()["off"] > 100).all()
