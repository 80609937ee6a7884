"""Heights, normals, levels and error bounds that queries answer with."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

import terrasim as ts
from terrasim.cache.pool import BLOCK_BYTES
from terrasim.counts import HOLE, Counts
from terrasim.errors import InputError
from terrasim.grid import Block, Grid
from terrasim.kernels.addressing import BLOCK
from terrasim.kernels.surface import COARSER, IN_HOLE, OFF_TERRAIN

Metres = npt.NDArray[np.float64]

GRID = Grid(1100, 900, 0.5, x=-3e5, y=4e6, row=-300, col=200, datum=-77.0)


def rough(rows: int, cols: int, seed: int = 0) -> Counts:
    """Smooth hills of 100 m with noise of 1 m."""
    y, x = np.mgrid[0:rows, 0:cols] / 60.0
    noise = np.random.default_rng(seed).normal(0, 1e5, (rows, cols))
    posts: Counts = np.rint(1e7 * np.sin(x) * np.cos(y) + noise).astype(np.int32)
    return posts


def places(grid: Grid, count: int, seed: int, beyond: float = 0.0) -> Metres:
    """Random world points on a terrain, and around it if told so [share of its size]."""
    random = np.random.default_rng(seed)
    share = random.uniform(-beyond, 1.0 + beyond, (count, 2))
    col = grid.col + share[:, 0] * (grid.cols - 1)
    row = grid.row + share[:, 1] * (grid.rows - 1)
    return np.column_stack([grid.x + col * grid.spacing, grid.y + row * grid.spacing])


def small(corners: list[list[int]]) -> ts.ArraySource:
    """A few posts at 1 m, heights given in counts by row from the south."""
    posts = np.array(corners, dtype=np.int32)
    return ts.ArraySource(posts, Grid(posts.shape[0], posts.shape[1], 1.0))


@pytest.fixture(scope="module")
def source() -> ts.ArraySource:
    return ts.ArraySource(rough(GRID.rows, GRID.cols), GRID)


@pytest.fixture
def terrain(source: ts.ArraySource) -> Iterator[ts.Terrain]:
    with ts.Terrain(source) as terrain:
        yield terrain


def test_a_normal_is_at_right_angles_to_its_triangle(terrain: ts.Terrain) -> None:
    """A little step along each axis rises as the normal says."""
    points = places(GRID, 2000, 1)
    for level in range(GRID.levels):
        found = ts.sample_all(terrain, points, level=level)
        assert np.allclose(np.linalg.norm(found.normal, axis=1), 1.0, rtol=0, atol=4e-16)
        for axis in (0, 1):
            step = np.zeros(2)
            step[axis] = 1e-5
            after = ts.sample_all(terrain, points + step, level=level)
            same = (after.normal == found.normal).all(axis=1)
            assert same.mean() > 0.99
            rise = (after.height - found.height)[same] / 1e-5
            slope = -found.normal[same, axis] / found.normal[same, 2]
            np.testing.assert_allclose(rise, slope, rtol=0, atol=1e-3)


def test_a_level_passes_through_its_posts(terrain: ts.Terrain, source: ts.ArraySource) -> None:
    for level in range(GRID.levels):
        span = GRID.posts(level)
        rows, cols = (
            np.arange(span.row0 + 1, span.row1 - 1),
            np.arange(span.col0 + 1, span.col1 - 1),
        )
        x, y = np.meshgrid(GRID.post_x(cols << level), GRID.post_y(rows << level))
        found = ts.sample(terrain, np.column_stack([x.ravel(), y.ravel()]), level=level)
        posts = source.posts(level, rows, cols).ravel()
        assert np.array_equal(found.height, GRID.datum + posts * 1e-5)
        assert not found.state.any()


def test_the_error_bound_of_a_level_is_never_exceeded(terrain: ts.Terrain) -> None:
    points = places(GRID, 100_000, 2, beyond=0.02)
    truth = ts.sample(terrain, points).height
    for level in range(GRID.levels):
        found = ts.sample_all(terrain, points, level=level)
        away = np.abs(found.height - truth)
        assert (away <= found.error + 1e-9).all()
        assert found.error.max() < 30.0
        assert level == 0 or away.max() > found.error.max() / 2
    assert not ts.sample_all(terrain, points).error.any()


@pytest.mark.parametrize("level", range(GRID.levels))
@pytest.mark.parametrize("threads", [2, 3])
def test_any_number_of_threads_answers_with_the_same_bits(
    terrain: ts.Terrain, source: ts.ArraySource, threads: int, level: int
) -> None:
    points = places(GRID, 20_011, 3, beyond=0.1)
    with ts.Terrain(source, threads=threads) as split:
        for call in (ts.sample, ts.sample_all):
            one, many = call(terrain, points, level=level), call(split, points, level=level)
            for name, values in vars(one).items():
                assert values.tobytes() == getattr(many, name).tobytes(), name


def test_both_queries_answer_with_the_same_bits_whatever_was_resident(
    source: ts.ArraySource,
) -> None:
    """Left of index zero the sum of a fraction and a whole number may round."""
    grid = Grid(900, 900, 1.0, row=-450, col=-450)
    posts = np.random.default_rng(5).integers(-(10**8), 10**8, (900, 900), dtype=np.int32)
    points = np.concatenate([places(grid, 5000, 4), places(grid, 5000, 4) * 1e-2 - 1.0])
    with ts.Terrain(ts.ArraySource(posts, grid), pool_bytes=8 * BLOCK_BYTES) as terrain:
        for level in range(grid.levels):
            cold = ts.sample(terrain, points, level=level)
            for _ in range(2):
                warm = ts.sample(terrain, points, level=level)
                assert warm.height.tobytes() == cold.height.tobytes()
            full = ts.sample_all(terrain, points, level=level)
            assert full.height.tobytes() == cold.height.tobytes()
            assert np.array_equal(full.state, cold.state)


# Off the terrain, in holes, not resident


def test_beyond_the_edge_the_nearest_edge_point_answers_and_is_counted(
    terrain: ts.Terrain,
) -> None:
    east, north = (
        GRID.x + (GRID.col + GRID.cols - 1) * 0.5,
        GRID.y + (GRID.row + GRID.rows - 1) * 0.5,
    )
    west, south = GRID.x + GRID.col * 0.5, GRID.y + GRID.row * 0.5
    outside = places(GRID, 5000, 8, beyond=3.0)
    outside[:6] = [
        [1e300, north - 3.7],
        [-1e300, -1e300],
        [west - 1e-9, south],
        [west, np.nextafter(north, np.inf)],
        [np.nextafter(east, np.inf), south + 1.0],
        [west + 9.0, np.nextafter(south, -np.inf)],
    ]
    moved = np.column_stack(
        [np.clip(outside[:, 0], west, east), np.clip(outside[:, 1], south, north)]
    )
    off = (moved != outside).any(axis=1)
    assert off[:6].all()
    for level in range(GRID.levels):
        before = terrain.cache.counters.off_terrain
        found, edge = (ts.sample_all(terrain, p, level=level) for p in (outside, moved))
        assert np.array_equal(found.state, np.where(off, OFF_TERRAIN, 0))
        assert not edge.state.any()
        for name in ("height", "normal", "slope", "level", "error"):
            assert np.array_equal(getattr(found, name), getattr(edge, name)), name
        assert terrain.cache.counters.off_terrain - before == np.count_nonzero(off)


def test_the_last_post_belongs_to_the_terrain(terrain: ts.Terrain, source: ts.ArraySource) -> None:
    row, col = GRID.row + GRID.rows - 1, GRID.col + GRID.cols - 1
    found = ts.sample(terrain, [[GRID.x + col * 0.5, GRID.y + row * 0.5]])
    assert found.state.tolist() == [0]
    post = source.posts(0, np.array([row]), np.array([col]))
    assert found.height.tolist() == [GRID.datum + post[0, 0] * 1e-5]


def test_a_triangle_with_a_hole_has_no_height_and_is_counted() -> None:
    with ts.Terrain(small([[0, HOLE, 0], [0, 0, 0], [0, 0, HOLE]])) as terrain:
        points = [
            [0.7, 0.2],
            [0.2, 0.7],
            [1.2, 0.7],
            [1.7, 0.2],
            [1.2, 1.7],
            [0.5, 1.5],
            [9.0, 9.0],
        ]
        hole = [True, False, True, True, True, False, True]
        found = ts.sample_all(terrain, points)
        assert np.isnan(found.height).tolist() == hole
        assert found.height[1] == found.height[5] == 0.0
        state = [2, 0, 2, 2, 2, 0, 2 + OFF_TERRAIN]
        assert found.state.tolist() == state
        assert found.normal.tolist() == [[0.0, 0.0, 1.0]] * 7
        assert found.slope.tolist() == [0.0] * 7
        assert terrain.cache.counters.in_hole == 5
        assert terrain.cache.counters.off_terrain == 1
        short = ts.sample(terrain, points)
        assert np.array_equal(short.height, found.height, equal_nan=True)
        assert short.state.tolist() == state
    assert IN_HOLE == 2


def finest_resident(terrain: ts.Terrain, points: Metres, level: int) -> npt.NDArray[np.int64]:
    """The level that should answer: the finest with all three posts of the triangle resident."""
    grid = terrain.grid
    place = ((points - (grid.x, grid.y)) / grid.spacing)[:, ::-1]
    answer = np.full(len(points), grid.top)
    for up in range(grid.top - 1, level - 1, -1):
        scaled = place / 2.0**up
        cell = np.floor(scaled).astype(np.int64)
        v, u = (scaled - cell).T
        right = (u >= v)[:, None]
        mid = cell + np.where(right, [0, 1], [1, 0])
        for i, posts in enumerate(np.stack([cell, mid, cell + 1], axis=1) // BLOCK):
            if all(terrain.cache.is_resident(Block(up, int(r), int(c))) for r, c in posts):
                answer[i] = up
    return answer


def test_without_waiting_the_finest_resident_ancestor_answers(source: ts.ArraySource) -> None:
    points = places(GRID, 4000, 9)
    with ts.Terrain(source) as whole, ts.Terrain(source) as terrain:
        cache = terrain.cache
        fine = [Block(0, 0, 1), Block(0, 0, 2), Block(0, -1, 3), Block(0, 2, 4)]
        cache.hold([*fine, Block(1, 0, 0), Block(1, 0, 1), Block(1, -1, 1), Block(2, 0, 0)])
        loads = cache.counters.loads
        for level in range(GRID.levels):
            before = cache.counters.fallbacks
            found = ts.sample_all(terrain, points, level=level, wait=False)
            expected = finest_resident(terrain, points, level)
            assert np.array_equal(found.level, expected)
            coarser = expected > level
            assert np.array_equal(found.state, np.where(coarser, COARSER, 0))
            assert cache.counters.fallbacks - before == np.count_nonzero(coarser)
            truth = ts.sample(whole, points).height
            assert (np.abs(found.height - truth) <= found.error + 1e-9).all()
            for up in set(expected.tolist()):
                there = expected == up
                asked = ts.sample(whole, points[there], level=up).height
                assert np.array_equal(found.height[there], asked)
            short = ts.sample(terrain, points, level=level, wait=False)
            assert short.height.tobytes() == found.height.tobytes()
            if level == 0:
                worst = found.error[coarser].max()
                assert cache.counters.fallback_error * 1e-5 == pytest.approx(worst, rel=1e-12)
                assert set(expected.tolist()) == {0, 1, 2, 3}
        assert cache.counters.loads == loads


def test_a_triangle_with_any_post_missing_falls_back(source: ts.ArraySource) -> None:
    """Where four blocks meet, each of them holds one post of the cell."""
    near, east, north, far = [Block(0, r, c) for r in (0, 1) for c in (1, 2)]
    x, y = GRID.x + 511.0 * 0.5, GRID.y + 255.0 * 0.5
    points = [[x + 0.4, y + 0.1], [x + 0.1, y + 0.4]]
    for missing, levels in ((near, [1, 1]), (far, [1, 1]), (east, [1, 0]), (north, [0, 1])):
        with ts.Terrain(source) as terrain:
            terrain.cache.hold({near, east, north, far} - {missing})
            terrain.cache.hold([Block(1, 0, 0), Block(1, 0, 1)])
            assert ts.sample_all(terrain, points, wait=False).level.tolist() == levels


def test_waiting_never_falls_back_even_for_more_blocks_than_the_pool_holds(
    source: ts.ArraySource,
) -> None:
    points = places(GRID, 30_000, 10, beyond=0.05)
    with ts.Terrain(source) as whole, ts.Terrain(source, pool_bytes=8 * BLOCK_BYTES) as terrain:
        for level in (0, 1, 0):
            found = ts.sample_all(terrain, points, level=level)
            expected = ts.sample_all(whole, points, level=level)
            for name, values in vars(expected).items():
                assert values.tobytes() == getattr(found, name).tobytes(), name
        assert terrain.cache.counters.evictions > 20
        assert terrain.cache.counters.fallbacks == 0
        assert terrain.cache.counters.fallback_error == 0


# Bad input


@pytest.mark.parametrize("call", [ts.sample, ts.sample_all])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_point_that_is_nowhere_is_refused_by_name(
    terrain: ts.Terrain, call: Any, bad: float, axis: int
) -> None:
    points = places(GRID, 3000, 11)
    points[1234, axis] = bad
    points[2345] = bad
    with pytest.raises(InputError, match=rf"points\[1234\] must be finite, got \(.*{bad}"):
        call(terrain, points)
    with pytest.raises(InputError, match=r"points\[0\] must be finite"):
        call(terrain, wp.array(points[1234:1235], dtype=wp.vec2d, device="cpu"), wait=False)
    assert ts.sample(terrain, places(GRID, 10, 1)).state.tolist() == [0] * 10


@pytest.mark.parametrize("level", [-1, GRID.levels, 99])
def test_a_level_that_is_not_there_is_refused(terrain: ts.Terrain, level: int) -> None:
    rule = f"level must be 0 to {GRID.top} on this terrain, got {level}"
    for call in (ts.sample, ts.sample_all):
        with pytest.raises(InputError, match=rule):
            call(terrain, [[0.0, 0.0]], level=level)


def test_an_unknown_device_and_too_few_threads_are_refused(source: ts.ArraySource) -> None:
    with pytest.raises(InputError, match=r"no device 'cuda:77': this machine has .*cpu"):
        ts.Terrain(source, device="cuda:77")
    with pytest.raises(InputError, match="threads and loaders must be at least 1, got 0, 2"):
        ts.Terrain(source, threads=0)
    with pytest.raises(InputError, match="threads and loaders must be at least 1, got 1, 0"):
        ts.Terrain(source, loaders=0)
