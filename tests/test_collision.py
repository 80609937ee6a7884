"""Kinds of contact and of steps: against closed forms, at the order theory says, never through."""

from __future__ import annotations

import numpy as np
import pytest

import terrasim as ts
from terrasim.balls.balls import Balls, step, totals
from terrasim.balls.collision import Collision
from terrasim.errors import InputError

GRAVITY = 9.81
EVERY = [
    Collision(contact, integrator)
    for contact in ("plane", "vertical")
    for integrator in ("event", "projected")
]


def flat() -> ts.Terrain:
    return ts.Terrain(ts.Flat(ts.Grid(64, 64, 1.0)))


def ramp(degrees: float) -> ts.Terrain:
    slope = float(np.tan(np.radians(degrees)))
    return ts.Terrain(ts.Plane(ts.Grid(512, 512, 1.0), slope_x=-slope, slope_y=0.0))


def peaks(collision: Collision, restitution: float, dt: float, count: int) -> list[float]:
    """Heights of the first bounces of a ball let go 1 m above the floor."""
    with flat() as terrain:
        balls = Balls.at(
            terrain, [[30.0, 30.0, 1.0]], radius=0.1, restitution=restitution,
            collision=collision, above_ground=True,
        )  # fmt: skip
        found: list[float] = []
        before = -1.0
        while len(found) < count:
            step(terrain, balls, dt)
            height = balls.positions(terrain)[0, 2] - 0.1
            speed = balls.velocity.numpy()[0, 2]
            if before > 0.0 >= speed:
                found.append(height + speed * speed / (2.0 * GRAVITY))
            before = speed
        return found


@pytest.mark.parametrize("collision", EVERY)
@pytest.mark.parametrize("restitution", [0.5, 0.8, 0.9])
def test_bounces_are_as_high_as_restitution_says(collision: Collision, restitution: float) -> None:
    """6.1: 1 %, and stepped with projection from a step of 2.5e-4 s down."""
    dt = 2.5e-4 if collision.integrator == "projected" else 1e-3
    expected = [restitution ** (2 * k) for k in (1, 2, 3)]
    assert peaks(collision, restitution, dt, 3) == pytest.approx(expected, rel=0.01)


@pytest.mark.parametrize("contact", ["plane", "vertical"])
def test_projection_is_of_first_order(contact: str) -> None:
    """The error of the height at a time, over three halvings."""
    errors = []
    for dt in (4e-3, 2e-3, 1e-3, 5e-4):
        found = peaks(Collision(contact, "projected"), 0.8, dt, 2)  # type: ignore[arg-type]
        errors.append(abs(found[0] - 0.64) + abs(found[1] - 0.4096))
    order = np.polyfit(np.log([4e-3, 2e-3, 1e-3, 5e-4]), np.log(errors), 1)[0]
    assert order == pytest.approx(1.0, abs=0.35)


@pytest.mark.parametrize("collision", EVERY)
def test_a_ball_stays_or_slides_as_friction_says(collision: Collision) -> None:
    """Threshold of 6.1 at atan(mu) plus and minus 2 degrees, and the acceleration beyond."""
    friction = 0.4
    limit = float(np.degrees(np.arctan(friction)))
    dt, steps = 2e-3, 400
    for degrees in (limit - 2.0, limit + 2.0, 45.0):
        with ramp(degrees) as terrain:
            balls = Balls.at(
                terrain, [[20.0, 200.0, 0.0]], radius=0.1, restitution=0.3, friction=friction,
                collision=collision, above_ground=True,
            )  # fmt: skip
            for _ in range(steps):
                step(terrain, balls, dt)
            speed = float(np.linalg.norm(balls.velocity.numpy()[0]))
            angle = np.radians(degrees)
            expected = GRAVITY * (np.sin(angle) - friction * np.cos(angle)) * dt * steps
            if degrees < limit:
                assert speed == 0.0
            else:
                assert speed == pytest.approx(expected, rel=5e-3)


