"""Balls against closed forms: flight, bounces, slides, rest; far places, threads, bad input."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.balls.balls import Balls, step, totals
from terrasim.counts import COUNT_M, Counts
from terrasim.deform.apply import apply
from terrasim.deform.stamps import Gaussian
from terrasim.errors import InputError
from terrasim.grid import Block, Grid
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


def state(balls: Balls) -> bytes:
    """Everything that moves, without the cells."""
    return b"".join(a.numpy().tobytes() for a in (balls.offset, balls.z, balls.velocity))


def clearance(terrain: Terrain, balls: Balls) -> Table:
    """Height of the centres above the surface [m]."""
    place = balls.positions(terrain)
    return np.asarray(place[:, 2] - sample(terrain, place[:, :2]).height)


def energy(balls: Balls, gravity: float = G) -> Table:
    """Energy of a kilogram [J]."""
    kinetic = 0.5 * np.square(balls.velocity.numpy()).sum(axis=1)
    return np.asarray(kinetic + gravity * balls.z.numpy())


def test_free_flight_is_exact_at_any_step() -> None:
    with ground(plane(40, 40)) as terrain:
        for dt, steps in ((0.5, 2), (1e-3, 1000)):
            balls = Balls.at(terrain, [[5.25, 6.5, 100.0]], [[3.0, -2.0, 1.0]], radius=0.1)
            run(terrain, balls, dt, steps)
            expected = [[8.25, 4.5, 100.0 + 1.0 - 0.5 * G]]
            np.testing.assert_allclose(balls.positions(terrain), expected, rtol=0, atol=1e-11)


@pytest.mark.parametrize("restitution", [0.5, 0.8, 0.9])
@pytest.mark.parametrize("dt", [1e-3, 1 / 60])
def test_bounce_heights_fall_by_the_square_of_restitution(restitution: float, dt: float) -> None:
    """Impacts are met at their time within the step, so the step does not matter."""
    with ground(plane(40, 40)) as terrain:
        balls = Balls.at(
            terrain,
            [[20.3, 20.6, 1.0]],
            radius=0.05,
            restitution=restitution,
            friction=0.0,
            above_ground=True,
        )
        for bounce in range(1, 4):
            while totals(balls).impacts < bounce:
                step(terrain, balls, dt)
            apex = energy(balls)[0] / G - 0.05
            assert apex == pytest.approx(restitution ** (2 * bounce), rel=1e-10)


@pytest.mark.parametrize("restitution", [0.5, 0.8, 0.9])
def test_a_bouncing_ball_rests_in_time_and_on_the_ground(restitution: float) -> None:
    """``sqrt(2 h / g) (1 + e) / (1 - e)``; the rule for rest leaves out less than 2 %."""
    dt = 2e-3
    expected = math.sqrt(2.0 / G) * (1 + restitution) / (1 - restitution)
    with ground(plane(40, 40)) as terrain:
        balls = Balls.at(
            terrain, [[20.3, 20.6, 1.0]], radius=0.05, restitution=restitution, above_ground=True
        )
        step(terrain, balls, dt)
        time = dt
        while balls.velocity.numpy().any():
            step(terrain, balls, dt)
            time += dt
        assert time == pytest.approx(expected, rel=0.02)
        assert balls.z.numpy()[0] == 0.05
        before = state(balls)
        run(terrain, balls, dt, 100)
        assert state(balls) == before


def test_elastic_bounces_keep_their_energy_at_altitude() -> None:
    """Restitution 1 at 4,000 m: a hundred bounces."""
    with ground(plane(40, 40) + np.int32(400_000_000)) as terrain:
        balls = Balls.at(
            terrain,
            [[20.3, 20.6, 1.0]],
            [[0.1, 0.0, 0.0]],
            radius=0.05,
            restitution=1.0,
            friction=0.0,
            above_ground=True,
        )
        before = energy(balls)[0] - G * 4000
        while totals(balls).impacts < 100:
            step(terrain, balls, 0.02)
        assert energy(balls)[0] - G * 4000 == pytest.approx(before, rel=1e-8)


@pytest.mark.parametrize("rise", [(0, 17_633), (0, -36_397), (36_397, 0), (41_000, -27_000)])
@pytest.mark.parametrize("friction", [0.0, 0.1])
def test_a_ball_slides_down_an_incline(rise: tuple[int, int], friction: float) -> None:
    """``a = g (sin - mu cos)`` along the steepest way, over cells and diagonals."""
    slope = np.array([rise[1], rise[0], 0.0]) * COUNT_M
    steep = float(np.hypot(slope[0], slope[1]))
    angle = math.atan(steep)
    with ground(plane(200, 200, *rise)) as terrain:
        balls = Balls.at(
            terrain, [[100.2, 100.1, 0.0]], radius=0.1, friction=friction, above_ground=True
        )
        run(terrain, balls, 0.01, 200)
        speed = float(np.linalg.norm(balls.velocity.numpy()))
        down = -balls.velocity.numpy()[0] @ slope / (steep * speed * math.cos(angle))
        assert speed / 2.0 == pytest.approx(
            G * (math.sin(angle) - friction * math.cos(angle)), rel=1e-9
        )
        assert down == pytest.approx(1.0, abs=1e-12)
        moved = balls.positions(terrain)[0] - [100.2, 100.1, 0.0]
        way = math.hypot(moved[0], moved[1]) / math.cos(angle)
        assert way == pytest.approx(speed, rel=1e-9)
        assert totals(balls).impacts == 0


@pytest.mark.parametrize(("friction", "moves"), [(0.30, True), (0.43, False)])
def test_friction_holds_a_ball_if_it_exceeds_the_slope(friction: float, moves: bool) -> None:
    """At a slope of 0.36397, 20 degrees."""
    with ground(plane(60, 60, 0, 36_397)) as terrain:
        balls = Balls.at(
            terrain, [[30.2, 30.1, 0.0]], radius=0.1, friction=friction, above_ground=True
        )
        before = state(balls)
        run(terrain, balls, 0.01, 50)
        assert (state(balls) != before) == moves


@pytest.mark.parametrize("friction", [0.2, 0.4, 0.7])
def test_a_sliding_ball_stops_after_its_distance(friction: float) -> None:
    """``v^2 / (2 mu g)`` on level ground, and it stays there."""
    with ground(plane(40, 40)) as terrain:
        balls = Balls.at(
            terrain,
            [[10.2, 20.6, 0.0]],
            [[1.6, 1.2, 0.0]],
            radius=0.1,
            friction=friction,
            above_ground=True,
        )
        run(terrain, balls, 0.013, 120)
        way = balls.positions(terrain)[0, :2] - [10.2, 20.6]
        expected = 4.0 / (2 * friction * G)
        np.testing.assert_allclose(way, [0.8 * expected, 0.6 * expected], rtol=1e-9)
        assert not balls.velocity.numpy().any()


def test_an_impact_takes_friction_from_its_normal_impulse() -> None:
    """Sideways speed falls by ``mu (1 + e)`` times the normal speed, down to none."""
    with ground(plane(40, 40)) as terrain:
        balls = Balls.at(
            terrain,
            [[10.0, 20.0, 0.5], [10.0, 21.0, 0.5]],
            [[3.0, 4.0, 0.0], [0.3, 0.4, 0.0]],
            radius=0.1,
            restitution=0.5,
            friction=0.2,
            above_ground=True,
        )
        while totals(balls).impacts < 2:
            step(terrain, balls, 1e-3)
        down = math.sqrt(2 * G * 0.5)
        left = 1.0 - 0.2 * 1.5 * down / 5.0
        velocity = balls.velocity.numpy()
        np.testing.assert_allclose(velocity[0, :2], [3.0 * left, 4.0 * left], rtol=1e-12)
        np.testing.assert_array_equal(velocity[1, :2], [0.0, 0.0])


def test_a_flight_with_bounces_does_not_depend_on_the_step() -> None:
    """On an incline, with impacts at odd times: equal to rounding for steps 16 times apart."""
    found = []
    for dt, steps in ((0.032, 50), (0.002, 800)):
        with ground(plane(200, 200, 11_000, -23_000)) as terrain:
            balls = Balls.at(
                terrain,
                [[100.3, 100.7, 2.0]],
                [[2.0, -1.0, 0.0]],
                radius=0.1,
                restitution=0.9,
                friction=0.05,
                above_ground=True,
            )
            run(terrain, balls, dt, steps)
            assert totals(balls).impacts >= 1
            found.append(balls.positions(terrain))
    np.testing.assert_allclose(found[0], found[1], rtol=0, atol=1e-10)


def test_a_turning_slide_converges_at_first_order() -> None:
    """Across a slope, friction turns the way: where the step is approximate."""
    found = []
    for steps in (25, 50, 100, 800):
        with ground(plane(100, 100, 20_000, 0)) as terrain:
            balls = Balls.at(
                terrain,
                [[30.2, 50.1, 0.0]],
                [[3.0, 0.0, 0.0]],
                radius=0.1,
                friction=0.15,
                above_ground=True,
            )
            run(terrain, balls, 1.0 / steps, steps)
            found.append(balls.positions(terrain)[0])
    errors = [float(np.linalg.norm(one - found[-1])) for one in found[:-1]]
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[-1] < 0.01
    assert (orders > 0.85).all()


def placed(rows: int, cols: int, row: int = 0, col: int = 0) -> Grid:
    return Grid(rows, cols, 0.7, row=row, col=col)


def rolled(terrain: Terrain, anchor: tuple[int, int], steps: int = 150) -> Balls:
    """Three hundred balls thrown over the ground around an anchor."""
    rng = np.random.default_rng(7)
    place = np.column_stack([rng.uniform(-20, 20, (300, 2)), rng.uniform(0, 1, 300)])
    balls = Balls.at(
        terrain,
        place,
        rng.uniform(-8, 8, (300, 3)),
        radius=rng.uniform(0.01, 0.4, 300),
        restitution=rng.uniform(0, 1, 300),
        friction=rng.uniform(0, 0.8, 300),
        anchor=anchor,
        above_ground=True,
    )
    run(terrain, balls, 0.01, steps)
    return balls


@pytest.mark.parametrize("shift", [128, 256 * 55_000, -256 * 55_000 + 77])
def test_a_shift_by_whole_cells_changes_no_bit(shift: int) -> None:
    """Within one block or over the corner of four, at the origin or 10,000 km away."""
    posts = rough(100, 100, 0.5)
    found = []
    for corner in ((10, 10), (10 + shift, 10 - shift)):
        grid = placed(100, 100, *corner)
        with Terrain(ArraySource(posts, grid)) as terrain:
            balls = rolled(terrain, (corner[0] + 50, corner[1] + 50))
            cells = balls.cell.numpy() - np.array(corner)
            found.append((state(balls), cells.tobytes(), totals(balls)))
            assert totals(balls).impacts > 300
    assert found[0] == found[1]


def test_threads_and_pools_change_no_bit() -> None:
    posts = rough(700, 700, 0.5)
    found = set()
    for threads, pool in ((1, 64 << 20), (2, 64 << 20), (3, 12 << 18)):
        with ground(posts, threads=threads, pool_bytes=pool) as terrain:
            rng = np.random.default_rng(2)
            place = np.column_stack([rng.uniform(0, 699, (4000, 2)), np.ones(4000)])
            balls = Balls.at(terrain, place, radius=0.1, friction=0.2, above_ground=True)
            run(terrain, balls, 0.01, 80)
            found.add((state(balls), totals(balls)))
            assert totals(balls).coarse == 0
    assert len(found) == 1


@pytest.mark.parametrize("raised", [-1.0, 0.05, 1.0])
def test_ground_edited_under_a_resting_ball_carries_it(raised: float) -> None:
    """It ends at rest on the new ground and is never thrown."""
    with ground(plane(60, 60)) as terrain:
        balls = Balls.at(terrain, [[30.0, 30.0, 0.0]], radius=0.1, above_ground=True)
        run(terrain, balls, 0.01, 10)
        apply(terrain, [Gaussian(30.0, 30.0, raised, 9.0)])
        for _ in range(300):
            step(terrain, balls, 0.01)
            # On its way down a bounce goes up again, but less than it fell.
            assert balls.z.numpy()[0] <= max(0.0, raised) + 0.1 + 1e-3
        assert not balls.velocity.numpy().any()
        np.testing.assert_allclose(clearance(terrain, balls), 0.1, atol=2e-4)
        assert raised < 0 or totals(balls).projected == 1


def test_a_ball_on_a_coarser_level_is_counted_with_its_error() -> None:
    """Balls everywhere need more blocks than the pool holds; what else lies there plays no part."""
    posts = rough(2000, 2000, 0.5)
    with ground(posts, pool_bytes=10 << 18) as terrain:
        rng = np.random.default_rng(0)
        place = np.column_stack([rng.uniform(0, 1999, (500, 2)), np.zeros(500)])
        balls = Balls.at(terrain, place, radius=0.1, above_ground=True)
        step(terrain, balls, 0.01)
        terrain.cache.hold([Block(0, 1, 1), Block(0, 4, 5)])
        run(terrain, balls, 0.01, 2)
        assert terrain.cache.is_resident(Block(0, 1, 1))
        assert totals(balls).coarse == 1500
        assert 10_000 < totals(balls).error <= 50_000 + 1
        assert terrain.cache.counters.coarsened > 0


def test_without_gravity_a_ball_goes_straight_on() -> None:
    with ground(plane(60, 60)) as terrain:
        balls = Balls.at(
            terrain,
            [[10.0, 10.0, 1.0], [10.0, 10.0, 0.0]],
            [[3.0, 2.0, -1.0], [3.0, 2.0, 0.0]],
            radius=0.1,
            restitution=1.0,
            friction=0.0,
            above_ground=True,
        )
        run(terrain, balls, 0.1, 40, gravity=0.0)
        expected = [[22.0, 18.0, 3.1], [22.0, 18.0, 0.1]]
        np.testing.assert_allclose(balls.positions(terrain), expected, rtol=0, atol=1e-12)


def test_no_balls_are_fine() -> None:
    with ground(plane(10, 10)) as terrain:
        balls = Balls.at(terrain, np.zeros((0, 3)), radius=0.1, above_ground=True)
        step(terrain, balls, 0.01)
        assert totals(balls).impacts == 0


def make(**changed: Any) -> Callable[[Terrain], object]:
    options: dict[str, Any] = {"positions": [[1.0, 2.0, 3.0]], "velocities": 0.0, "radius": 0.1}
    options |= changed
    return lambda terrain: Balls.at(terrain, **options)


@pytest.mark.parametrize(
    ("act", "said"),
    [
        (make(positions=[[1.0, math.nan, 0.0]]), r"positions\[0\] must be finite, got .*nan"),
        (make(positions=[[1.0, 2.0]]), r"positions must have shape \(count, 3\), got \(1, 2\)"),
        (make(positions="abc"), "positions must be an array of numbers"),
        (make(velocities=[[0, 0, math.inf]]), r"velocities\[0\] must be finite"),
        (make(velocities=[[0, 0, 0]] * 2), r"velocities must have shape \(1, 3\), got \(2, 3\)"),
        (make(radius=0.0), "radius must be above 0 and finite, got 0.0"),
        (make(radius=-1.0), "radius must be above 0 and finite, got -1.0"),
        (make(radius=math.nan), "radius must be above 0 and finite, got nan"),
        (make(radius=[0.1, 0.2]), "radius must be one number or 1 of them"),
        (make(restitution=1.1), "restitution must be at least 0 and at most 1, got 1.1"),
        (make(friction=-0.1), "friction must be at least 0 and finite, got -0.1"),
        (make(positions=[[1e15, 0, 0]]), "choose a nearer anchor"),
    ],
)
def test_bad_balls_are_refused(act: Callable[[Terrain], object], said: str) -> None:
    with ground(plane(10, 10)) as terrain, pytest.raises(InputError, match=said):
        act(terrain)


@pytest.mark.parametrize(
    ("dt", "gravity", "said"),
    [
        (0.0, G, "dt must be above 0 s and finite, got 0.0"),
        (math.nan, G, "dt must be above 0 s"),
        (0.1, -1.0, "gravity must be at least 0"),
        (0.1, math.inf, "gravity must be at least 0"),
    ],
)
def test_bad_steps_are_refused(dt: float, gravity: float, said: str) -> None:
    with ground(plane(10, 10)) as terrain:
        balls = Balls.at(terrain, [[1.0, 2.0, 3.0]], radius=0.1)
        with pytest.raises(InputError, match=said):
            step(terrain, balls, dt, gravity=gravity)
