"""The closed forms: the values of textbooks, and the laws they must obey."""

from __future__ import annotations

import math

import numpy as np
import pytest

from terrasim.errors import InputError
from terrasim.study.exact.bounce import Bounce
from terrasim.study.exact.flight import Flight
from terrasim.study.exact.incline import Roll, Slide
from terrasim.study.exact.motion import Solution

G = 9.81


def plane(angle_deg: float) -> tuple[float, float, float]:
    """Normal of a plane that falls to the east."""
    angle = math.radians(angle_deg)
    return (math.sin(angle), 0.0, math.cos(angle))


def drop(restitution: float, height: float = 1.0) -> Bounce:
    """A ball let go at rest over a floor."""
    return Bounce((0.0, 0.0, 5.0 + height), (0.0, 0.0, 0.0), 5.0, restitution)


SOLUTIONS: tuple[Solution, ...] = (
    Flight((1.0, 2.0, 3.0), (4.0, 5.0, 6.0)),
    drop(0.8),
    drop(1.0),
    Bounce((0.0, 0.0, 2.0), (1.0, -2.0, 3.0), 0.0, 0.7),
    Slide((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), friction=0.4),
    Slide((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), plane(30.0), friction=0.1),
    Slide((0.0, 0.0, 0.0), (-math.cos(0.5), 0.0, math.sin(0.5)), plane(math.degrees(0.5)), 0.2),
    Roll((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), friction=0.2),
    Roll((0.0, 0.0, 0.0), (0.0, 2.0, 0.0), friction=0.2, rolling=0.05),
    Roll((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), plane(20.0), friction=0.5),
)


@pytest.mark.parametrize("solution", SOLUTIONS, ids=[type(one).__name__ for one in SOLUTIONS])
def test_velocity_is_the_change_of_place(solution: Solution) -> None:
    """Central differences agree wherever no impact or change of stretch lies between."""
    t = np.linspace(0.01, 3.0, 701)
    h = 1e-6
    rate = (solution.at(t + h).position - solution.at(t - h).position) / (2.0 * h)
    near = np.linalg.norm(rate - solution.at(t).velocity, axis=1) < 1e-6
    assert near.mean() > 0.97
    # No place is jumped over, through impacts either.
    steps = np.linalg.norm(np.diff(solution.at(t).position, axis=0), axis=1)
    fastest = np.linalg.norm(solution.at(np.linspace(0.0, 3.0, 9001)).velocity, axis=1).max()
    assert steps.max() <= fastest * (t[1] - t[0]) * (1.0 + 1e-9)


@pytest.mark.parametrize(
    ("restitution", "rest_s", "apexes"),
    [
        (0.5, 1.3546, (0.25, 0.0625, 0.0156)),
        (0.8, 4.0637, (0.64, 0.4096, 0.2621)),
        (0.9, 8.5789, (0.81, 0.6561, 0.5314)),
    ],
)
def test_bounces_have_the_heights_and_times_of_the_geometric_series(
    restitution: float, rest_s: float, apexes: tuple[float, ...]
) -> None:
    ball = drop(restitution)
    assert ball.rest_s == pytest.approx(rest_s, abs=1e-4)
    for bounce, height in enumerate(apexes, 1):
        assert ball.apex(bounce) == pytest.approx(height, abs=5e-5)
        between = ball.impact_s(bounce) + ball.restitution**bounce * ball.impact_speed / G
        assert float(ball.at(between).position[2]) == pytest.approx(5.0 + ball.apex(bounce))
    assert float(ball.at(rest_s + 1.0).position[2]) == 5.0
    assert float(ball.at(rest_s + 1.0).velocity[2]) == 0.0


def test_a_perfect_bounce_keeps_its_energy_and_others_lose_it() -> None:
    t = np.linspace(0.0, 50.0, 5001)
    energy = drop(1.0).at(t).energy(G)
    np.testing.assert_allclose(energy, energy[0], rtol=1e-13)
    lost = np.diff(drop(0.9).at(t).energy(G))
    assert (lost <= 1e-12).all()
    assert drop(0.0).at(np.array([0.5, 9.0])).position[:, 2].tolist() == [5.0, 5.0]


