"""The error of a step, by running a sample again at half of it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from terrasim.balls.balls import Balls
from terrasim.balls.half_step import half_step_error
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


def state(balls: Balls) -> bytes:
    """Everything that moves, without the cells."""
    return b"".join(a.numpy().tobytes() for a in (balls.offset, balls.z, balls.velocity))


def test_half_the_step_tells_the_error_of_the_step() -> None:
    """Nothing for flight and bounces; first order for slides that turn; the start is kept."""
    with ground(plane(100, 100, 20_000, 0)) as terrain:
        start = Balls.at(
            terrain,
            [[30.2, 50.1, 1.0], [30.2, 50.1, 0.0]],
            [[3.0, 0.0, 0.0]],
            radius=0.1,
            restitution=1.0,
            friction=[0.0, 0.15],
            above_ground=True,
        )
        before = state(start)
        coarse = half_step_error(terrain, start, 0.02, 50)
        fine = half_step_error(terrain, start, 0.01, 100)
        exact = half_step_error(terrain, start, 0.01, 100, sample=1)
        assert state(start) == before
    assert coarse.balls == 2
    assert exact.balls == 1
    assert exact.largest == pytest.approx(0.0, abs=1e-10)
    assert coarse.largest / fine.largest == pytest.approx(2.0, rel=0.15)
    assert 0.0 < coarse.median < coarse.largest
