"""A short flight: every block the path needs is read, and nothing else answers for it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from terrasim.bench.flight import POSTS_PER_STEP, RADIUS, blocks_passed, flight_path, fly
from terrasim.cache.needs import Disc
from terrasim.dem.import_options import ImportOptions
from terrasim.dem.imports import import_terrain
from terrasim.grid import Grid
from terrasim.query import sample
from terrasim.sources.array_source import ArraySource
from terrasim.sources.mirror import Mirrored
from terrasim.store.store import open_store
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


def test_the_papers_terrain_is_flown_over(shared_terrain: Path, tmp_path: Path) -> None:
    """Puget Sound at 1k, from a store, mirrored to 1M x 1M posts: all that is needed is there."""
    store = tmp_path / "puget.terrasim"
    options = ImportOptions(spacing=160.0, z_scale=0.1)
    import_terrain([str(shared_terrain / "ps_height_1k.png")], str(store), options)
    side = (1 << 20) + 1
    with (
        open_store(store) as puget,
        Terrain(Mirrored(puget, side, side), pool_bytes=256 << 20) as terrain,
    ):
        report = fly(terrain, steps=60, hz=1e4)
        # Rainier is row 529 from the north, column 803; every other copy is not reflected.
        copies = 1024 * np.array([[0, 0], [2, 0], [500, 498]])
        peaks = sample(terrain, 160.0 * (copies + np.array([803, 1024 - 529]))).height
    assert report.fallbacks == 0
    assert report.loads >= report.passed
    np.testing.assert_allclose(peaks, 4379.8, rtol=0.0, atol=1e-9)


def test_a_disc_higher_up_covers_more_ground_with_as_many_blocks() -> None:
    """The radius is counted in posts of the level."""
    grid = Grid((1 << 16) + 1, (1 << 16) + 1, 1.0)
    counts = [len(Disc(30000.0, 30000.0, 512.0, level).blocks(grid, level)) for level in range(5)]
    assert max(counts) <= 25
    assert min(counts) >= 16
