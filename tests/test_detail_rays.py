"""Rays over base and detail: as over a grid that is simply finer, through every seam."""

from __future__ import annotations

import numpy as np
import pytest
from detail_oracle import NO_GROUND, Fine, Real, Whole, block_of, cut, put, rough

from terrasim.counts import HOLE, MAX_COUNT, Counts
from terrasim.grid import Block, Grid
from terrasim.kernels.ray_cell import FROM_BELOW, MISSED
from terrasim.query import sample_all
from terrasim.raycast import RayHits, raycast
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

SPACING = 1.5
GRID = Grid(12, 10, SPACING, row=-5, col=-3)
"""Four blocks meet at post (0, 0), which is detail post (256, 256) times the factor."""


def base_posts(holes: bool) -> Counts:
    posts = rough(12, 10, 5)
    if holes:
        posts[4, 2] = posts[9, 7] = HOLE
    return posts


def differences(factor: int) -> Counts:
    """Rough in a part that takes in the blocks' corner, and zero round it up to the edge."""
    detail = np.zeros((11 * factor + 1, 9 * factor + 1), np.int32)
    part = detail[2 * factor + 1 : 8 * factor, factor : 7 * factor - 1]
    # As steep as it is wide, whatever the factor.
    part[...] = rough(part.shape[0], part.shape[1], 6, 20_000)
    return detail


def blocks_of(factor: int, quadrant: int | None = None) -> dict[Block, Counts]:
    """Those differences as blocks, of all quadrants round the corner or one; none all zero."""
    cells = cut((251 * factor, 253 * factor), differences(factor))
    corner = 256 * factor >> 8
    return {
        key: posts
        for key, posts in cells.items()
        if posts.any() and quadrant in {None, (key.row >= corner) * 2 + (key.col >= corner)}
    }


def shots(grid: Grid, count: int, seed: int) -> tuple[Real, Real]:
    """Rays in all directions from in, above, below and beside a terrain; many graze it."""
    rng = np.random.default_rng(seed)
    west, south = grid.col * grid.spacing, grid.row * grid.spacing
    wide, high = (grid.cols - 1) * grid.spacing, (grid.rows - 1) * grid.spacing
    origins = np.column_stack(
        [
            rng.uniform(west - 3.0, west + wide + 3.0, count),
            rng.uniform(south - 3.0, south + high + 3.0, count),
            rng.uniform(-2.0, 5.0, count),
        ]
    )
    return origins, rng.normal(size=(count, 3)) * [1.0, 1.0, 0.3]


def over_finer_grid(fine: Fine, origins: Real, ways: Real) -> RayHits:
    """The same rays over the totals as plain posts, everything ``factor`` times as large."""
    factor = fine.factor
    row, col = np.mgrid[0 : 11 * factor + 1, 0 : 9 * factor + 1]
    total = fine.total(row + 251 * factor, col + 253 * factor)
    plain = np.where(total == NO_GROUND, HOLE, total).astype(np.int32)
    shift = np.array([GRID.col, GRID.row, 0.0]) * SPACING
    with Terrain(ArraySource(plain, Grid(plain.shape[0], plain.shape[1], SPACING))) as terrain:
        return raycast(terrain, (origins - shift) * factor, ways, max_distance=40.0 * factor)


def check_against_finer_grid(factor: int, posts: Counts, blocks: dict[Block, Counts]) -> None:
    """Hold that rays hit what they hit where the totals are plain posts."""
    origins, ways = shots(GRID, 4000, factor)
    with Terrain(ArraySource(posts, GRID), detail_factor=factor) as terrain:
        put(terrain, blocks)
        found = raycast(terrain, origins, ways, max_distance=40.0)
        ends = found.state & MISSED == 0
        there = sample_all(terrain, found.point[ends][:, :2])
    expected = over_finer_grid(Fine(GRID, posts, factor, blocks), origins, ways)
    np.testing.assert_array_equal(found.state, expected.state)
    assert 500 < ends.sum() < 3500
    assert (found.state[ends] == FROM_BELOW).sum() > 100
    # A ray nearly along a triangle meets it where rounding says: few do.
    slant = np.abs(np.einsum("ij,ij->i", ways, found.normal))[ends]
    slant /= np.linalg.norm(ways[ends], axis=1)
    away = np.abs(found.distance[ends] - expected.distance[ends] / factor)
    assert (away * slant < 1e-12).all()
    off = np.abs(found.normal[ends] - expected.normal[ends]).max(axis=1)
    assert (off < 1e-12).mean() > 0.999
    np.testing.assert_allclose(found.point[ends][:, 2], there.height, rtol=0, atol=2e-11)
    assert (found.error[ends] == 0.0).all()
    assert (found.level[ends] == 0).all()


@pytest.mark.parametrize("holes", [False, True])
@pytest.mark.parametrize("factor", [2, 3, 7, 64])
def test_rays_hit_what_they_hit_on_a_grid_that_is_finer(factor: int, holes: bool) -> None:
    check_against_finer_grid(factor, base_posts(holes), blocks_of(factor))


