"""What a run is made of, each part by itself: paths, times, windows, hashes, estimates."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from terrasim.cache.counters import Counters
from terrasim.deform.stamps import Crater
from terrasim.grid import Grid, Span
from terrasim.output.window import level_window, read_window
from terrasim.scenario.actors import AgentPath
from terrasim.scenario.agent_path import agent_at, along
from terrasim.scenario.estimate import level_errors, most_overlapping, rounding_error
from terrasim.scenario.fingerprint import hash_arrays
from terrasim.scenario.stages import StageTimer
from terrasim.sources.analytic import Sine
from terrasim.terrain import Terrain

GRID = Grid(1200, 1000, spacing=0.5)


def test_an_agent_follows_its_path_and_stays_at_its_end() -> None:
    path = ((0.0, 0.0), (30.0, 40.0), (30.0, 0.0))
    assert along(path, 25.0) == ((15.0, 20.0), (0.6, 0.8))
    assert along(path, 60.0) == ((30.0, 30.0), (0.0, -1.0))
    assert along(path, 1e9) == ((30.0, 0.0), (0.0, 0.0))
    one = AgentPath(path=path, speed_m_s=5.0, radius=9.0, level=2)
    agent = agent_at(one, 5.0, 0.1, (1000, -500), 0.5)
    assert (agent.row, agent.col) == (1040.0, -470.0)
    assert (agent.rows_per_step, agent.cols_per_step) == pytest.approx((0.8, 0.6))
    assert int(agent.height) == 2


def test_stages_within_stages_count_for_themselves() -> None:
    timer = StageTimer()
    with timer.stage("outer"):
        time.sleep(0.02)
        with timer.stage("inner"):
            time.sleep(0.02)
        with timer.stage("inner"):
            pass
    outer, inner = timer.stages
    assert (outer.name, outer.times) == ("outer", 1)
    assert (inner.name, inner.times) == ("inner", 2)
    assert outer.wall_s >= 0.02
    assert inner.wall_s >= 0.02
    assert timer.wall_s("outer") == outer.wall_s
    assert timer.wall_s("none") == 0.0


def test_a_window_is_cut_from_whatever_blocks_it_lies_in() -> None:
    source = Sine(GRID, amplitude=4.0, wavelength=64.0, wavelength_y=64.0)
    with Terrain(source, pool_bytes=8 << 18) as terrain:
        for level in range(terrain.grid.levels):
            window = Span(200 >> level, 900 >> level, 100 >> level, 700 >> level)
            rows = np.arange(window.row0, window.row1)
            cols = np.arange(window.col0, window.col1)
            found = read_window(terrain, level, window)
            np.testing.assert_array_equal(found, source.posts(level, rows, cols))
        beyond = read_window(terrain, 0, Span(-3, 2, 998, 1005))
        np.testing.assert_array_equal(beyond[0], beyond[3])
        np.testing.assert_array_equal(beyond[:, 1], beyond[:, 6])


def test_a_level_s_window_covers_its_cells() -> None:
    grid = GRID
    assert level_window(grid, 2, Span(5, 9, 4, 8)) == Span(1, 4, 1, 3)
    assert level_window(grid, 0, Span(-50, 3, 990, 2000)) == Span(0, 4, 990, 1000)


def test_a_hash_sees_types_and_shapes() -> None:
    a = np.zeros(4)
    assert hash_arrays(a) == hash_arrays(a.copy())
    assert hash_arrays(a) != hash_arrays(a.reshape(2, 2))
    assert hash_arrays(a) != hash_arrays(a.astype(np.int64))


def test_errors_of_levels_are_those_the_cache_counted() -> None:
    counters = replace(Counters(), coarsened=3, coarsened_error=250, fallbacks=2, fallback_error=9)
    contact, queries = level_errors(counters)
    assert contact.metres == pytest.approx(2.5e-3)
    assert queries.metres == pytest.approx(9e-5)


def test_rounding_counts_the_stamps_that_may_meet() -> None:
    def crater(x: float, y: float) -> Crater:
        return Crater(x, y, 1.0, 0.2)

    assert most_overlapping([]) == 0
    assert most_overlapping([crater(0, 0)]) == 1
    assert most_overlapping([crater(100.0 * i, 0) for i in range(9)]) == 1
    assert most_overlapping([crater(0.1 * i, 0) for i in range(9)] + [crater(500, 500)]) == 9
    assert rounding_error([crater(0, 0)]).metres == pytest.approx(1e-5)
