"""A short flight: every block the path needs is read, and nothing else answers for it."""

from __future__ import annotations

import numpy as np
import pytest

from terrasim.bench.flight import POSTS_PER_STEP, RADIUS, blocks_passed, flight_path, fly
from terrasim.cache.needs import Disc
from terrasim.grid import Grid
from terrasim.sources.array_source import ArraySource
from terrasim.sources.mirror import Mirrored
from terrasim.terrain import Terrain

SIDE = (1 << 13) + 1


@pytest.fixture(scope="module")
def source() -> Mirrored:
    """8,193 posts each way, mirrored from 257."""
    heights = np.random.default_rng(2).normal(0.0, 5.0, (257, 257))
    return Mirrored(ArraySource.from_metres(heights, spacing=1.0), SIDE, SIDE)


def test_the_path_keeps_its_speed_and_stays_a_radius_inside() -> None:
    """Eight posts a step, never nearer to an edge than the need radius, up to the top and back."""
    grid = Grid(SIDE, SIDE, 1.0)
    path = list(flight_path(grid, 2000))
    places = np.array([(agent.row, agent.col) for agent in path])
    np.testing.assert_allclose(np.hypot(*np.diff(places, axis=0).T), POSTS_PER_STEP)
    assert places.min() >= RADIUS
    assert places.max() <= SIDE - 1 - RADIUS
    levels = [agent.need(grid).level for agent in path]
    assert set(levels) == set(range(grid.levels))
    assert levels[-1] == 0


def test_a_flight_reads_what_it_passes_and_evicts_the_rest(source: Mirrored) -> None:
    """With a pool of a quarter, all that is needed is there: no view ever falls back."""
    passed = blocks_passed(source.grid, 120)
    with Terrain(source, pool_bytes=(passed // 4) * 4 * 65536) as terrain:
        report = fly(terrain, steps=120, hz=1e4)
        assert report.fallbacks == 0
        assert report.passed == passed
        assert report.loads >= passed
        assert report.evictions >= report.loads - report.layers
        assert terrain.cache.counters.coarsened == 0


def test_a_disc_higher_up_covers_more_ground_with_as_many_blocks() -> None:
    """The radius is counted in posts of the level."""
    grid = Grid((1 << 16) + 1, (1 << 16) + 1, 1.0)
    counts = [len(Disc(30000.0, 30000.0, 512.0, level).blocks(grid, level)) for level in range(5)]
    assert max(counts) <= 25
    assert min(counts) >= 16
