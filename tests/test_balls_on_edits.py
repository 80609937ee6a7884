"""Balls on ground that changes: edits at once have no speed; ground that moves has one."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

from terrasim.balls.balls import Balls, step, totals
from terrasim.balls.moving import moving
from terrasim.counts import COUNT_M, Counts
from terrasim.deform.apply import apply_stamps
from terrasim.deform.dynamics import advance_dynamics
from terrasim.deform.growth import Growth, RunningGrowth
from terrasim.deform.patch import Patch, apply_patch
from terrasim.deform.profiles import Linear
from terrasim.deform.relaxation import Rect, relax
from terrasim.deform.shock import RunningShock, Shock
from terrasim.deform.stamps import ConeStamp, Gaussian
from terrasim.deform.target import target_of
from terrasim.grid import Grid
from terrasim.kernels.rise import Rise
from terrasim.query import sample
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

G = 9.81
DT = 0.01
SIZE = 64
MIDDLE = 32.0
Table = npt.NDArray[np.float64]
CHANGES = pytest.mark.parametrize("rise", [-1.0, 0.05, 0.5, 1.0])
RESTITUTIONS = pytest.mark.parametrize("restitution", [0.0, 0.5, 0.9])


def ground(per_col: int = 0, factor: int = 1) -> Terrain:
    """A plane that is exact in counts."""
    _, col = np.mgrid[0:SIZE, 0:SIZE]
    posts: Counts = (col * per_col).astype(np.int32)
    return Terrain(ArraySource(posts, Grid(SIZE, SIZE, 1.0)), detail_factor=factor)


def lift(terrain: Terrain, rise: float) -> None:
    """Raise all of the ground."""
    apply_patch(terrain, Patch(0, 0, np.full((SIZE, SIZE), round(rise / COUNT_M), np.int32)))


def resting(terrain: Terrain, restitution: float = 0.5, count: int = 200, **more: Any) -> Balls:
    """Balls at rest, most of them where things happen."""
    rng = np.random.default_rng(5)
    places = np.column_stack([rng.normal(MIDDLE, 6.0, (count, 2)).clip(2, 60), np.zeros(count)])
    material: Any = {"radius": rng.uniform(0.02, 0.4, count), "friction": 1.5} | more
    balls = Balls.at(terrain, places, restitution=restitution, above_ground=True, **material)
    for _ in range(3):
        step(terrain, balls, DT)
    assert not balls.velocity.numpy().any()
    return balls


def above_touching(terrain: Terrain, balls: Balls) -> Table:
    """How far above touching the plane under it each ball is [m], by its own triangle."""
    with moving(terrain, balls):
        pass
    assert balls.moved is not None
    clear: Table = balls.moved.rises.numpy()["clear"].copy()
    balls.moved = None
    return clear


def settle(terrain: Terrain, balls: Balls, most: float = np.inf, steps: int = 3000) -> float:
    """Let them come to rest on the surface; the fastest that any went up."""
    fastest = 0.0
    for number in range(steps):
        step(terrain, balls, DT)
        assert number % 10 or above_touching(terrain, balls).min() > -1e-6
        velocity = balls.velocity.numpy()
        fastest = max(fastest, float(velocity[:, 2].max()))
        if not velocity.any():
            break
    assert fastest <= most
    assert not balls.velocity.numpy().any()
    np.testing.assert_allclose(above_touching(terrain, balls), 0.0, rtol=0, atol=1e-3)
    return fastest


def heap(height: float) -> Gaussian:
    return Gaussian(MIDDLE, MIDDLE, amplitude=height, sigma=4.0)


@CHANGES
@RESTITUTIONS
def test_balls_come_to_rest_on_ground_that_a_stamp_moved(rise: float, restitution: float) -> None:
    """Raised they have no speed at all; lowered they fall, and bounce as from any fall."""
    with ground() as terrain:
        balls = resting(terrain, restitution)
        apply_stamps(terrain, [heap(rise)])
        fall = (2.0 * G * max(-rise, 0.0)) ** 0.5
        fastest = settle(terrain, balls, most=restitution * fall + 1e-9)
        assert rise < 0 or fastest == 0.0


@CHANGES
def test_ground_lifted_all_over_leaves_its_balls_where_they_were(rise: float) -> None:
    """The exact answer: every ball higher by the rise, to the rounding of a metre."""
    with ground(per_col=20_000) as terrain:
        balls = resting(terrain)
        before = balls.positions(terrain)
        lift(terrain, rise)
        settle(terrain, balls)
        moved = balls.positions(terrain) - before
        np.testing.assert_allclose(moved[:, 2] - 0.2 * moved[:, 0], rise, rtol=0, atol=1e-9)
        if rise > 0:
            np.testing.assert_allclose(moved[:, :2], 0.0, rtol=0, atol=1e-9)


def slumped(terrain: Terrain, angle_deg: float, rounds: int) -> None:
    """Let it slump a little."""
    relax(terrain, [Rect(0, SIZE, 0, SIZE)], angle_deg=angle_deg, iterations=rounds)


@pytest.mark.parametrize("at_once", [True, False])
def test_balls_come_to_rest_on_ground_that_slumps(at_once: bool) -> None:
    """A tall heap: its top comes down by metres, its foot rises by more than one."""
    with ground() as terrain:
        apply_stamps(terrain, [ConeStamp(MIDDLE, MIDDLE, 6.0, 9.0)])
        places = [[MIDDLE + x, MIDDLE + y, 0.0] for x in range(-9, 10) for y in range(-9, 10)]
        balls = Balls.at(terrain, places, radius=0.1, friction=3.0, above_ground=True)
        settle(terrain, balls)
        before = sample(terrain, balls.positions(terrain)[:, :2]).height
        at = balls.positions(terrain)[:, :2]
        fastest_ground = 0.0
        for angle in np.linspace(56.0, 30.0, 200):
            was = heights(terrain)
            if at_once:
                slumped(terrain, angle, 2)
            else:
                with moving(terrain, balls):
                    slumped(terrain, angle, 2)
                fastest_ground = max(fastest_ground, float((heights(terrain) - was).max()) / DT)
            step(terrain, balls, DT)
            assert above_touching(terrain, balls).min() > -1e-6
            if not at_once:
                assert balls.velocity.numpy()[:, 2].max() <= fastest_ground + 1e-9
        change = sample(terrain, at).height - before
        assert change.min() < -1.0
        assert change.max() > 1.0
        settle(terrain, balls)


def heights(terrain: Terrain) -> Table:
    row, col = np.mgrid[0.0:SIZE, 0.0:SIZE]
    return np.asarray(sample(terrain, np.column_stack([col.ravel(), row.ravel()])).height)


@CHANGES
@RESTITUTIONS
@pytest.mark.parametrize("factor", [1, 4])
def test_balls_come_to_rest_on_a_growing_stamp(
    rise: float, restitution: float, factor: int
) -> None:
    """None goes up faster than the ground itself at its fastest place."""
    with ground(factor=factor) as terrain:
        balls = resting(terrain, restitution, count=100)
        stamp = Gaussian(MIDDLE, MIDDLE, amplitude=rise, sigma=4.0, detail=factor > 1)
        growth = Growth(stamp, 0.5, Linear())
        one = RunningGrowth(growth, target_of(terrain, detail=factor > 1), (0, 0))
        fastest = abs(rise) / 0.5
        for _ in range(50):
            with moving(terrain, balls):
                advance_dynamics(terrain, [one], DT)
            step(terrain, balls, DT)
            assert above_touching(terrain, balls).min() > -1e-6
            up = balls.velocity.numpy()[:, 2].max()
            assert up <= (fastest if rise > 0 else restitution * fastest) + 2 * COUNT_M / DT
        assert one.done
        settle(terrain, balls)


@RESTITUTIONS
def test_ground_that_stops_throws_a_ball_with_its_own_speed(restitution: float) -> None:
    """Up at 2 m/s for half a second: carried, then thrown to ``u^2 / 2 g`` whatever it is of."""
    speed = 2.0
    with ground() as terrain:
        balls = resting(terrain, restitution)
        place = balls.z.numpy().copy()
        for number in range(1, 51):
            with moving(terrain, balls):
                lift(terrain, speed * DT)
            step(terrain, balls, DT)
            np.testing.assert_allclose(balls.velocity.numpy(), [[0, 0, speed]] * balls.count)
            np.testing.assert_allclose(balls.z.numpy() - place, number * speed * DT, atol=1e-12)
        thrown = totals(balls).impacts
        apex = place
        while totals(balls).impacts == thrown:
            square = np.square(balls.velocity.numpy()[:, 2])
            apex = np.maximum(apex, balls.z.numpy() + 0.5 * square / G)
            step(terrain, balls, DT)
        np.testing.assert_allclose(apex - place - 1.0, speed**2 / (2 * G), rtol=1e-9)
        settle(terrain, balls)


def test_ground_that_slows_down_gently_keeps_its_balls_and_one_that_does_not_loses_them() -> None:
    """By less than gravity in a step a ball stays on it; by more it flies on at its speed."""
    for slowing, stays in ((0.4 * G * DT, True), (3.0 * G * DT, False)):
        with ground() as terrain:
            balls = resting(terrain)
            speed = 2.0
            for number in range(30):
                with moving(terrain, balls):
                    lift(terrain, speed * DT)
                step(terrain, balls, DT)
                on = abs(above_touching(terrain, balls)).max() < 1e-9
                assert on == (stays or number == 0)
                speed = round((speed - slowing) * DT / COUNT_M) * COUNT_M / DT


@RESTITUTIONS
def test_a_ball_in_flight_bounces_relative_to_the_ground(restitution: float) -> None:
    """Down at ``v``, the ground up at ``u``: it leaves at ``u + e (u + v)``."""
    up, fall, gravity = 2.0, 3.0, 1e-9
    with ground() as terrain:
        balls = Balls.at(
            terrain,
            [[20.3, 20.6, 0.04]],
            [[0.5, 0.0, -fall]],
            radius=0.1,
            restitution=restitution,
            friction=0.0,
            above_ground=True,
        )
        with moving(terrain, balls):
            lift(terrain, up * DT)
        step(terrain, balls, DT, gravity=gravity)
        leaves = up + restitution * (up + fall)
        np.testing.assert_allclose(balls.velocity.numpy(), [[0.5, 0.0, leaves]], rtol=1e-6)
        # They met after 8 ms, 16 mm up.
        assert balls.z.numpy()[0] == pytest.approx(0.116 + 0.002 * leaves, rel=1e-6)


def test_a_ball_is_carried_up_a_slope_that_friction_holds_it_on() -> None:
    """A slope of 0.2 with a coefficient of 1.5: it goes straight up with the ground."""
    with ground(per_col=20_000) as terrain:
        balls = resting(terrain)
        for _ in range(20):
            with moving(terrain, balls):
                lift(terrain, 0.01)
            step(terrain, balls, DT)
        expected = np.tile([0.0, 0.0, 1.0], (balls.count, 1))
        np.testing.assert_allclose(balls.velocity.numpy(), expected, rtol=0, atol=1e-9)


def test_sinking_ground_takes_balls_along_once_they_have_fallen_onto_it() -> None:
    """At 0.5 m/s they fall behind for two times ``u / g``, and land on it softly."""
    with ground() as terrain:
        balls = resting(terrain, restitution=0.0)
        begin = balls.z.numpy().copy()
        for number in range(1, 60):
            with moving(terrain, balls):
                lift(terrain, -0.005)
            step(terrain, balls, DT)
            time = number * DT
            at = begin - np.where(time < 2 * 0.5 / G, 0.5 * G * time**2, 0.5 * time)
            np.testing.assert_allclose(balls.z.numpy(), at, rtol=0, atol=1e-9)
        np.testing.assert_allclose(balls.velocity.numpy()[:, 2], -0.5, rtol=1e-9)


def test_ground_that_moves_does_not_touch_what_flies_above_it() -> None:
    """To the bit; and where nothing changes it is as if nobody had looked."""
    moves: list[Callable[[Terrain], None]] = [lambda terrain: lift(terrain, 0.03), lambda _: None]
    for change, height in zip(moves, (2.0, 0.01), strict=True):
        ends = []
        for looks in (True, False):
            with ground() as terrain:
                at = [[20.3, 20.6, height]]
                balls = Balls.at(terrain, at, [[3.0, 1.0, 1.0]], radius=0.1, above_ground=True)
                for _ in range(10):
                    if looks:
                        with moving(terrain, balls):
                            change(terrain)
                    step(terrain, balls, DT)
                ends.append(balls.velocity.numpy().tobytes() + balls.z.numpy().tobytes())
        assert ends[0] == ends[1]


def test_an_edit_at_once_has_no_speed_beside_ground_that_moves() -> None:
    """Moved by 1 cm, edited by 50 cm, moved by 1 cm: 2 cm a step are its speed."""
    with ground() as terrain:
        balls = resting(terrain)
        with moving(terrain, balls):
            lift(terrain, 0.01)
        lift(terrain, 0.5)
        with moving(terrain, balls):
            lift(terrain, 0.01)
        step(terrain, balls, DT)
        np.testing.assert_allclose(balls.velocity.numpy()[:, 2], 2.0, rtol=1e-9)
        np.testing.assert_allclose(above_touching(terrain, balls), 0.0, atol=1e-9)


@RESTITUTIONS
def test_a_shock_throws_balls_no_faster_than_it_moves_itself(restitution: float) -> None:
    """A wave of half a metre under resting balls, until it is over: all rest again."""
    shock = Shock(
        MIDDLE, MIDDLE, 60.0, 60.0, 15.0, 4.0, damping_1_s=1.0,
        displacement=heap(0.5),
    )  # fmt: skip
    with ground() as terrain:
        balls = resting(terrain, restitution)
        one = RunningShock(shock, target_of(terrain, detail=False), (0, 0))
        advance_dynamics(terrain, [one], 0.0)
        fastest = 0.0
        thrown = 0
        while not one.done:
            was = heights(terrain)
            with moving(terrain, balls):
                advance_dynamics(terrain, [one], DT)
            fastest = max(fastest, float((heights(terrain) - was).max()) / DT)
            step(terrain, balls, DT)
            assert above_touching(terrain, balls).min() > -1e-6
            thrown += int((above_touching(terrain, balls) > 1e-3).sum())
            assert restitution > 0 or balls.velocity.numpy()[:, 2].max() <= fastest + 1e-9
        assert thrown > 0
        settle(terrain, balls)


def test_no_balls_on_moving_ground_are_no_error() -> None:
    with ground() as terrain:
        balls = Balls.at(terrain, np.zeros((0, 3)), radius=0.1)
        with moving(terrain, balls):
            lift(terrain, 1.0)
        step(terrain, balls, DT)


def test_the_plan_names_moving_ground_where_balls_meet_it_and_its_bytes() -> None:
    from terrasim.balls.ball_bytes import RISE_BYTES
    from terrasim.scenario.plan import make_plan
    from terrasim.scenario.scenario import parse_scenario

    scene: dict[str, Any] = {
        "terrain": {"kind": "flat", "rows": 64, "cols": 64, "spacing": 1.0},
        "run": {"duration_s": 0.1, "dt_s": 0.01},
        "balls": [{"count": 7, "radius": 0.1, "region": {"size_x": 9.0, "size_y": 9.0}}],
    }
    still = parse_scenario(scene)
    source = still.terrain.source(Path())
    assert "terrasim.kernels.rise" not in make_plan(still, source).kernels
    plan = make_plan(parse_scenario(scene | {"relaxation": {"angle_deg": 35.0}}), source)
    assert "terrasim.kernels.rise" in plan.kernels
    sized = {buffer.name: buffer.bytes for buffer in plan.buffers}
    assert sized["rise of the ground under balls"] == 7 * RISE_BYTES
    assert wp.types.type_size_in_bytes(Rise) + 8 == RISE_BYTES
