"""Balls against balls, for a caller that asks for it after a step.

Balls of a million find each other through a hash grid; see ``balls.neighbours`` for how, and
``kernels.ball_pairs`` for what they do to each other. What is worth knowing:

- It sees where balls are at the end of a step, not their way there: two that pass through each
  other within one step do not meet. Balls that move more than their radius in a step are counted.
- Balls that overlap are pushed apart, the lighter one further, without a change of their speeds.
  That may lift a ball or push it into the ground, out of which the next step puts it.
- Friction between balls slows their slip as if they did not turn.
- A ball that sleeps is woken by one that strikes or pushes it, not by one that goes away. One that
  lies on other balls does not sleep: each step lets it fall until its support is met again.
- Of balls that meet at once, each gets a part of each impact: two that strike a third from both
  sides with restitution 1 come off slower than they came. One impact after another, as in a row of
  balls of which the first is struck, keeps all its energy.

The result has the same bits for any number of threads, in any place a whole number of cells away,
and in any order of the balls, unless two neighbours of a ball are equally near to it to the last
bit, which their numbers then decide, or balls are crowded: of those in one bin a ball sees those
with numbers near its own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from terrasim.balls.balls import Balls
from terrasim.balls.neighbours import NEIGHBOURS, VISITS, Near, find_near, split
from terrasim.balls.sleep import rejoin, settle, wake
from terrasim.errors import InputError
from terrasim.kernels.ball_pairs import (
    PairRule,
    bounce_balls,
    count_impacts,
    count_overlaps,
    push_balls,
    store_balls,
)
from terrasim.terrain import Terrain

ITERATIONS = 16
"""An impact runs through so many balls in a step, and a pile is pushed apart so many times."""
_REST_STEPS = 2.0


@dataclass(frozen=True)
class Meetings:
    """What :func:`collide` met with."""

    touching: int = 0
    """Pairs that touch."""
    struck: int = 0
    """Pairs of them that approached each other."""
    pushed: int = 0
    """Pairs that overlap and were pushed apart."""
    deepest: float = 0.0
    """Deepest overlap before [m]."""
    left: float = 0.0
    """Deepest overlap left [m]."""
    crowded: int = 0
    """Balls that had more neighbours, or more balls in a bin, than are looked at: the rest of them
    was passed over."""
    fast: int = 0
    """Balls that move by more than their radius in a step, so that they may miss one another."""


def collide(
    terrain: Terrain,
    balls: Balls,
    dt: float,
    *,
    restitution: float = 0.5,
    friction: float = 0.5,
    gravity: float = 9.81,
    iterations: int = ITERATIONS,
    neighbours: int = NEIGHBOURS,
    visits: int = VISITS,
) -> Meetings:
    """Let balls that touch bounce off each other and push those apart that overlap, in place.

    Masses are those of the balls, if they have any, else as the cubes of their radii.

    Args:
        terrain: The terrain they are on.
        balls: The balls, after a step of ``dt``.
        dt: Length of the step [s], above 0.
        restitution: Speed along the line of centres after an impact over that before, 0 to 1.
        friction: Coulomb's coefficient between balls, at least 0.
        gravity: Downward acceleration [m/s^2], at least 0. Balls that approach each other no faster
            than it makes them in two steps do not bounce, so that a pile comes to rest.
        iterations: How often impacts and pushes are repeated, at least 1.
        neighbours: How many balls one can meet, at least 1; costs 4 bytes a ball each.
        visits: How many balls one looks at in each of the nine rows of three bins around it, at
            least 2.

    Returns:
        What was met with.

    Raises:
        InputError: If a number is out of its range.
    """
    _check(dt, restitution, friction, gravity)
    for name, value, least in (
        ("iterations", iterations, 1),
        ("neighbours", neighbours, 1),
        ("visits", visits, 2),
    ):
        if value < least:
            raise InputError(f"{name} must be at least {least}, got {value}")
    if balls.count == 0:
        return Meetings()
    settle(balls)
    rule: Any = PairRule()
    rule.spacing, rule.restitution, rule.friction = terrain.grid.spacing, restitution, friction
    rule.still = _REST_STEPS * gravity * dt
    found = find_near(terrain, balls, neighbours, visits)
    fast = _count_fast(balls, dt)
    velocity, touching, struck = _bounce(terrain, rule, found, iterations)
    shift, pushed, deepest, left = _push(terrain, rule, found, iterations)
    if struck or pushed:
        _store(terrain, balls, [found.sphere, velocity, shift], found.at)
    crowded = int(found.crowded.numpy().sum(dtype=np.int64))
    return Meetings(touching // 2, struck // 2, pushed // 2, deepest, left, crowded, fast)


def _bounce(terrain: Terrain, rule: Any, found: Near, iterations: int) -> tuple[Any, int, int]:
    """Velocities after all impacts, and twice the pairs that touch and that approached."""
    now, then = found.velocity, wp.clone(found.velocity)
    touching, closing = wp.zeros_like(found.listed), wp.zeros_like(found.listed)
    pairs = [rule, found.sphere, found.near, found.listed]
    met = struck = 0
    for iteration in range(iterations):
        split(terrain, count_impacts, [*pairs, now, touching, closing], [found.at])
        if iteration == 0:
            met, struck = _sum(touching), _sum(closing)
        if _none(closing):
            break
        split(terrain, bounce_balls, [*pairs, closing, now, then], [found.at])
        now, then = then, now
    return now, met, struck


def _push(
    terrain: Terrain, rule: Any, found: Near, iterations: int
) -> tuple[Any, int, float, float]:
    """How far balls are pushed; twice the pairs; deepest overlaps before and after [m]."""
    now, then = wp.zeros_like(found.velocity), wp.zeros_like(found.velocity)
    overlaps = wp.zeros_like(found.listed)
    depth = wp.zeros(len(overlaps), dtype=wp.float64, device=terrain.device)
    pairs = [rule, found.sphere, found.near, found.listed]
    split(terrain, count_overlaps, [*pairs, now, overlaps, depth], [found.at])
    pushed, deepest = _sum(overlaps), float(depth.numpy().max())
    for _ in range(iterations):
        if _none(overlaps):
            break
        split(terrain, push_balls, [*pairs, overlaps, now, then], [found.at])
        now, then = then, now
        split(terrain, count_overlaps, [*pairs, now, overlaps, depth], [found.at])
    return now, pushed, deepest, float(depth.numpy().max())


def _store(terrain: Terrain, balls: Balls, found: list[Any], at: Any) -> None:
    """Put balls back and wake those that were struck or pushed."""
    rejoin(balls)
    changed = None
    if balls.awake is not None:
        sphere, velocity, shift = (array.numpy() for array in found)
        number = sphere["number"]
        changed = np.zeros(balls.count, dtype=np.bool_)
        changed[number] = (velocity != balls.velocity.numpy()[number]).any(axis=1)
        changed[number] |= shift.any(axis=1)
    outputs = [balls.cell, balls.offset, balls.z, balls.velocity]
    split(terrain, store_balls, [terrain.grid.spacing, *found, *outputs], [at])
    # The fastest may be faster than any was, and others may be awake.
    balls.reach = None
    if changed is not None:
        wake(balls, changed)


def _none(counts: Any) -> bool:
    """Whether nothing is left to do; on CUDA it costs less to do nothing than to ask."""
    return not counts.device.is_cuda and not counts.numpy().any()


def _sum(counts: Any) -> int:
    return int(counts.numpy().sum(dtype=np.int64))


def _count_fast(balls: Balls, dt: float) -> int:
    """Balls that move by more than their radius in a step."""
    speed = np.sqrt(np.square(balls.velocity.numpy()).sum(axis=1))
    return int((speed * dt > balls.material.numpy()["radius"]).sum())


def _check(dt: float, restitution: float, friction: float, gravity: float) -> None:
    """Refuse numbers out of range."""
    if not (math.isfinite(dt) and dt > 0.0):
        raise InputError(f"dt must be above 0 s and finite, got {dt}")
    if not 0.0 <= restitution <= 1.0:
        raise InputError(f"restitution must be from 0 to 1, got {restitution}")
    for name, value in (("friction", friction), ("gravity", gravity)):
        if not (math.isfinite(value) and value >= 0.0):
            raise InputError(f"{name} must be at least 0 and finite, got {value}")
