"""Clouds of balls, what they weigh and how they move, for the tests of balls against balls."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.balls.balls import Balls
from terrasim.grid import Grid
from terrasim.sources.analytic import Flat
from terrasim.terrain import Terrain

DT = 1e-3
Table = npt.NDArray[np.float64]


def flat(spacing: float = 1.0, threads: int = 1, *, row: int = 0, col: int = 0) -> Terrain:
    return Terrain(Flat(Grid(40, 40, spacing, row=row, col=col)), threads=threads)


def cloud(
    terrain: Terrain, count: int, side: float, radius: tuple[float, float], **options: Any
) -> Balls:
    """Balls at random places and speeds, high above the ground."""
    rng = np.random.default_rng(count)
    place = rng.uniform(0.0, side, (count, 3)) + np.array([5.0, 5.0, 50.0])
    size = rng.uniform(*radius, count)
    return Balls.at(terrain, place, rng.normal(0.0, 3.0, (count, 3)), radius=size, **options)


def masses(balls: Balls) -> Table:
    mass = getattr(balls, "mass", None)
    return np.asarray(balls.material.numpy()["radius"] ** 3 if mass is None else mass.numpy())


def weigh(balls: Balls, mass: npt.ArrayLike) -> None:
    """Give balls masses, as a scene may."""
    values = np.ascontiguousarray(mass, dtype=np.float64)
    given: Any = balls
    given.mass = wp.array(values, dtype=wp.float64, device=balls.cell.device)


def motion(balls: Balls) -> Table:
    """Kinetic energy of each [J]."""
    return np.asarray(0.5 * masses(balls) * np.square(balls.velocity.numpy()).sum(axis=1))


def state(balls: Balls) -> list[npt.NDArray[Any]]:
    """Everything that moves, without the cells."""
    return [array.numpy().copy() for array in (balls.offset, balls.z, balls.velocity)]


def brute(terrain: Terrain, balls: Balls, slack: float) -> npt.NDArray[np.int64]:
    """All pairs apart by at most a part of the sum of their radii."""
    place, radius = balls.positions(terrain), balls.material.numpy()["radius"]
    away = np.linalg.norm(place[:, None] - place[None], axis=2)
    near = away - (radius[:, None] + radius) <= slack * (radius[:, None] + radius)
    return np.argwhere(np.triu(near, 1))
