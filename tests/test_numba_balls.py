"""The loop that a step of balls is timed against does the same work."""

from __future__ import annotations

import numpy as np
import pytest

import terrasim as ts
from terrasim.balls.balls import Balls, step

DT, GRAVITY = 1.0 / 120.0, 9.81


def test_the_numba_loop_s_balls_end_where_ours_do() -> None:
    """Thrown over hills: impacts, edges, slides, ridges and valleys."""
    pytest.importorskip("numba", reason="numba is not installed")
    from terrasim.bench.numba_balls import balls_loop

    rng = np.random.default_rng(5)
    source = ts.Sine(ts.Grid(300, 300, 1.0), amplitude=6.0, wavelength=20.0)
    place = np.column_stack([rng.uniform(-140, 140, (2_000, 2)), rng.uniform(0, 2, 2_000)])
    with ts.Terrain(source) as terrain:
        balls = Balls.at(
            terrain,
            place,
            rng.normal(0.0, 4.0, (2_000, 3)),
            radius=rng.uniform(0.05, 0.4, 2_000),
            restitution=rng.uniform(0.0, 1.0, 2_000),
            friction=rng.uniform(0.0, 1.0, 2_000),
            anchor=(150, 150),
            above_ground=True,
        )
        lattice, given = terrain.lattice, balls.material.numpy()
        cells = (lattice.spacing, lattice.row, lattice.col, lattice.last_row, lattice.last_col)
        material = np.column_stack([given[one] for one in ("radius", "restitution", "friction")])
        state = [one.numpy().copy() for one in (balls.cell, balls.offset, balls.z, balls.velocity)]
        tally = np.zeros((balls.count, 3), dtype=np.int64)
        loop = balls_loop()
        for _ in range(60):
            step(terrain, balls, DT, gravity=GRAVITY)
            pool, table = terrain.pool.numpy(), terrain.required.numpy()
            loop(pool, table, cells, DT, GRAVITY, material, *state, tally)
        theirs = (state[0][:, ::-1] - 150) * lattice.spacing + state[1]
        ours = balls.positions(terrain, (150, 150))
        # A rounding may send a ball to the other side of a ridge.
        off = np.abs(ours - np.column_stack([theirs, state[2]])).max(axis=1)
        assert np.mean(off < 1e-9) > 0.98
        assert tally[:, 0].sum() == pytest.approx(balls.tally.numpy()["impacts"].sum(), rel=2e-3)
        assert tally[:, 0].sum() > 1_000
