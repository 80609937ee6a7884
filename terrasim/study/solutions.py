"""Closed forms by name, and which scenarios each is true for."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from terrasim.errors import InputError
from terrasim.scenario.scenario import Scenario
from terrasim.study.exact.bounce import Bounce
from terrasim.study.exact.flight import Flight
from terrasim.study.exact.incline import Roll, Slide
from terrasim.study.exact.motion import Solution, Vector
from terrasim.study.frames import Frames


@dataclass(frozen=True)
class Begun:
    """A ball as it was let go."""

    position: Vector
    """Centre [m]."""
    velocity: Vector
    """Velocity [m/s]."""
    ground: float
    """Height of the ground below [m]."""
    normal: Vector
    """Upward unit normal of that ground."""
    radius: float
    """Radius [m]."""
    restitution: float
    """Restitution."""
    friction: float
    """Friction."""
    rolling: float
    """Rolling friction."""
    gravity: float
    """Gravity [m/s^2]."""


@dataclass(frozen=True)
class Named:
    """A closed form that a study may name."""

    make: Callable[[Begun], Solution]
    """The solution of one ball."""
    grounds: frozenset[str]
    """Kinds of terrain it is true on."""
    frictionless: bool = False
    """Whether a ball that moves along the ground must have no friction."""
    lies: bool = False
    """Whether the balls must start on the ground."""
    spins: bool | None = None
    """Whether balls must turn, or must not; None if it does not matter."""


def _flight(ball: Begun) -> Solution:
    return Flight(ball.position, ball.velocity, gravity=ball.gravity)


def _bounce(ball: Begun) -> Solution:
    floor = ball.ground + ball.radius
    return Bounce(ball.position, ball.velocity, floor, ball.restitution, ball.gravity)


def _on_plane(kind: type[Slide] | type[Roll]) -> Callable[[Begun], Solution]:
    def make(ball: Begun) -> Solution:
        return kind(
            ball.position,
            ball.velocity,
            ball.normal,
            friction=ball.friction,
            radius=ball.radius,
            rolling=ball.rolling,
            gravity=ball.gravity,
        )

    return make


SOLUTIONS: dict[str, Named] = {
    "flight": Named(_flight, frozenset({"flat", "plane"})),
    "bounce": Named(_bounce, frozenset({"flat"}), frictionless=True),
    "slide": Named(_on_plane(Slide), frozenset({"flat", "plane"}), lies=True, spins=False),
    "roll": Named(_on_plane(Roll), frozenset({"flat", "plane"}), lies=True, spins=True),
}
"""Free flight, bounces on a flat floor, sliding without turning, and slipping until it rolls."""


def check_solution(name: str, scenario: Scenario) -> None:
    """Refuse a closed form that is not true for a scenario.

    Raises:
        InputError: If it is not.
    """
    solution, ground = SOLUTIONS[name], scenario.terrain
    for told, bad in (
        (f"a terrain of kind {' or '.join(sorted(solution.grounds))}, got {ground.kind}",
         ground.kind not in solution.grounds or ground.refine is not None),
        ("balls", not scenario.balls),
        ("ground that stays as it is",
         bool(scenario.stamps or scenario.scatter or scenario.dynamics)),
        ("balls that start on the ground: height = 0",
         solution.lies and any(one.height > 0.0 for one in scenario.balls)),
        ("friction = 0 for balls that move along the ground",
         solution.frictionless
         and any(one.friction > 0.0 and any(one.velocity[:2]) for one in scenario.balls)),
        ("gravity above 0", scenario.run.gravity_m_s2 == 0.0 and name != "flight"),
    ):  # fmt: skip
        if bad:
            raise InputError(f'study.reference: solution = "{name}" needs {told}')
    _check_spin(name, solution, scenario)


def _check_spin(name: str, solution: Named, scenario: Scenario) -> None:
    collision: Any = getattr(scenario, "collision", None)
    spins = bool(getattr(collision, "spin", False))
    if solution.spins is not None and solution.spins != spins:
        rule = "balls that turn: collision.spin = true" if solution.spins else "balls without spin"
        raise InputError(f'study.reference: solution = "{name}" needs {rule}')


def solve(name: str, seen: Frames, gravity: float) -> Frames:
    """The exact motion of the balls of a variant, from its own start and at its own times.

    Raises:
        InputError: If a ball's start has no solution in closed form.
    """
    shape = seen.places.shape
    places, velocities = np.empty(shape), np.empty(shape)
    for i in range(shape[1]):
        radius, restitution, friction, rolling = (float(one) for one in seen.material[i])
        ball = Begun(
            _vector(seen.places[0, i]),
            _vector(seen.velocities[0, i]),
            float(seen.ground[i]),
            _vector(seen.normal[i]),
            radius,
            restitution,
            friction,
            rolling,
            gravity,
        )
        motion = SOLUTIONS[name].make(ball).at(seen.times_s)
        places[:, i], velocities[:, i] = motion.position, motion.velocity
    return Frames(seen.times_s, places, velocities)


def _vector(values: Any) -> Vector:
    x, y, z = (float(one) for one in values)
    return (x, y, z)
