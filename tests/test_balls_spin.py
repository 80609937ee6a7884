"""Spinning balls on terrain: rolling and sliding on planes, edges, impacts, bad input."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

from terrasim.balls.ball_bytes import SPIN_BYTES
from terrasim.balls.balls import Balls, step, totals
from terrasim.balls.moving import moving
from terrasim.counts import COUNT_M, Counts
from terrasim.deform.patch import Patch, apply_patch
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.kernels.balls import step_balls
from terrasim.kernels.balls_detail import step_balls_on_detail
from terrasim.kernels.balls_spin import step_spinning_balls
from terrasim.sources.analytic import Flat, Plane
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

G = 9.81
R = 0.1
DT = 0.01
Table = npt.NDArray[np.float64]


def incline(degrees: float, posts: int = 256) -> Terrain:
    """A plane that falls along x."""
    slope = -math.tan(math.radians(degrees))
    return Terrain(Plane(Grid(posts, posts, 1.0), height=0.0, slope_x=slope))


def run(terrain: Terrain, balls: Balls, steps: int, dt: float = DT, gravity: float = G) -> None:
    for _ in range(steps):
        step(terrain, balls, dt, gravity=gravity)


def energy(balls: Balls, gravity: float = G) -> Table:
    """Energy of a kilogram, with that of its spin [J]."""
    radius = balls.material.numpy()["radius"]
    moving = 0.5 * np.square(balls.velocity.numpy()).sum(axis=1)
    turning = 0.2 * radius**2 * np.square(balls.spin.numpy()).sum(axis=1)
    return np.asarray(moving + turning + gravity * balls.z.numpy())


def generated(kernel: Any, folder: Path) -> str:
    """The CUDA code of a kernel's module, without comments: they name folders."""
    place = folder / kernel.key
    wp.compile_aot_module(kernel.module, arch=[80], module_dir=place, use_ptx=False)
    (file,) = place.glob("*.cu")
    return "\n".join(line.split("//")[0] for line in file.read_text().splitlines())


@pytest.mark.parametrize(
    ("degrees", "friction", "expected"),
    [(10, 0.06, 1.2168), (20, 0.3, 2.3966), (30, 0.3, 3.5036), (45, 0.3, 4.9548)],
)
def test_a_ball_rolls_down_an_incline(degrees: float, friction: float, expected: float) -> None:
    """Five sevenths of gravity along it; heights are whole counts, so to a part in ten thousand."""
    with incline(degrees) as terrain:
        balls = Balls.at(
            terrain,
            [[100.3, 100.6, 0.0]],
            radius=R,
            friction=friction,
            restitution=0.0,
            spin=0.0,
            above_ground=True,
        )
        run(terrain, balls, 300)
        v, w = balls.velocity.numpy()[0], balls.spin.numpy()[0]
        assert np.hypot(v[0], v[2]) / 3.0 == pytest.approx(expected, rel=5e-3)
        assert np.hypot(v[0], v[2]) / 3.0 == pytest.approx(expected, rel=2e-4)
        np.testing.assert_allclose(w, [0.0, np.hypot(v[0], v[2]) / R, 0.0], atol=0.02)


@pytest.mark.parametrize(("degrees", "expected"), [(20, 2.4334), (30, 4.0554), (45, 6.2430)])
def test_a_ball_slides_down_an_incline_too_steep_to_roll(degrees: float, expected: float) -> None:
    """It turns as fast as friction of 0.1 can make it: 5 mu g cos / (2 R)."""
    with incline(degrees) as terrain:
        balls = Balls.at(
            terrain,
            [[100.3, 100.6, 0.0]],
            radius=R,
            friction=0.1,
            restitution=0.0,
            spin=0.0,
            above_ground=True,
        )
        run(terrain, balls, 300)
        v, w = balls.velocity.numpy()[0], balls.spin.numpy()[0]
        assert np.hypot(v[0], v[2]) / 3.0 == pytest.approx(expected, rel=5e-4)
        turned = 5.0 * 0.1 * G * math.cos(math.radians(degrees)) / (2.0 * R)
        assert w[1] / 3.0 == pytest.approx(turned, rel=5e-3)


