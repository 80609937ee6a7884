"""Spin and rolling friction as functions of their own, on one plane, against closed forms."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp
from spin_kernels import groove, lie, strike

G = 9.81
R = 0.1
MOST_EVENTS = 4
"""Across its way, grips, stops, rolls back."""
Table = npt.NDArray[np.float64]


def vectors(rows: Any) -> wp.array[Any, Any]:
    return wp.array(np.asarray(rows, dtype=np.float64).reshape(-1, 3), dtype=wp.vec3d, device="cpu")


def lying(
    degrees: float,
    time: float,
    *,
    friction: float,
    rolling: float = 0.0,
    velocity: Any = (0.0, 0.0, 0.0),
    spin: Any = (0.0, 0.0, 0.0),
    steps: int = 1,
    towards: float = 0.0,
) -> tuple[Table, Table, Table]:
    """Place, velocity and spin on an incline, in its own coordinates.

    x goes down the incline, z along its normal. ``towards`` turns all of it about the vertical.
    """
    angle = math.radians(degrees)
    fall = np.array([math.sin(angle), 0.0, -math.cos(angle)]) * G
    turn = np.array(
        [
            [math.cos(towards), -math.sin(towards), 0.0],
            [math.sin(towards), math.cos(towards), 0.0],
            [0, 0, 1],
        ]
    )
    v, w = vectors(np.atleast_2d(velocity) @ turn.T), vectors(np.atleast_2d(spin) @ turn.T)
    place = vectors(np.zeros((len(v), 3)))
    met = wp.zeros(len(v), dtype=int, device="cpu")
    plain = [wp.vec3d(*(turn @ fall)), wp.vec3d(0.0, 0.0, 1.0), friction, rolling, time / steps]
    wp.launch(lie, len(v), inputs=[*plain, steps, place, v, w, met], device="cpu")
    assert met.numpy().max() <= MOST_EVENTS
    return place.numpy() @ turn, v.numpy() @ turn, w.numpy() @ turn


def hit(
    velocity: Any, spin: Any, *, friction: float, restitution: float = 0.5, rolling: float = 0.0
) -> tuple[Table, Table, Table]:
    """Velocity, spin and slip after an impact on level ground."""
    v, w = vectors(velocity), vectors(spin)
    slip = vectors(np.zeros((len(v), 3)))
    up = wp.vec3d(0.0, 0.0, 1.0)
    wp.launch(strike, len(v), inputs=[up, restitution, friction, rolling, v, w, slip], device="cpu")
    return v.numpy(), w.numpy(), slip.numpy()


def energy(v: Table, w: Table) -> Table:
    """Energy of motion and of spin, of a kilogram [J]."""
    return np.asarray(0.5 * (v**2).sum(axis=1) + 0.2 * R**2 * (w**2).sum(axis=1))


@pytest.mark.parametrize(
    ("degrees", "friction", "expected"),
    [(10, 0.06, 1.2168), (20, 0.3, 2.3966), (30, 0.3, 3.5036), (45, 0.3, 4.9548)],
)
def test_a_ball_rolls_down_an_incline(degrees: float, friction: float, expected: float) -> None:
    """Five sevenths of gravity along it, and a spin to match."""
    place, v, w = lying(degrees, 2.0, friction=friction, towards=0.7)
    truth = 5.0 / 7.0 * G * math.sin(math.radians(degrees))
    assert truth == pytest.approx(expected, rel=5e-5)
    np.testing.assert_allclose(v, [[2.0 * truth, 0.0, 0.0]], rtol=0, atol=1e-12)
    np.testing.assert_allclose(place, [[2.0 * truth, 0.0, 0.0]], rtol=0, atol=1e-12)
    np.testing.assert_allclose(w, [[0.0, 2.0 * truth / R, 0.0]], rtol=0, atol=1e-11)


@pytest.mark.parametrize(("degrees", "expected"), [(20, 2.4334), (30, 4.0554), (45, 6.2430)])
def test_a_ball_slides_down_an_incline_too_steep_to_roll(degrees: float, expected: float) -> None:
    """Friction of 0.1 takes its part of gravity and turns the ball as fast as it can."""
    _, v, w = lying(degrees, 1.5, friction=0.1, towards=2.0, steps=7)
    angle = math.radians(degrees)
    truth = G * (math.sin(angle) - 0.1 * math.cos(angle))
    assert truth == pytest.approx(expected, rel=5e-5)
    np.testing.assert_allclose(v, [[1.5 * truth, 0.0, 0.0]], rtol=0, atol=1e-12)
    alpha = 5.0 * 0.1 * G * math.cos(angle) / (2.0 * R)
    np.testing.assert_allclose(w, [[0.0, 1.5 * alpha, 0.0]], rtol=0, atol=1e-11)


@pytest.mark.parametrize(("friction", "t", "s"), [(0.2, 0.2912, 0.4993), (0.4, 0.1456, 0.2496)])
def test_on_level_ground_a_ball_slides_then_rolls(friction: float, t: float, s: float) -> None:
    """When, where and how fast it begins to roll, whatever the step."""
    truth = 2.0 * 2.0 / (7.0 * friction * G), 12.0 * 4.0 / (49.0 * friction * G)
    assert truth == pytest.approx((t, s), rel=3e-4)
    just_before = lying(0.0, truth[0] * (1 - 1e-9), friction=friction, velocity=[2.0, 0, 0])[1]
    assert just_before[0, 0] > 10.0 / 7.0
    for steps in (1, 3, 1000):
        place, v, w = lying(
            0.0, truth[0] * (1 + 1e-9), friction=friction, velocity=[2.0, 0, 0], steps=steps
        )
        np.testing.assert_allclose(v, [[10.0 / 7.0, 0.0, 0.0]], rtol=0, atol=1e-8)
        np.testing.assert_allclose(w, [[0.0, 10.0 / 7.0 / R, 0.0]], rtol=0, atol=1e-7)
        np.testing.assert_allclose(place[0, 0], truth[1], rtol=1e-8)
        later = lying(0.0, 5.0, friction=friction, velocity=[2.0, 0, 0], steps=steps)[1]
        np.testing.assert_allclose(later, [[10.0 / 7.0, 0.0, 0.0]], rtol=0, atol=1e-12)


def test_a_ball_with_side_spin_runs_along_a_parabola() -> None:
    """The slip does not turn on level ground, so one long step is as exact as many short ones."""
    velocity, spin = [2.0, 0.0, 0.0], [30.0, -5.0, 40.0]
    slip = np.array([2.0 + 0.5, 30.0 * R])
    size = float(np.hypot(*slip))
    end = 2.0 * size / (7.0 * 0.25 * G)
    for steps in (1, 500):
        place, v, w = lying(0.0, end, friction=0.25, velocity=velocity, spin=spin, steps=steps)
        truth = np.array([2.0, 0.0]) - 2.0 / 7.0 * slip
        np.testing.assert_allclose(v[0, :2], truth, rtol=0, atol=1e-12)
        np.testing.assert_allclose(
            place[0, :2], (np.array([2.0, 0.0]) + truth) / 2 * end, rtol=0, atol=1e-12
        )
        assert w[0, 2] == 40.0


def test_a_slip_that_turns_converges_at_first_order() -> None:
    """Thrown across an incline of 20 degrees: half the step, half the error."""
    errors = []
    fine = lying(20.0, 0.4, friction=0.3, velocity=[0, 3.0, 0], spin=[0, 0, 3], steps=8000)
    for steps in (10, 20, 40, 80):
        out = lying(20.0, 0.4, friction=0.3, velocity=[0, 3.0, 0], spin=[0, 0, 3], steps=steps)
        errors.append(np.abs(out[0] - fine[0]).max())
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 1.0, atol=0.3)


@pytest.mark.parametrize("friction", [0.05, 0.2, 0.9])
def test_friction_decides_what_rolls(friction: float) -> None:
    """It rolls where the slope is at most 3.5 times the friction: beyond, the contact slips."""
    limit = math.degrees(math.atan(3.5 * friction))
    for degrees, rolls in ((limit * 0.99, True), (limit * 1.01, False)):
        _, v, w = lying(degrees, 1.0, friction=friction)
        assert (abs(v[0, 0] - w[0, 1] * R) < 1e-12) == rolls


@pytest.mark.parametrize("coefficient", [0.02, 0.1, 0.3])
def test_rolling_friction_holds_on_slopes_as_steep_as_itself(coefficient: float) -> None:
    """A little less steep it stays for good; a little steeper it rolls; pushed, it stops."""
    limit = math.degrees(math.atan(coefficient))
    for degrees, held in ((limit * 0.99, True), (limit * 1.01, False)):
        out = lying(degrees, 3.0, friction=0.8, rolling=coefficient, steps=3)
        assert (not out[0].any() and not out[1].any() and not out[2].any()) == held
        for push in (0.5, -0.5):
            _, v, w = lying(
                degrees, 1000.0, friction=0.8, rolling=coefficient, velocity=[push, 0, 0], steps=9
            )
            assert (not v.any() and not w.any()) == held


def test_rolling_friction_slows_a_ball_on_level_ground() -> None:
    """A rolling ball of 5/7 of the pull stops after v^2 / (2 * 5/7 c g)."""
    for steps in (1, 400):
        place, v, w = lying(
            0.0,
            20.0,
            friction=0.5,
            rolling=0.02,
            velocity=[1.2, 1.6, 0],
            spin=[-16.0, 12.0, 7.0],
            steps=steps,
        )
        stop = 4.0 / (2.0 * 5.0 / 7.0 * 0.02 * G)
        np.testing.assert_allclose(place, [[0.6 * stop, 0.8 * stop, 0.0]], rtol=0, atol=1e-10)
        assert not v.any()
        assert w.tolist() == [[0.0, 0.0, 7.0]]


def test_rolling_friction_never_asks_for_more_than_friction_gives() -> None:
    """Strong enough to hold a ball from turning, it makes it a block: the slope less friction."""
    for degrees in (15.0, 25.0):
        angle = math.radians(degrees)
        _, v, _ = lying(degrees, 1.0, friction=0.2, rolling=5.0)
        truth = G * (math.sin(angle) - 0.2 * math.cos(angle))
        np.testing.assert_allclose(v, [[truth, 0.0, 0.0]], rtol=0, atol=1e-12)
    place, v, _ = lying(0.0, 9.0, friction=0.2, rolling=5.0, velocity=[1, 0, 0], spin=[0, 10, 0])
    np.testing.assert_allclose(place[0, 0], 1.0 / (2.0 * 0.2 * G), rtol=1e-12)
    assert not v.any()


def test_without_friction_spin_and_way_are_strangers() -> None:
    """Gravity alone moves the ball; its spin stays."""
    _, v, w = lying(30.0, 2.0, friction=0.0, rolling=0.1, velocity=[0, 1, 0], spin=[3, 4, 5])
    np.testing.assert_allclose(v, [[G, 1.0, 0.0]], rtol=0, atol=1e-12)
    assert w.tolist() == [[3.0, 4.0, 5.0]]


def test_lying_balls_never_gain_energy() -> None:
    """Any velocity, spin and friction on level ground, long steps and short."""
    rng = np.random.default_rng(6)
    v = rng.normal(0, 3, (300, 3)) * [1, 1, 0]
    w = rng.normal(0, 40, (300, 3))
    for friction, rolling in ((0.0, 0.0), (0.1, 0.0), (0.1, 0.05), (0.6, 1.0)):
        for time in (1e-6, 0.01, 0.3, 100.0):
            _, after_v, after_w = lying(
                0.0, time, friction=friction, rolling=rolling, velocity=v, spin=w
            )
            assert (energy(after_v, after_w) <= energy(v, w) * (1 + 1e-14)).all()
            np.testing.assert_allclose(after_w[:, 2], w[:, 2], rtol=1e-14)


@pytest.mark.parametrize("degrees", [0.0, 15.0, 35.0, 75.0])
def test_no_step_is_too_long_for_a_slip_that_turns(degrees: float) -> None:
    """However it is thrown, energy never grows, and no step takes more than a few events."""
    rng = np.random.default_rng(8)
    v = rng.normal(0, 3, (400, 3)) * [1, 1, 0]
    w = rng.normal(0, 40, (400, 3))
    pull = G * math.sin(math.radians(degrees))
    for friction, rolling in ((0.1, 0.0), (0.3, 0.05), (0.6, 0.4), (2.0, 3.0)):
        for steps in (1, 7, 50):
            place, after_v, after_w = lying(
                degrees, 2.0, friction=friction, rolling=rolling, velocity=v, spin=w, steps=steps
            )
            before = energy(v, w)
            now = energy(after_v, after_w) - pull * place[:, 0]
            assert (now <= before * (1 + 1e-12) + 1e-9).all()


def test_a_gentle_impact_grips_and_a_grazing_one_slips() -> None:
    """Two sevenths of the slip, or friction times (1 + e) times the normal speed, if that is less.

    Momentum about the contact point is kept either way.
    """
    velocity = np.array([[1.0, 0.0, -2.0], [10.0, 0.0, -0.5], [0.0, 3.0, -1.0]])
    spin = np.array([[0.0, 0.0, 0.0], [0.0, 0.0, 6.0], [50.0, 0.0, 0.0]])
    v, w, slip = hit(velocity, spin, friction=0.3)
    slip_before = np.array([[1.0, 0.0], [10.0, 0.0], [0.0, 8.0]])
    load = 1.5 * -velocity[:, 2]
    size = np.minimum(2.0 / 7.0 * np.hypot(*slip_before.T), 0.3 * load)
    push = slip_before / np.hypot(*slip_before.T)[:, None] * size[:, None]
    np.testing.assert_allclose(v[:, :2], velocity[:, :2] - push, rtol=0, atol=1e-14)
    np.testing.assert_allclose(v[:, 2], -0.5 * velocity[:, 2], rtol=1e-15)
    np.testing.assert_allclose(slip[0], 0.0, atol=1e-14)
    assert np.hypot(*slip[1:, :2].T).min() > 1.0
    arm = np.array([0.0, 0.0, R])
    change = np.cross(arm, v - velocity) + 0.4 * R**2 * (w - spin)
    np.testing.assert_allclose(change, 0.0, atol=1e-14)


def test_an_impact_never_gains_energy_nor_turns_a_slip() -> None:
    """Any velocity and spin; with restitution 1 and no friction nothing is lost."""
    rng = np.random.default_rng(7)
    v = rng.normal(0, 5, (500, 3))
    v[:, 2] = -np.abs(v[:, 2])
    w = rng.normal(0, 100, (500, 3))
    slip = v * [1, 1, 0] - R * np.cross(w, [0.0, 0.0, 1.0])
    for restitution in (0.0, 0.6, 1.0):
        for friction, rolling in ((0.0, 0.0), (0.2, 0.0), (5.0, 0.0), (5.0, 0.3), (0.1, 4.0)):
            after_v, after_w, left = hit(
                v, w, friction=friction, rolling=rolling, restitution=restitution
            )
            before, now = energy(v, w), energy(after_v, after_w)
            pushed = np.hypot(*(after_v - v)[:, :2].T)
            load = -(1.0 + restitution) * v[:, 2]
            assert (pushed <= friction * load * (1 + 1e-12) + 1e-14).all()
            assert (now <= before * (1 + 1e-14)).all()
            if restitution == 1.0 and friction == 0.0:
                np.testing.assert_allclose(now, before, rtol=1e-14)
            assert ((left * slip).sum(axis=1) >= -1e-9).all()
            np.testing.assert_allclose(after_w[:, 2], w[:, 2], rtol=1e-12)


def test_many_small_impacts_are_the_motion_of_what_lies() -> None:
    """Pulled and pressed 10,000 times in place of always: rolls, slides, is held as it would be."""
    angle, dt = math.radians(20.0), 1e-4
    pull, load = G * math.sin(angle), G * math.cos(angle)
    for friction, rolling in ((0.3, 0.0), (0.08, 0.0), (0.5, 0.1), (0.5, 0.4)):
        v, w = np.zeros((1, 3)), np.zeros((1, 3))
        pulled = np.array([[pull * dt, 0.0, -load * dt]])
        for _ in range(2000):
            v, w, _ = hit(v + pulled, w, friction=friction, rolling=rolling, restitution=0.0)
        _, truth, turned = lying(20.0, 0.2, friction=friction, rolling=rolling)
        np.testing.assert_allclose(v, truth, rtol=0, atol=1e-10)
        np.testing.assert_allclose(w, turned, rtol=0, atol=1e-9)


@pytest.mark.parametrize(("friction", "t", "s"), [(0.2, 0.2912, 0.4993), (0.4, 0.1456, 0.2496)])
def test_many_small_impacts_slide_then_roll(friction: float, t: float, s: float) -> None:
    """As where each step ends on the ground: first order in when and where, exact in how fast."""
    dt = 1e-4
    v, w = np.array([[2.0, 0.0, 0.0]]), np.zeros((1, 3))
    way, begins = 0.0, 0.0
    for k in range(4000):
        v, w, slip = hit(v - [[0.0, 0.0, G * dt]], w, friction=friction, restitution=0.0)
        way += v[0, 0] * dt
        if not begins and np.abs(slip).max() < 1e-12:
            begins = (k + 1) * dt
    assert begins == pytest.approx(t, rel=1e-2)
    assert v[0, 0] == pytest.approx(10.0 / 7.0, rel=1e-12)
    assert way == pytest.approx(s + 10.0 / 7.0 * (0.4 - t), rel=1e-3)


def test_in_a_groove_a_ball_rolls_on_a_shorter_arm() -> None:
    """Walls of 60 degrees to each other: the arm is half the radius, the spin takes more."""
    half = math.radians(30.0)
    rise = math.sin(half)
    out = vectors([[0, 0, 0]])
    way, up = wp.vec3d(1.0, 0.0, 0.0), wp.vec3d(0.0, 0.0, 1.0)
    load = G / rise
    wp.launch(groove, 1, inputs=[way, up, rise, 1.0, load, 0.5, 0.0, out], device="cpu")
    np.testing.assert_allclose(out.numpy()[0], [1.0 / (1.0 + 0.4 / rise**2), 0, 0], rtol=1e-14)
    wp.launch(groove, 1, inputs=[way, up, rise, 1.0, load, 0.01, 0.0, out], device="cpu")
    np.testing.assert_allclose(out.numpy()[0], [1.0 - 0.01 * load, 0, 0], rtol=1e-14)
