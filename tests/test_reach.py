"""The ground that balls may touch in the coming steps."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from terrasim.balls.balls import Balls, reach, step, totals
from terrasim.counts import Counts
from terrasim.grid import Grid
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

G = 9.81


def ground(posts: Counts, spacing: float = 1.0, **options: Any) -> Terrain:
    return Terrain(ArraySource(posts, Grid(posts.shape[0], posts.shape[1], spacing)), **options)


def plane(rows: int, cols: int, per_row: int = 0, per_col: int = 0) -> Counts:
    """A plane that is exact in counts."""
    row, col = np.mgrid[0:rows, 0:cols]
    heights: Counts = (row * per_row + col * per_col).astype(np.int32)
    return heights


def run(terrain: Terrain, balls: Balls, dt: float, steps: int, gravity: float = G) -> None:
    for _ in range(steps):
        step(terrain, balls, dt, gravity=gravity)


def test_the_same_blocks_serve_many_steps() -> None:
    """Slow balls are looked up again only after they may have left their ground."""
    with ground(plane(600, 600)) as terrain:
        balls = Balls.at(terrain, [[255.0, 100.0, 0.0]], [[1.0, 0, 0]], radius=0.1, friction=0.0)
        boxes = reach(terrain, balls, 0.01)
        assert sorted(boxes.col0.tolist()) == [0, 256]
        assert reach(terrain, balls, 0.01) is boxes
        run(terrain, balls, 0.01, 600)
        assert sorted(reach(terrain, balls, 0.01).col0.tolist()) == [256]
        assert totals(balls).coarse == 0


def test_a_reach_grows_with_what_gravity_adds() -> None:
    """Speed by g dt a step, and the room shrinks by the way at that speed."""
    with ground(plane(60, 60)) as terrain:
        balls = Balls.at(terrain, [[30.0, 30.0, 9.0]], [[0.0, 3.0, 4.0]], radius=0.1)
        for _ in range(3):
            reach(terrain, balls, 0.01, gravity=10.0)
        assert balls.reach is not None
        assert balls.reach.speed == pytest.approx(5.3)
        assert balls.reach.room == pytest.approx(2.0 - (5.1 + 5.2 + 5.3) * 0.01)