@pytest.mark.parametrize("collision", EVERY)
def test_a_sliding_box_stops_where_friction_says(collision: Collision) -> None:
    """6.1: v0^2 / (2 mu g) within 1 %."""
    with flat() as terrain:
        balls = Balls.at(
            terrain, np.tile([20.0, 20.0, 0.0], (3, 1)), [2.0, 0.0, 0.0], radius=0.1,
            friction=[0.2, 0.4, 0.7], collision=collision, above_ground=True,
        )  # fmt: skip
        for _ in range(1_200):
            step(terrain, balls, 1e-3)
        way = balls.positions(terrain)[:, 0] - 20.0
        assert way == pytest.approx([1.0194, 0.5097, 0.2912], rel=0.01)
        assert not balls.velocity.numpy().any()


@pytest.mark.parametrize("contact", ["plane", "vertical"])
@pytest.mark.parametrize("altitude", [0.0, 4_000.0])
def test_an_elastic_ball_keeps_its_energy(contact: str, altitude: float) -> None:
    """Absolute drift at most 1e-5 over 1,000 bounces, at sea level and at 4,000 m."""
    with ts.Terrain(ts.Flat(ts.Grid(64, 64, 1.0), altitude)) as terrain:
        balls = Balls.at(
            terrain, [[30.0, 30.0, 1.0]], radius=0.1, restitution=1.0, friction=0.0,
            collision=Collision(contact), above_ground=True,  # type: ignore[arg-type]
        )  # fmt: skip
        for _ in range(4_600):
            step(terrain, balls, 0.2)
        assert totals(balls).impacts > 1_000
        height = balls.positions(terrain)[0, 2] - altitude - 0.1
        energy = GRAVITY * height + 0.5 * float(np.square(balls.velocity.numpy()[0]).sum())
        assert abs(energy / GRAVITY - 1.0) <= 1e-5


def test_vertical_contact_stands_a_radius_over_the_ground() -> None:
    """And ``plane`` a radius from it: they differ by the secant of the slope."""
    for contact, over in (("plane", 1.0 / np.cos(np.radians(50.0))), ("vertical", 1.0)):
        with ramp(50.0) as terrain:
            balls = Balls.at(
                terrain, [[20.25, 20.25, 0.0]], radius=0.5,
                collision=Collision(contact), above_ground=True,  # type: ignore[arg-type]
            )  # fmt: skip
            ground = float(ts.sample(terrain, np.array([[20.25, 20.25]])).height[0])
            assert balls.positions(terrain)[0, 2] - ground == pytest.approx(0.5 * over, abs=2e-5)


@pytest.mark.parametrize("collision", EVERY)
def test_no_centre_is_ever_below_the_ground(collision: Collision) -> None:
    """Shots in all directions at up to 10 km/s over spikes, ridges and cliffs."""
    rng = np.random.default_rng(8)
    counts = rng.integers(-300_000, 300_000, (96, 96)).astype(np.int32)
    counts[::7, ::5] = 2_000_000
    counts[40, :] = 1_500_000
    count = 5_000
    speed = 10.0 ** rng.uniform(0.0, 4.0, count)
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1)[:, None]
    place = np.column_stack([rng.uniform(2, 93, (count, 2)), rng.uniform(0, 20, count)])
    with ts.Terrain(ts.ArraySource(counts, ts.Grid(96, 96, 1.0))) as terrain:
        balls = Balls.at(
            terrain, place, way * speed[:, None], radius=10.0 ** rng.uniform(-3, 0.5, count),
            restitution=rng.uniform(0, 1, count), collision=collision, above_ground=True,
        )  # fmt: skip
        for dt in (1e-2, 1e-3, 5e-2):
            for _ in range(5):
                step(terrain, balls, dt)
                found = balls.positions(terrain)
                inside = ((found[:, :2] >= 0.0) & (found[:, :2] <= 95.0)).all(axis=1)
                heights = ts.sample(terrain, found[inside, :2]).height
                assert (found[inside, 2] >= heights).all()


def test_what_is_no_kind_is_refused() -> None:
    with pytest.raises(InputError, match="contact must be one of plane, vertical, got 'round'"):
        Collision("round")  # type: ignore[arg-type]
    with pytest.raises(
        InputError, match="integrator must be one of event, projected, spring, implicit, got 'rk4'"
    ):
        Collision("plane", "rk4")  # type: ignore[arg-type]