@pytest.mark.parametrize("dt", [1e-3, 0.01, 0.1])
@pytest.mark.parametrize(("friction", "t", "s"), [(0.2, 0.2912, 0.4993), (0.4, 0.1456, 0.2496)])
def test_on_level_ground_a_ball_slides_then_rolls(
    friction: float, t: float, s: float, dt: float
) -> None:
    """When, where and how fast it rolls: from its place long after, v (T - t) + s."""
    with Terrain(Flat(Grid(64, 64, 0.5))) as terrain:
        balls = Balls.at(
            terrain,
            [[10.3, 10.4, 0.0]],
            [[1.6, 1.2, 0.0]],
            radius=R,
            friction=friction,
            spin=[0.0, 0.0, 3.0],
            above_ground=True,
        )
        run(terrain, balls, round(2.0 / dt), dt)
        v, w = balls.velocity.numpy()[0], balls.spin.numpy()[0]
        np.testing.assert_allclose(v, np.array([1.6, 1.2, 0.0]) * 5.0 / 7.0, atol=1e-9)
        np.testing.assert_allclose(w, [-v[1] / R, v[0] / R, 3.0], atol=1e-8)
        way = np.hypot(*(balls.positions(terrain)[0, :2] - [10.3, 10.4]))
        assert way == pytest.approx(10.0 / 7.0 * (2.0 - t) + s, rel=1e-4)


def test_rolling_friction_brings_a_ball_to_rest() -> None:
    """After v^2 / (2 * 5/7 c g); on a slope less steep than c it stays where it stops."""
    with Terrain(Flat(Grid(64, 64, 0.5))) as terrain:
        balls = Balls.at(
            terrain,
            [[10.3, 10.4, 0.0]],
            [[1.5, 0.0, 0.0]],
            radius=R,
            friction=0.5,
            rolling=0.05,
            spin=[0.0, 15.0, 0.0],
            above_ground=True,
        )
        run(terrain, balls, 600)
        way = balls.positions(terrain)[0, 0] - 10.3
        assert way == pytest.approx(1.5**2 / (10.0 / 7.0 * 0.05 * G), rel=1e-9)
        assert not balls.velocity.numpy().any()
        assert not balls.spin.numpy().any()
    for degrees, stays in ((2.8, True), (2.95, False)):
        with incline(degrees) as terrain:
            balls = Balls.at(
                terrain,
                [[100.3, 100.6, 0.0]],
                radius=R,
                rolling=0.05,
                spin=0.0,
                above_ground=True,
            )
            run(terrain, balls, 50)
            assert (not balls.velocity.numpy().any()) == stays


@pytest.mark.parametrize("spins", [False, True])
@pytest.mark.parametrize("rise", [(0, 0), (0, -2_345), (1_234, -2_345)])
def test_edges_of_a_plane_are_not_felt(rise: tuple[int, int], spins: bool) -> None:
    """Ten thousand crossings change the velocity by gravity along the plane alone."""
    rng = np.random.default_rng(3)
    way = rng.uniform(0.0, 2 * np.pi, 60)
    velocity = np.column_stack([np.cos(way), np.sin(way), np.zeros(60)]) * 30.0
    slope = np.array([rise[1], rise[0]]) * COUNT_M
    velocity[:, 2] = velocity[:, :2] @ slope
    row, col = np.mgrid[0:300, 0:300]
    posts: Counts = (row * rise[0] + col * rise[1]).astype(np.int32)
    n = np.array([-slope[0], -slope[1], 1.0])
    n /= np.linalg.norm(n)
    rolls = np.cross(n, velocity) / 0.3
    with Terrain(ArraySource(posts, Grid(300, 300, 1.0))) as terrain:
        place = np.column_stack([rng.uniform(149, 151, (60, 2)), np.zeros(60)])
        balls = Balls.at(
            terrain,
            place,
            velocity,
            radius=0.3,
            friction=0.4 if spins else 0.0,
            restitution=0.9,
            spin=rolls if spins else None,
            above_ground=True,
        )
        run(terrain, balls, 200)
        crossed = np.abs(velocity[:, :2] * 2.0)
        assert (2 * crossed.sum() + np.abs(crossed[:, 0] - crossed[:, 1]).sum()) > 10_000
        pull = -G * slope / (1.0 + slope @ slope) * (5.0 / 7.0 if spins else 1.0)
        expected = velocity[:, :2] + pull * 2.0
        np.testing.assert_allclose(balls.velocity.numpy()[:, :2], expected, rtol=0, atol=1e-9)
        assert totals(balls).impacts == totals(balls).projected == 0