@pytest.mark.parametrize("quadrant", range(4))
@pytest.mark.parametrize("factor", [3, 64])
def test_detail_up_to_a_blocks_first_posts_is_met_from_the_blocks_next_to_it(
    factor: int, quadrant: int
) -> None:
    """Cells there have no detail but on their last edges."""
    check_against_finer_grid(factor, base_posts(False), blocks_of(factor, quadrant))


def test_rays_through_detail_of_1024_cross_no_ground_before_they_hit() -> None:
    """Every detail cell is 1.5 mm: 20,000 places along each ray, by the finer grid's triangles."""
    factor = 1024
    grid = Grid(3, 3, SPACING, row=-1, col=-1)
    posts = rough(3, 3, 5, 20_000)
    first = 256 * factor
    bumps = {
        Block(-1, (first >> 8) + row, (first >> 8) + col): block_of(
            row * 3 + col + 9, 1000 * factor
        )
        for row, col in ((-1, -1), (-1, 0), (0, 0), (0, 2), (-3, 1))
    }
    fine = Fine(grid, posts, factor, bumps)
    origins, ways = shots(grid, 120, 3)
    origins[:80] = np.random.default_rng(4).uniform(-0.4, 0.4, (80, 3))
    ways[:80, 2] = -5.0 * np.abs(ways[:80, 2]) * np.sign(origins[:80, 2])
    with Terrain(ArraySource(posts, grid), detail_factor=factor) as terrain:
        put(terrain, bumps)
        found = raycast(terrain, origins, ways, max_distance=5.0)
    unit = ways / np.linalg.norm(ways, axis=1)[:, None]
    seen = 0
    for n in range(len(ways)):
        along = np.linspace(0.0, min(found.distance[n], 5.0), 20_000)
        at = origins[n] + along[:, None] * unit[n]
        over = (np.abs(at[:, :2]) <= SPACING).all(axis=1)
        if not over.any():
            continue
        height, _ = fine.heights(at[over, 0], at[over, 1])
        # Places next to the hit may be on either side by rounding.
        clear = (at[over, 2] - height)[5:-5]
        assert (clear > 0.0).all() or (clear < 0.0).all(), n
        if np.isfinite(found.distance[n]):
            last, _ = fine.heights(found.point[n : n + 1, 0], found.point[n : n + 1, 1])
            assert abs(last[0] - found.point[n, 2]) < 1e-9
            seen += bool(fine.difference(*places(fine, found.point[n])).any())
    assert seen > 20


def places(fine: Fine, point: Real) -> tuple[Whole, Whole]:
    """Detail posts round a place."""
    col = int((point[0] / SPACING - fine.col0) * fine.factor)
    row = int((point[1] / SPACING - fine.row0) * fine.factor)
    return np.array([row, row + 1, row, row + 1]), np.array([col, col, col + 1, col + 1])


@pytest.mark.parametrize("factor", [2, 3, 8])
def test_nothing_slips_through_a_seam(factor: int) -> None:
    """Rays from above all ground to below it, aimed at posts, edges and corners of both grids."""
    rng = np.random.default_rng(factor)
    rows, cols = rng.integers(1, 11 * factor, 4000), rng.integers(1, 9 * factor, 4000)
    target = np.column_stack([cols / factor + GRID.col, rows / factor + GRID.row]) * SPACING
    along = rng.integers(-3, 4, (4000, 2)) * SPACING / factor
    start = np.clip(target - along, [-4.5, -7.5], [9.0, 9.0])
    origins = np.column_stack([start, np.full(4000, 3.0)])
    ways = np.column_stack([target - start, np.full(4000, -3.0 - rng.random(4000))])
    with Terrain(ArraySource(base_posts(False), GRID), detail_factor=factor) as terrain:
        put(terrain, blocks_of(factor))
        up = np.column_stack([origins[:, :2], -origins[:, 2]]), ways * [1.0, 1.0, -1.0]
        for sent, state in (((origins, ways), 0), (up, FROM_BELOW)):
            steep = sent[1] * [0.1, 0.1, 1.0]
            found = raycast(terrain, sent[0], steep, max_distance=20.0)
            assert (found.state == state).all()