def test_an_impact_at_its_own_time_has_happened() -> None:
    ball = drop(0.9)
    times = ball.impact_s(np.arange(1, 40))
    heights = ball.at(times).position[:, 2]
    np.testing.assert_allclose(heights, 5.0, atol=1e-12)
    assert (ball.at(times + 1e-9).velocity[:, 2] > 0.0).all()


@pytest.mark.parametrize(
    ("angle", "friction", "gain"),
    [
        (10.0, 0.3, 1.2168), (20.0, 0.3, 2.3966), (30.0, 0.5, 3.5036), (45.0, 0.5, 4.9548),
        (20.0, 0.1, 2.4334), (30.0, 0.1, 4.0554), (45.0, 0.1, 6.2430),
    ],
)  # fmt: skip
def test_a_ball_rolls_or_slips_down_an_incline(angle: float, friction: float, gain: float) -> None:
    ball = Roll((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), plane(angle), friction, radius=0.2)
    assert np.linalg.norm(ball.at(1.0).velocity) == pytest.approx(gain, abs=1e-4)
    rolls = math.tan(math.radians(angle)) <= 3.5 * friction
    spin = np.linalg.norm(ball.at(1.0).spin)
    slipping = 2.5 * friction * G * math.cos(math.radians(angle)) / 0.2
    assert spin == pytest.approx(gain / 0.2 if rolls else slipping, rel=1e-4)
    if rolls:
        np.testing.assert_allclose(ball.at(1.0).energy(G, 0.2), 0.0, atol=1e-12)


@pytest.mark.parametrize(
    ("friction", "time_s", "way"), [(0.2, 0.2912, 0.4993), (0.4, 0.1456, 0.2496)]
)
def test_a_ball_that_slides_on_flat_ground_comes_to_roll(
    friction: float, time_s: float, way: float
) -> None:
    ball = Roll((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), friction=friction, radius=0.1)
    assert ball.roll_s == pytest.approx(time_s, abs=1e-4)
    assert float(ball.at(ball.roll_s).position[0]) == pytest.approx(way, abs=1e-4)
    later = ball.at(ball.roll_s + 3.0)
    np.testing.assert_allclose(later.velocity, [10.0 / 7.0, 0.0, 0.0], rtol=1e-12)
    # The contact point is at rest: v + w x r = 0 with r the way down to it.
    contact = later.velocity + np.cross(later.spin, [0.0, 0.0, -0.1])
    np.testing.assert_allclose(contact, 0.0, atol=1e-12)
    braked = Roll((0.0, 0.0, 0.0), (2.0, 0.0, 0.0), friction=friction, rolling=0.1)
    assert float(np.linalg.norm(braked.at(60.0).velocity)) == 0.0


@pytest.mark.parametrize(("friction", "way"), [(0.2, 1.0194), (0.4, 0.5097), (0.7, 0.2912)])
def test_a_box_stops_after_its_way(friction: float, way: float) -> None:
    box = Slide((0.0, 0.0, 0.0), (0.0, 2.0, 0.0), friction=friction)
    assert float(box.at(9.0).position[1]) == pytest.approx(way, abs=1e-4)
    assert box.stop_s == pytest.approx(2.0 / (friction * G))


def test_friction_holds_up_to_its_angle() -> None:
    for angle, moves in ((20.0, False), (24.0, True)):
        friction = math.tan(math.radians(22.0))
        box = Slide((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), plane(angle), friction)
        assert (float(box.at(1.0).position[0]) > 0.0) == moves


def test_what_has_no_closed_form_is_refused() -> None:
    with pytest.raises(InputError, match="line of fall"):
        Slide((0.0, 0.0, 0.0), (0.0, 1.0, 0.0), plane(20.0))
    up = (-math.cos(0.5), 0.0, math.sin(0.5))
    with pytest.raises(InputError, match="down the slope"):
        Roll((0.0, 0.0, 0.0), up, plane(math.degrees(0.5)))