def test_without_detail_the_way_over_a_terrain_that_may_have_some_is_the_same() -> None:
    """To the bit, on any ground; and so are threads."""
    rng = np.random.default_rng(5)
    posts = rng.integers(0, 100_001, (60, 60), np.int32)
    place = np.column_stack([rng.uniform(20, 40, (3000, 2)), rng.uniform(0, 1, 3000)])
    spin = rng.normal(0, 50, (3000, 3))
    ends = []
    for factor, threads in ((1, 1), (3, 1), (1, 2)):
        source = ArraySource(posts, Grid(60, 60, 1.0))
        with Terrain(source, detail_factor=factor, threads=threads) as terrain:
            balls = Balls.at(terrain, place, radius=R, rolling=0.1, spin=spin, above_ground=True)
            run(terrain, balls, 100)
            arrays = (balls.offset, balls.z, balls.velocity, balls.spin)
            ends.append(b"".join(array.numpy().tobytes() for array in arrays))
    assert ends[0] == ends[1] == ends[2]


def test_a_ball_with_back_spin_comes_back() -> None:
    """It bounces, grips and rolls the other way: momentum about the ground decides how fast."""
    with Terrain(Flat(Grid(64, 64, 0.5))) as terrain:
        balls = Balls.at(
            terrain,
            [[15.3, 15.4, 1.0]],
            [[1.0, 0.0, 0.0]],
            radius=R,
            friction=0.3,
            restitution=0.6,
            spin=[0.0, -60.0, 0.0],
        )
        run(terrain, balls, 600)
        v = 5.0 / 7.0 * (1.0 + 0.4 * R * -60.0)
        np.testing.assert_allclose(balls.velocity.numpy(), [[v, 0.0, 0.0]], rtol=0, atol=1e-9)
        assert totals(balls).impacts > 5


@pytest.mark.parametrize("rolling", [0.0, 0.2])
@pytest.mark.parametrize(("restitution", "friction"), [(1.0, 0.0), (0.4, 0.3), (0.0, 3.0)])
def test_energy_never_grows_among_spikes(
    restitution: float, friction: float, rolling: float
) -> None:
    """Fast balls with much spin among spikes of 80 degrees; no centre gets below the ground."""
    rng = np.random.default_rng(4)
    posts = rng.integers(0, 500_001, (120, 120), np.int32)
    place = np.column_stack([rng.uniform(30, 90, (300, 2)), rng.uniform(0, 5, 300)])
    velocity = rng.normal(0, 1, (300, 3)) * np.exp(rng.uniform(-2, 3, (300, 1)))
    radius = np.exp(rng.uniform(-6, 0, 300))
    with Terrain(ArraySource(posts, Grid(120, 120, 1.0))) as terrain:
        balls = Balls.at(
            terrain,
            place,
            velocity,
            radius=radius,
            restitution=restitution,
            friction=friction,
            rolling=rolling,
            spin=rng.normal(0, 5, (300, 3)) / radius[:, None],
            above_ground=True,
        )
        highest = energy(balls)
        for _ in range(300):
            step(terrain, balls, DT)
            now = energy(balls)
            assert (now <= highest * (1 + 1e-12) + 1e-9).all()
            highest = now
        assert np.isfinite(balls.spin.numpy()).all()


