"""Rays over many blocks: whatever is resident, skipped or of a coarser level, the same ground."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.cache.cache import Cache
from terrasim.counts import HOLE
from terrasim.grid import Block, Grid
from terrasim.kernels.ray_cell import FROM_BELOW
from terrasim.kernels.surface import COARSER
from terrasim.raycast import raycast
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

Table = npt.NDArray[np.float64]


def rough(rows: int, cols: int, grid: Grid | None = None, seed: int = 1) -> ArraySource:
    """Random heights of a few metres."""
    posts = np.random.default_rng(seed).integers(-300_000, 300_000, (rows, cols))
    return ArraySource(posts.astype(np.int32), grid or Grid(rows, cols, 1.5))


def shots(count: int, side: float, seed: int = 2) -> tuple[Table, Table]:
    """Rays in all directions from in, above, below and beside a terrain; many graze it."""
    rng = np.random.default_rng(seed)
    origins = np.column_stack(
        [rng.uniform(-0.3 * side, 1.3 * side, (count, 2)), rng.uniform(-5.0, 12.0, count)]
    )
    directions = rng.normal(0.0, 1.0, (count, 3)) * [1.0, 1.0, 0.3]
    return origins, directions


@pytest.mark.parametrize("level", [0, 1, 2])
def test_the_pool_the_threads_and_what_was_resident_change_no_bit(level: int) -> None:
    """Eight blocks or all of them, one thread or three: the same hits."""
    source = rough(1100, 1100, Grid(1100, 1100, 1.0, row=-500, col=-300))
    origins, directions = shots(1500, 1100.0)
    origins[:, :2] -= [300.0, 500.0]
    directions[:, 2] *= 0.05
    answers = []
    for pool, threads in ((9, 1), (64, 3)):
        with Terrain(source, pool_bytes=pool * 262_144, threads=threads) as terrain:
            answers.append(raycast(terrain, origins, directions, max_distance=1500.0, level=level))
    for name in ("distance", "point", "normal", "error", "level", "state"):
        np.testing.assert_array_equal(getattr(answers[0], name), getattr(answers[1], name))
    assert np.isfinite(answers[0].distance).sum() > 100


def test_without_waiting_the_finest_resident_level_stands_in_and_is_counted() -> None:
    """Nothing but the coarsest level is there at first."""
    with Terrain(rough(1000, 1000, Grid(1000, 1000, 1.0))) as terrain:
        start = np.array([[100.0, 100.0, 50.0]])
        found = raycast(terrain, start, [[1.0, 0.5, -0.5]], max_distance=500.0, wait=False)
        assert found.state[0] == COARSER
        assert found.level[0] == terrain.grid.top
        assert terrain.cache.counters.fallbacks == 1
        exact = raycast(terrain, start, [[1.0, 0.5, -0.5]], max_distance=500.0)
        assert exact.state[0] == 0


def test_a_scene_moved_by_whole_blocks_gives_the_same_bits() -> None:
    """At 2^23 m from the origin, with starts that float64 holds exactly in both places."""
    far = 1 << 23
    origins, directions = shots(800, 300.0)
    origins[:, :2] = np.round(origins[:, :2] * 1024.0) / 1024.0
    found = []
    for moved in (0, far):
        source = rough(300, 300, Grid(300, 300, 1.0, row=moved, col=moved))
        with Terrain(source) as terrain:
            start = origins + np.array([moved, moved, 0.0])
            found.append(raycast(terrain, start, directions, max_distance=400.0))
    np.testing.assert_array_equal(found[0].distance, found[1].distance)


def test_leaping_over_blocks_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """Low and high blocks, peaks and a hole among them: as if every cell had been walked."""
    posts = np.random.default_rng(9).integers(0, 100_000, (700, 700)).astype(np.int32)
    posts[400::37, ::41] = 2_000_000
    posts[300:420, 200:420] += 1_000_000
    posts[500:520, 500:520] = HOLE
    source = ArraySource(posts, Grid(700, 700, 1.0, row=-350, col=-350))
    origins, directions = shots(4000, 700.0)
    origins += [-350.0, -350.0, 15.0]
    directions[:, 2] = -0.6 * np.abs(directions[:, 2])
    with Terrain(source) as terrain:
        found = raycast(terrain, origins, directions, max_distance=900.0)
        told = []
        for highest in (2**31 - 1, HOLE):
            assumed = np.full(terrain.cache.pool.layers, highest, dtype=np.int32)
            monkeypatch.setattr(Cache, "highest", assumed)
            told.append(raycast(terrain, origins, directions, max_distance=900.0))
    walked, leapt = told
    hits = np.isfinite(walked.distance).sum()
    assert 1000 < hits < 3900
    # What is told of the blocks is used: a lie about them is followed.
    assert np.count_nonzero(leapt.distance != walked.distance) > 0.5 * hits
    for name in ("distance", "point", "normal", "state"):
        np.testing.assert_array_equal(getattr(found, name), getattr(walked, name))


@pytest.mark.parametrize(("side_of_start", "expected"), [(1.0, 0), (-1.0, FROM_BELOW)])
def test_no_ray_slips_between_two_levels(side_of_start: float, expected: int) -> None:
    """Where a fine block lies beside a coarse one the gap between them counts as ground."""
    source = rough(1100, 1100, Grid(1100, 1100, 1.0))
    rng = np.random.default_rng(10)
    count = 20_000
    # In a slant that crosses the border of the one fine block, at rows or columns 255 to 257.
    side = rng.uniform(250.0, 262.0, count)
    other = rng.uniform(260.0, 500.0, count)
    swap = rng.random(count) < 0.5
    origins = np.column_stack(
        [
            np.where(swap, side, other),
            np.where(swap, other, side),
            np.full(count, 10.0 * side_of_start),
        ]
    )
    directions = rng.normal(0.0, 1.0, (count, 3))
    directions[:, 2] = -1.5 * side_of_start
    with Terrain(source) as terrain:
        terrain.cache.hold([Block(0, 1, 1)])
        found = raycast(terrain, origins, directions, max_distance=40.0, wait=False)
    assert set(found.level) == {0, terrain.grid.top}
    assert set(found.state & ~np.uint8(COARSER)) == {expected}


def test_a_small_pool_reads_each_block_a_few_times_only() -> None:
    """Rays that wait for the same block go on together."""
    source = rough(2100, 2100, Grid(2100, 2100, 1.0))
    origins, directions = shots(3000, 2100.0)
    origins[:, 2] = 40.0
    directions[:, 2] = -0.05
    with Terrain(source, pool_bytes=20 * 262_144) as terrain:
        raycast(terrain, origins, directions, max_distance=1000.0)
        assert terrain.cache.counters.loads < 20 * 81


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("forth", [True, False])
def test_a_leap_ends_before_posts_of_other_blocks(axis: int, forth: bool) -> None:
    """Low blocks on one side, high ones on the other: the slope between them is met half-way."""
    heights = np.zeros((600, 600))
    # The slope lies in the cells between posts 255 and 256.
    heights[256:] = 10.0
    heights = heights if forth else 10.0 - heights
    heights = heights.T if axis == 0 else heights
    way = np.zeros((1, 3))
    way[0, axis] = 1.0 if forth else -1.0
    start = np.full((1, 3), 100.0 if forth else 500.0)
    start[0, 2] = 5.0
    with Terrain(ArraySource.from_metres(heights, spacing=1.0)) as terrain:
        found = raycast(terrain, start, way, max_distance=500.0)
    assert found.point[0, axis] == 255.5
    assert found.distance[0] == abs(255.5 - start[0, axis])


def test_the_gap_between_two_levels_is_a_wall() -> None:
    """A ray that has leapt over a fine block meets the coarse ground's end beside it."""
    heights = np.zeros((600, 600))
    heights[:, 256:] = 8.0
    with Terrain(ArraySource.from_metres(heights, spacing=1.0)) as terrain:
        coarse = 1 << terrain.grid.top
        terrain.cache.hold([Block(0, 0, 0)])
        found = raycast(
            terrain, [[100.0, 100.0, 1.5]], [[1.0, 0.0, 0.0]], max_distance=500.0, wait=False
        )
    # The fine block's own cells end at post 255; the coarse slope is at 6 m there or higher.
    assert coarse == 4
    assert found.distance[0] == 155.0
    assert found.state[0] == COARSER
