"""Balls on springs: closed forms, limits, and energy that never grows."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

import terrasim as ts
from terrasim.balls.balls import Balls, step, totals
from terrasim.balls.collision import Collision
from terrasim.balls.springs import damping_ratio, explicit_limit, limits_of, sub_steps
from terrasim.errors import InputError

GRAVITY = 9.81
STIFF = 1e5
MASS = 2.0


def flat(**more: Any) -> ts.Terrain:
    return ts.Terrain(ts.Flat(ts.Grid(64, 64, 1.0)), **more)


def dropped(terrain: ts.Terrain, height: float = 0.5, **more: Any) -> Balls:
    given: dict[str, Any] = {"radius": 0.3, "mass": MASS, "friction": 0.5} | more
    return Balls.at(terrain, [[30.0, 30.0, height]], above_ground=True, **given)


def energy(terrain: ts.Terrain, balls: Balls) -> float:
    """Energy of a kilogram: of height, of speed and of the spring [J]."""
    z = balls.positions(terrain)[0, 2]
    depth = max(0.0, 0.3 - z)
    each = float(balls.spring.numpy()[0, 0])
    speed = balls.velocity.numpy()[0]
    return float(GRAVITY * z + 0.5 * speed @ speed + 0.5 * each * depth * depth)


def test_damping_gives_the_restitution_of_6_1() -> None:
    expected = {0.9: 0.0343, 0.8: 0.0744, 0.5: 0.2553, 0.2: 0.7312}
    for restitution, ratio in expected.items():
        assert damping_ratio(restitution) == pytest.approx(ratio, abs=6e-5)
    # On both sides of critical damping, where restitution is exp(-2).
    near = [damping_ratio(math.exp(-2.0 + d)) for d in (1e-6, -1e-6)]
    assert near == pytest.approx([1.0, 1.0], abs=1e-5)
    assert damping_ratio(0.0) > damping_ratio(0.01) > 1.0


@pytest.mark.parametrize("integrator", ["spring", "implicit"])
@pytest.mark.parametrize("restitution", [0.9, 0.8, 0.5, 0.2])
def test_a_bounce_has_the_restitution_it_is_damped_for(integrator: Any, restitution: float) -> None:
    """Within 1 % at a step that resolves the contact."""
    chosen = Collision(integrator=integrator, stiffness=STIFF)
    with flat() as terrain:
        balls = dropped(terrain, 0.0, restitution=restitution, collision=chosen)
        balls.velocity.assign(np.array([[0.0, 0.0, -3.0]]))
        dt = 2e-6 if integrator == "implicit" else 1e-5
        for _ in range(20_000):
            step(terrain, balls, dt, gravity=0.0)
            if balls.velocity.numpy()[0, 2] > 0.0 and balls.positions(terrain)[0, 2] > 0.3:
                break
        assert balls.velocity.numpy()[0, 2] / 3.0 == pytest.approx(restitution, rel=0.01)


def test_the_limits_are_those_of_6_3() -> None:
    """Values of 6.3: K A and R A with 2e8 Pa/m and 3e4 Pa s/m."""
    for mass, area, spring_ms, damper_ms in ((0.01, 7.9e-5, 1.6, 8.5), (1.0, 2.8e-3, 2.66, 23.6)):
        stiffness, damping = 2e8 * area / mass, 3e4 * area / mass
        none = np.zeros(1)
        assert explicit_limit(np.array([stiffness]), none)[0] * 1e3 == pytest.approx(
            spring_ms, rel=0.01
        )
        assert explicit_limit(none, np.array([damping]))[0] * 1e3 == pytest.approx(
            damper_ms, rel=0.01
        )
        both = explicit_limit(np.array([stiffness]), np.array([damping]))[0] * 1e3
        assert (both / spring_ms) ** 2 + both / damper_ms == pytest.approx(1.0, rel=0.03)


def test_a_step_over_a_fifth_of_the_limit_is_refused_parted_or_implicit() -> None:
    chosen = Collision(integrator="spring", stiffness=STIFF, damping=0.0)
    limit = 2.0 * math.sqrt(MASS / STIFF)
    with flat() as terrain:
        balls = dropped(terrain, collision=chosen)
        assert balls.limits is not None
        assert balls.limits.step == pytest.approx(limit)
        step(terrain, balls, 0.199 * limit)
        with pytest.raises(InputError, match=r"over 0\.2 of the explicit limit of 0\.008944 s"):
            step(terrain, balls, 0.201 * limit)
        for over, parted, implicit in (("substep", 11, 0), ("implicit", 0, 1)):
            other = Collision(
                integrator="spring", stiffness=STIFF, damping=0.0, over_limit=over  # type: ignore[arg-type]
            )  # fmt: skip
            balls = dropped(terrain, collision=other)
            step(terrain, balls, 2.1 * limit)
            assert (balls.sub_steps, balls.made_implicit) == (parted, implicit)
    with pytest.raises(InputError, match="take integrator = 'implicit'"):
        sub_steps(1e-9, 1.0)


@pytest.mark.parametrize("mass", [1e-6, 1.0, 1e6])
@pytest.mark.parametrize("stiffness", [0.0, 1e3, 1e12])
@pytest.mark.parametrize("dt", [1e-4, 0.02, 1.0])
def test_implicit_springs_never_add_energy(mass: float, stiffness: float, dt: float) -> None:
    """At any stiffness, mass and step; nor does the centre pass the ground."""
    chosen = Collision(integrator="implicit", stiffness=stiffness, damping=0.0)
    with flat() as terrain:
        balls = dropped(terrain, mass=mass, restitution=1.0, collision=chosen)
        before = energy(terrain, balls)
        for _ in range(60):
            step(terrain, balls, dt)
            now = energy(terrain, balls)
            assert now <= before + 1e-9 * max(1.0, before)
            before = now
            assert balls.positions(terrain)[0, 2] >= 0.0


def test_explicit_springs_gain_little_below_their_limit() -> None:
    """A bounce without damping at a fifth of the limit gains at most some parts in a hundred."""
    gains = []
    for part in (0.05, 0.2):
        chosen = Collision(integrator="spring", stiffness=STIFF, damping=0.0)
        dt = part * 2.0 * math.sqrt(MASS / STIFF)
        worst = 1.0
        for shift in np.linspace(0.0, 1.0, 16, endpoint=False):
            with flat() as terrain:
                balls = dropped(terrain, 1e-6 + 3.0 * dt * shift, collision=chosen)
                balls.velocity.assign(np.array([[0.0, 0.0, -3.0]]))
                for _ in range(400):
                    step(terrain, balls, dt, gravity=0.0)
                    if balls.velocity.numpy()[0, 2] > 0 and balls.positions(terrain)[0, 2] > 0.3:
                        break
                worst = max(worst, float(balls.velocity.numpy()[0, 2] / 3.0) ** 2)
        gains.append(worst)
    assert 1.0 < gains[0] < gains[1] < 1.08


@pytest.mark.parametrize("integrator", ["spring", "implicit"])
def test_a_ball_at_rest_sinks_by_its_weight_and_holds_on_a_slope(integrator: Any) -> None:
    """To ``m g / k``; friction holds it below its angle and not above."""
    chosen = Collision(integrator=integrator, stiffness=STIFF)
    with flat() as terrain:
        balls = dropped(terrain, 0.0, restitution=0.1, collision=chosen)
        for _ in range(3_000):
            step(terrain, balls, 1e-3 if integrator == "implicit" else 2e-4)
        sunk = 0.3 - balls.positions(terrain)[0, 2]
        assert sunk == pytest.approx(MASS * GRAVITY / STIFF, rel=1e-3)
        assert totals(balls).impacts >= 1
    for degrees, slides in ((24.0, False), (29.0, True)):
        slope = math.tan(math.radians(degrees))
        with ts.Terrain(ts.Plane(ts.Grid(300, 64, 1.0), slope_y=-slope, slope_x=0.0)) as terrain:
            balls = Balls.at(
                terrain, [[30.2, 30.4, 0.0]], radius=0.3, mass=MASS, friction=0.5,
                restitution=0.1, collision=chosen, above_ground=True,
            )  # fmt: skip
            for _ in range(4_000):
                step(terrain, balls, 2e-4)
            speed = float(np.linalg.norm(balls.velocity.numpy()[0]))
            angle = math.radians(degrees)
            expected = GRAVITY * (math.sin(angle) - 0.5 * math.cos(angle)) * 0.8
            assert (speed == pytest.approx(expected, rel=0.01)) if slides else speed < 1e-3


def test_a_spring_never_pulls() -> None:
    """A damped ball leaving the ground is not held back: it only loses what gravity takes."""
    chosen = Collision(integrator="spring", stiffness=STIFF, damping=900.0)
    with flat() as terrain:
        balls = dropped(terrain, 0.0, collision=chosen)
        balls.velocity.assign(np.array([[0.0, 0.0, -2.0]]))
        last = -2.0
        for _ in range(4_000):
            step(terrain, balls, 1e-5)
            speed = float(balls.velocity.numpy()[0, 2])
            assert speed >= last - GRAVITY * 1e-5 - 1e-12
            last = speed


@pytest.mark.parametrize("over", ["substep", "implicit"])
def test_no_centre_on_springs_is_ever_below_the_ground(over: Any) -> None:
    """Shots at up to 10 km/s over spikes and cliffs, soft and hard, on base and detail alike."""
    rng = np.random.default_rng(8)
    counts = rng.integers(-300_000, 300_000, (96, 96)).astype(np.int32)
    counts[::7, ::5] = 2_000_000
    count = 2_000
    speed = 10.0 ** rng.uniform(0.0, 4.0, count)
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    place = np.column_stack([rng.uniform(2, 93, (count, 2)), rng.uniform(0, 20, count)])
    source = ts.ArraySource(counts, ts.Grid(96, 96, 1.0))
    for factor in (1, 4):
        with ts.Terrain(source, detail_factor=factor) as terrain:
            chosen = Collision(integrator="spring", stiffness=2e4, over_limit=over)
            balls = Balls.at(
                terrain, place, way * speed[:, None], radius=10.0 ** rng.uniform(-3, 0.5, count),
                restitution=rng.uniform(0, 1, count), mass=1.0, collision=chosen,
                above_ground=True,
            )  # fmt: skip
            for dt in (1e-2, 1e-3, 5e-2):
                for _ in range(3):
                    step(terrain, balls, dt)
                    found = balls.positions(terrain)
                    inside = ((found[:, :2] >= 0.0) & (found[:, :2] <= 95.0)).all(axis=1)
                    heights = ts.sample(terrain, found[inside, :2]).height
                    assert (found[inside, 2] >= heights - 1e-12).all()
            assert np.isfinite(balls.velocity.numpy()).all()


def test_limits_of_no_balls_hold_any_step() -> None:
    assert limits_of(np.empty((0, 2)), np.empty(0)).step == math.inf


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"integrator": "spring"}, "needs a stiffness"),
        ({"stiffness": 1.0}, "it needs integrator = 'spring' or 'implicit', got 'event'"),
        ({"integrator": "spring", "stiffness": -1.0}, "stiffness must be at least 0 N/m"),
        ({"integrator": "implicit", "stiffness": math.nan}, "stiffness must be at least 0"),
        ({"integrator": "implicit", "stiffness": 1.0, "damping": -2.0}, "damping must be at least"),
        ({"over_limit": "ignore"}, "over_limit must be one of refuse, substep, implicit"),
    ],
)
def test_springs_that_cannot_be_are_refused(given: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Collision(**given)


@pytest.mark.parametrize(
    ("mass", "message"),
    [
        (None, "needs the balls' mass"),
        (0.0, "above 0"),
        (-1.0, "above 0"),
        (math.nan, "above 0"),
    ],
)
def test_a_mass_that_cannot_be_is_refused(mass: Any, message: str) -> None:
    with flat() as terrain, pytest.raises(InputError, match=message):
        dropped(terrain, mass=mass, collision=Collision(integrator="implicit", stiffness=1.0))