@pytest.mark.parametrize("factor", [3, 48])
def test_a_ray_that_comes_to_the_ground_right_at_a_border_of_detail_does_not_slip(
    factor: int,
) -> None:
    """Where it changes sides there, rounding alone says in which of two areas it does."""
    rng = np.random.default_rng(factor)
    blocks = blocks_of(factor, 3)
    row = rng.integers(-3 * factor, 5 * factor, 30_000) / factor
    col = rng.integers(-2 * factor, 5 * factor, 30_000) / factor
    on_row = rng.random(30_000) < 0.5
    target = np.column_stack([np.where(on_row, col, 0.0), np.where(on_row, 0.0, row)]) * SPACING
    posts = base_posts(False)
    height, _ = Fine(GRID, posts, factor, blocks).heights(target[:, 0], target[:, 1])
    start = np.clip(target + rng.normal(0.0, 0.5, (30_000, 2)), [-4.5, -7.5], [9.0, 9.0])
    origins = np.column_stack([start, np.full(30_000, 3.0)])
    ways = np.column_stack([target, height]) - origins
    with Terrain(ArraySource(posts, GRID), detail_factor=factor) as terrain:
        put(terrain, blocks)
        found = raycast(terrain, origins, ways, max_distance=20.0)
    assert (found.state == 0).all()


def test_a_ray_high_over_the_base_meets_a_spike_that_only_detail_has() -> None:
    """Not before it, and not beyond: blocks are crossed at once only above their detail."""
    factor, tall = 16, 500_000
    posts = np.zeros((300, 300), np.int32)
    spike = np.zeros((256, 256), np.int32)
    spike[100, 40:60] = tall * factor
    key = Block(-1, 3, 12)
    with Terrain(ArraySource(posts, Grid(300, 300, 1.0)), detail_factor=factor) as terrain:
        y = (3 * 256 + 100) / factor
        x = (12 * 256 + 40) / factor
        level = [[x + 1.0, y - 50.0, 3.0], [x - 150.0, y, 3.0], [x + 0.5, y, 7.0]]
        ways = [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]]
        before = raycast(terrain, level, ways, max_distance=200.0)
        np.testing.assert_allclose(before.distance, [np.inf, np.inf, 7.0], rtol=1e-15)
        put(terrain, {key: spike})
        after = raycast(terrain, level, ways, max_distance=200.0)
        # The spike's foot is one detail cell wide, and the ray comes at three fifths of its height.
        slope = 0.4 / factor
        expected = [50.0 - slope, 150.0 - slope, 2.0]
        np.testing.assert_allclose(after.distance, expected, rtol=0, atol=1e-10)


def test_detail_may_stand_above_the_highest_post_there_can_be() -> None:
    factor = 4
    posts = np.full((300, 300), MAX_COUNT, np.int32)
    wall = np.zeros((256, 256), np.int32)
    wall[:, 201] = 1000 * factor
    with Terrain(ArraySource(posts, Grid(300, 300, 1.0)), detail_factor=factor) as terrain:
        put(terrain, {Block(-1, 1, 1): wall})
        x = (256 + 201) / factor
        high = (MAX_COUNT + 500) * 1e-5
        level, down = [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]
        starts = [[2.0, 100.0, high], [x, 100.0, high + 1.0], [x + 9.0, 100.0, high + 1.0]]
        found = raycast(terrain, starts, [level, down, down], max_distance=250.0)
        expected = [x - 0.125 - 2.0, 0.995, 1.005]
        np.testing.assert_allclose(found.distance, expected, rtol=0, atol=1e-8)


def test_rays_far_away_have_the_same_bits() -> None:
    factor, shift = 3, 256 * 1_000_001
    posts, blocks = base_posts(True), blocks_of(3)
    rng = np.random.default_rng(1)
    start = np.column_stack(
        [rng.integers(-5 << 10, 8 << 10, (800, 2)) / 1024, rng.uniform(-1.0, 3.0, 800)]
    )
    ways = rng.normal(size=(800, 3))
    answers = []
    for away in (0, shift, -shift):
        grid = Grid(12, 10, 0.5, row=-5 + away, col=-3 - away)
        with Terrain(ArraySource(posts, grid), detail_factor=factor) as terrain:
            put(terrain, blocks)
            found = raycast(
                terrain, start + np.array([-away, away, 0]) * 0.5, ways, max_distance=30.0
            )
            answers.append(
                (found.distance.tobytes(), found.normal.tobytes(), found.state.tobytes())
            )
    assert answers[0] == answers[1] == answers[2]


def test_rays_that_pass_no_detail_have_the_bits_they_have_without() -> None:
    posts = rough(300, 300, 2)
    grid = Grid(300, 300, 1.0)
    rng = np.random.default_rng(7)
    origins = np.column_stack([rng.uniform(0.0, 60.0, (1500, 2)), rng.uniform(0.0, 3.0, 1500)])
    ways = rng.normal(size=(1500, 3)) * [1.0, 1.0, 0.1]
    answers = []
    for factor in (1, 4):
        with Terrain(ArraySource(posts, grid), detail_factor=factor) as terrain:
            if factor == 4:
                # In the same level-0 block, beyond the rays' reach.
                put(terrain, {Block(-1, 2, 2): block_of(1, 4000)})
            found = raycast(terrain, origins, ways, max_distance=60.0)
            answers.append(
                (found.distance.tobytes(), found.point.tobytes(), found.normal.tobytes())
            )
    assert answers[0] == answers[1]