def test_a_ball_rolls_along_a_valley_on_a_shorter_arm() -> None:
    """Between slopes of 1/2 that fall by 1/5 along their line."""
    row, col = np.mgrid[-30:171, -30:171]
    posts = (np.abs(col) * 50_000 - row * 20_000).astype(np.int32)
    walls = np.array([[-0.5, 0.2, 1.0], [0.5, 0.2, 1.0]])
    walls /= np.linalg.norm(walls, axis=1)[:, None]
    rise = math.sqrt((1.0 + walls[0] @ walls[1]) / 2.0)
    pull = G * 0.2 / math.hypot(1.0, 0.2)
    with Terrain(ArraySource(posts, Grid(201, 201, 1.0))) as terrain:
        balls = Balls.at(
            terrain, [[30.0, 30.0, 0.0]], radius=0.2, friction=0.5, spin=0.0, above_ground=True
        )
        run(terrain, balls, 300)
        speed = np.linalg.norm(balls.velocity.numpy()[0])
        np.testing.assert_allclose(speed, 3.0 * pull / (1.0 + 0.4 / rise**2), rtol=1e-4)
        turned = np.linalg.norm(balls.spin.numpy()[0])
        np.testing.assert_allclose(turned, speed / (0.2 * rise), rtol=1e-9)
        assert totals(balls).held == 0


def test_ground_that_spin_takes_a_ball_to_is_required() -> None:
    """A ball that stands and turns is fast once it grips: its reach knows."""
    with Terrain(Flat(Grid(2048, 64, 0.1))) as terrain:
        balls = Balls.at(
            terrain,
            [[3.0, 12.0, 0.0]],
            radius=0.5,
            friction=1e9,
            spin=[-400.0, 0, 0],
            above_ground=True,
        )
        run(terrain, balls, 1, 1.0)
        assert totals(balls).coarse == 0
        assert balls.velocity.numpy()[0, 1] == pytest.approx(2.0 / 7.0 * 200.0, rel=1e-9)


def test_rising_ground_carries_a_ball_that_rolls_without_braking_it() -> None:
    """A floor that goes up 1 m in a second under a ball of 1 m/s."""
    with Terrain(ArraySource(np.zeros((64, 64), np.int32), Grid(64, 64, 0.5))) as terrain:
        balls = Balls.at(
            terrain,
            [[10.3, 10.4, 0.0]],
            [[1.0, 0.0, 0.0]],
            radius=R,
            friction=0.5,
            restitution=0.8,
            spin=[0.0, 10.0, 0.0],
            above_ground=True,
        )
        up = Patch(row=0, col=0, counts=np.full((64, 64), 1000, np.int32))
        for _ in range(100):
            with moving(terrain, balls):
                apply_patch(terrain, up)
            step(terrain, balls, DT)
        np.testing.assert_allclose(balls.velocity.numpy(), [[1.0, 0.0, 1.0]], rtol=0, atol=1e-9)
        np.testing.assert_allclose(balls.z.numpy(), 1.0 + R, rtol=0, atol=1e-9)


def test_balls_without_spin_pay_nothing_for_it(tmp_path: Path) -> None:
    """No arrays, and no word of it in the code that is compiled for them."""
    with Terrain(Flat(Grid(64, 64, 0.5))) as terrain:
        balls = Balls.at(terrain, [[3.0, 3.0, 1.0]], radius=0.1)
        assert balls.spin is balls.rolling is None
        assert balls.copy().spin is None
        spinning = Balls.at(terrain, [[3.0, 3.0, 1.0]], radius=0.1, spin=0.0)
        assert spinning.spin.capacity + spinning.rolling.capacity == SPIN_BYTES
    for kernel, spins in (
        (step_balls, False),
        (step_balls_on_detail, False),
        (step_spinning_balls, True),
    ):
        assert ("spin" in generated(kernel, tmp_path)) == spins


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"rolling": 0.1}, "these have none; give spin=0.0"),
        ({"rolling": -0.1, "spin": 0.0}, "rolling must be at least 0 and finite, got -0.1"),
        ({"rolling": math.nan, "spin": 0.0}, "rolling must be at least 0 and finite, got nan"),
        ({"rolling": [0.1, 0.1], "spin": 0.0}, "rolling must be one number or 1 of them"),
        ({"spin": [0.0, math.nan, 0.0]}, r"spin\[0\] must be finite"),
        ({"spin": [0.0, math.inf, 0.0]}, r"spin\[0\] must be finite"),
        ({"spin": [1.0, 2.0]}, r"spin must have shape \(1, 3\)"),
    ],
)
def test_bad_spin_is_refused(options: dict[str, Any], text: str) -> None:
    with Terrain(Flat(Grid(64, 64, 0.5))) as terrain, pytest.raises(InputError, match=text):
        Balls.at(terrain, [[3.0, 3.0, 1.0]], radius=0.1, **options)
