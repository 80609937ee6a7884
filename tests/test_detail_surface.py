"""Base and detail read as one surface: the triangles of a grid that is simply finer."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp
from detail_oracle import NO_GROUND, Fine, Real, Whole, block_of, put, rough

from terrasim.counts import HOLE, Counts
from terrasim.grid import Block, Grid
from terrasim.kernels import detail as kernels
from terrasim.kernels.lattice import Lattice
from terrasim.kernels.surface import detail_facet
from terrasim.query import sample, sample_all
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

FACTORS = [2, 3, 7, 64, 1024]
GRID = Grid(300, 310, 0.5, x=3.0, y=-8.0, row=-290, col=-60, datum=2.0)
"""Four blocks meet at post (0, 0), which is detail post (512, 256) times the factor."""


@wp.kernel(enable_backward=False)  # type: ignore[untyped-decorator]
def read_totals(
    pool: wp.array(dtype=int),  # type: ignore[valid-type]
    table: wp.array(dtype=int),  # type: ignore[valid-type]
    lattice: Lattice,
    cells: wp.array(dtype=wp.vec4i),  # type: ignore[valid-type]
    total_out: wp.array(dtype=wp.int64),  # type: ignore[valid-type]
    rise_out: wp.array2d(dtype=wp.float64),  # type: ignore[valid-type]
) -> None:
    n = wp.tid()
    c = cells[n]
    total_out[n] = kernels.total_at(pool, table, lattice, c[0], c[1], c[2], c[3])
    i = wp.min(c[2], lattice.factor - 1)
    j = wp.min(c[3], lattice.factor - 1)
    half = wp.float64(0.5)
    quarter = wp.float64(0.25)
    lower = detail_facet(pool, table, lattice, c[0], c[1], i, j, half, quarter)
    upper = detail_facet(pool, table, lattice, c[0], c[1], i, j, quarter, half)
    rise_out[n, 0] = lower.du
    rise_out[n, 1] = lower.dv
    rise_out[n, 2] = upper.du
    rise_out[n, 3] = upper.dv
    rise_out[n, 4] = wp.float64(lower.state + upper.state)


def corner_blocks(factor: int) -> dict[Block, Counts]:
    """Detail in some blocks round post (0, 0), where four level-0 blocks meet.

    One is left out, so that borders of ground with detail and without are there, too.
    """
    keys = [(2 * factor - 1, factor - 1), (2 * factor - 1, factor), (2 * factor, factor - 1)]
    keys += [(2 * factor - 2, factor - 2)] if factor > 2 else [(2 * factor + 1, factor + 1)]
    return {Block(-1, row, col): block_of(n, 900 * factor) for n, (row, col) in enumerate(keys)}


def cells_round(factor: int, count: int, seed: int) -> npt.NDArray[np.int32]:
    """Cells and detail posts in them near post (0, 0); each ``row, col, i, j``."""
    rng = np.random.default_rng(seed)
    reach = max(2, 300 // factor)
    cells = rng.integers(-reach, reach, (count, 2))
    cells[:, 0] = np.clip(cells[:, 0], -290, 8)
    cells[:, 1] = np.clip(cells[:, 1], -60, 248)
    parts = rng.integers(0, factor + 1, (count, 2))
    # Half of them near the blocks' common corner, whatever the factor.
    near = rng.integers(-300, 300, (count // 2, 2))
    cells[: count // 2] = np.maximum(near // factor, [-290, -60])
    parts[: count // 2] = near % factor
    cells[: count // 2, 0] = np.minimum(cells[: count // 2, 0], 8)
    return np.concatenate([cells, parts], axis=1).astype(np.int32)


def numbers(fine: Fine, cells: npt.NDArray[np.int32]) -> tuple[Whole, Whole]:
    """Detail rows and columns of posts of cells."""
    wide = cells.astype(np.int64)
    row = (wide[:, 0] - fine.row0) * fine.factor + wide[:, 2]
    return row, (wide[:, 1] - fine.col0) * fine.factor + wide[:, 3]


def read(terrain: Terrain, cells: npt.NDArray[np.int32]) -> tuple[Whole, Real]:
    """Totals and rises as kernels find them."""
    terrain.cache.hold([Block(0, r, c) for r in (-2, -1, 0) for c in (-1, 0)])
    total = wp.zeros(len(cells), dtype=wp.int64, device="cpu")
    rise = wp.zeros((len(cells), 5), dtype=wp.float64, device="cpu")
    asked: Any = wp.array(cells, dtype=wp.vec4i, device="cpu")
    wp.launch(
        read_totals,
        dim=len(cells),
        inputs=[terrain.pool, terrain.resident, terrain.lattice, asked],
        outputs=[total, rise],
        device="cpu",
    )
    return total.numpy(), rise.numpy()


def check_totals(posts: Counts, factor: int) -> None:
    """Hold that totals and rises are the finer grid's, number for number."""
    blocks = corner_blocks(factor)
    fine = Fine(GRID, posts, factor, blocks)
    cells = cells_round(factor, 4000, factor)
    with Terrain(ArraySource(posts, GRID), detail_factor=factor) as terrain:
        put(terrain, blocks)
        found, rise = read(terrain, cells)
    row, col = numbers(fine, cells)
    expected = fine.total(row, col)
    assert (fine.difference(row, col) != 0).mean() > 0.2
    np.testing.assert_array_equal(found == kernels.NO_GROUND, expected == NO_GROUND)
    ground = expected != NO_GROUND
    np.testing.assert_array_equal(found[ground], expected[ground])
    row -= cells[:, 2] == factor
    col -= cells[:, 3] == factor
    near, far = fine.total(row, col), fine.total(row + 1, col + 1)
    right, left = fine.total(row, col + 1), fine.total(row + 1, col)
    hole = np.min([near, far, right, left], axis=0) == NO_GROUND
    np.testing.assert_array_equal(rise[:, 4] > 0, hole)
    rises = np.stack([right - near, far - right, far - left, left - near], axis=1)
    np.testing.assert_array_equal(rise[~hole, :4], rises[~hole])


@pytest.mark.parametrize("factor", FACTORS)
def test_totals_and_rises_are_exact_where_blocks_of_base_and_detail_meet(factor: int) -> None:
    check_totals(rough(300, 310, 7), factor)


@pytest.mark.parametrize("factor", [2, 7, 1024])
def test_they_are_exact_ten_kilometres_up_and_down_and_at_holes(factor: int) -> None:
    posts = rough(300, 310, 8, 2**30 - 1)
    posts[np.random.default_rng(1).random(posts.shape) < 0.1] = HOLE
    check_totals(posts, factor)


def places(grid: Grid, factor: int, count: int) -> Real:
    """World points: all over, round the corner of four blocks, on detail posts and their edges."""
    rng = np.random.default_rng(factor)
    share = rng.random((count, 2))
    row = grid.row + share[:, 1] * (grid.rows - 1)
    col = grid.col + share[:, 0] * (grid.cols - 1)
    third = count // 3
    row[:third] = rng.uniform(-270.0, 270.0, third) / factor
    col[:third] = rng.uniform(-270.0, 270.0, third) / factor
    on_posts = slice(third, 2 * third)
    row[on_posts] = np.floor(rng.uniform(-270.0, 270.0, third)) / factor
    col[on_posts] = rng.uniform(-270.0, 270.0, third) / factor
    row = np.clip(row, grid.row, grid.row + grid.rows - 1)
    col = np.clip(col, grid.col, grid.col + grid.cols - 1)
    return np.column_stack([grid.x + col * grid.spacing, grid.y + row * grid.spacing])


@pytest.mark.parametrize("factor", FACTORS)
def test_heights_and_normals_are_those_of_the_finer_grids_triangles(factor: int) -> None:
    """Rounding of a place by 2^-52 of 150 posts moves it along slopes of up to 2000 counts a post.

    A point within that of an edge may lie on the triangle beyond, so a normal may be the next one.
    """
    posts, blocks = rough(300, 310, 3), corner_blocks(factor)
    fine = Fine(GRID, posts, factor, blocks)
    points = places(GRID, factor, 6000)
    with Terrain(ArraySource(posts, GRID), detail_factor=factor) as terrain:
        put(terrain, blocks)
        found = sample_all(terrain, points)
        quick = sample(terrain, points)
    height, slope = fine.heights(points[:, 0], points[:, 1])
    steepest = np.hypot(*slope.T).max() * GRID.spacing
    np.testing.assert_allclose(found.height, height, rtol=0, atol=1e-15 + steepest * 300 * 2**-52)
    np.testing.assert_array_equal(quick.height, found.height)
    np.testing.assert_array_equal(quick.state, found.state)
    normal = np.column_stack([-slope, np.ones(len(slope))])
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    wrong = np.abs(found.normal - normal).max(axis=1) > 1e-12
    assert wrong.mean() < 0.3
    # Points on an edge: of the triangles there are, it is one.
    around = [fine.heights(points[:, 0] + dx, points[:, 1] + dy)[1] for dx, dy in NUDGES]
    given = -found.normal[:, :2] / found.normal[:, 2:]
    away = np.abs(np.array(around) - given).max(axis=2).min(axis=0)
    assert (away <= 1e-9 * (1.0 + np.abs(given).max())).all()
    assert (found.level == 0).all()
    assert (found.error == 0.0).all()


NUDGES = [(dx, dy) for dx in (-1e-11, 0.0, 1e-11) for dy in (-1e-11, 0.0, 1e-11)]


@pytest.mark.parametrize("factor", [2, 3, 64])
def test_detail_of_one_block_alone_reaches_the_cells_of_the_three_beside_it(factor: int) -> None:
    """Its first posts are the last of theirs, and the base's block there has no detail itself."""
    posts = rough(300, 310, 3)
    rng = np.random.default_rng(1)
    points = rng.uniform(-2.0, 2.0, (4000, 2)) * GRID.spacing + [GRID.x, GRID.y]
    for row in (2 * factor - 1, 2 * factor):
        for col in (factor - 1, factor):
            blocks = {Block(-1, row, col): block_of(row + col, 900 * factor)}
            height, _ = Fine(GRID, posts, factor, blocks).heights(points[:, 0], points[:, 1])
            with Terrain(ArraySource(posts, GRID), detail_factor=factor) as terrain:
                put(terrain, blocks)
                found = sample(terrain, points).height
            np.testing.assert_allclose(found, height, rtol=0, atol=1e-12)


@pytest.mark.parametrize("factor", [3, 7, 1000])
def test_a_hair_beside_a_cells_diagonal_the_triangle_is_one_of_the_two(factor: int) -> None:
    """Where rounding puts a place onto the detail's diagonal, the base's side still counts."""
    grid = Grid(2, 2, 1.0)
    posts = np.array([[0, 500_000], [-700_000, 100_000]], np.int32)
    difference = {Block(-1, 0, 0): block_of(1, 70_000)}
    v = np.random.default_rng(1).uniform(0.0, min(1.0, 250.0 / factor), 4000)
    points = np.column_stack([np.nextafter(v, 0.0), v])
    fine = Fine(grid, posts, factor, difference)
    rises = [fine.heights(v + dx, v)[1] for dx in (-1e-9 / factor, 1e-9 / factor)]
    with Terrain(ArraySource(posts, grid), detail_factor=factor) as terrain:
        put(terrain, difference)
        found = sample_all(terrain, points).normal
    given = -found[:, :2] / found[:, 2:]
    away = np.array([np.abs(given - one).max(axis=1) for one in rises]).min(axis=0)
    # Right at a detail post it may be one of its other triangles.
    assert (away < 1e-7).mean() > 0.99


def test_ground_far_away_has_the_same_bits() -> None:
    """The same posts and detail whole blocks away; places are exact in float64 at both."""
    factor, shift = 3, 256 * 1_000_001
    posts, blocks = rough(300, 310, 5), corner_blocks(3)
    rng = np.random.default_rng(4)
    cells = np.column_stack([rng.integers(-60, 240, 3000), rng.integers(-280, 8, 3000)])
    inside = rng.integers(0, 1 << 12, (3000, 2)) / (1 << 12)
    answers = []
    for away in (0, shift, -shift):
        grid = Grid(300, 310, 0.5, row=-290 + away, col=-60 - away)
        with Terrain(ArraySource(posts, grid), detail_factor=factor) as terrain:
            put(terrain, blocks)
            points = (cells + np.array([-away, away]) + inside) * 0.5
            found = sample_all(terrain, points)
            answers.append([found.height.tobytes(), found.normal.tobytes(), found.state.tobytes()])
    assert answers[0] == answers[1] == answers[2]


def test_where_the_detail_is_zero_the_surface_has_the_bits_it_has_without() -> None:
    """Detail elsewhere, in the same block and even in the same detail block, changes no bit."""
    posts = rough(300, 310, 6)
    points = places(GRID, 7, 6000)
    with Terrain(ArraySource(posts, GRID)) as terrain:
        before, before_all = sample(terrain, points), sample_all(terrain, points)
    for blocks in ({}, {Block(-1, 13, 7): one_post(100, 100)}):
        with Terrain(ArraySource(posts, GRID), detail_factor=7) as terrain:
            put(terrain, blocks)
            row = ((points[:, 1] + 8.0) / 0.5 + 512) * 7 - (13 * 256 + 100)
            col = ((points[:, 0] - 3.0) / 0.5 + 256) * 7 - (7 * 256 + 100)
            away = (np.abs(row) > 1.0) | (np.abs(col) > 1.0) if blocks else np.full(len(row), True)
            after, after_all = sample(terrain, points), sample_all(terrain, points)
            assert len(terrain.cache.details(Block(0, -1, 0))) == len(blocks)
            for old, new in ((before, after), (before_all, after_all)):
                assert old.height[away].tobytes() == new.height[away].tobytes()
                assert old.state[away].tobytes() == new.state[away].tobytes()
            assert before_all.normal[away].tobytes() == after_all.normal[away].tobytes()


def one_post(row: int, col: int) -> Counts:
    """A block with a single difference."""
    posts = np.zeros((256, 256), np.int32)
    posts[row, col] = 70_000
    return posts


def test_threads_give_the_same_bits() -> None:
    posts, blocks = rough(300, 310, 3), corner_blocks(64)
    points = places(GRID, 64, 9000)
    answers = []
    for threads in (1, 3):
        with Terrain(ArraySource(posts, GRID), detail_factor=64, threads=threads) as terrain:
            put(terrain, blocks)
            answers.append(sample(terrain, points).height.tobytes())
    assert answers[0] == answers[1]


def test_a_terrain_of_one_block_with_detail_up_to_its_edge_answers_there() -> None:
    """The last detail posts lie on the terrain's edge; the points beyond take the edge's height."""
    grid = Grid(9, 9, 1.0)
    posts = rough(9, 9, 2)
    difference = np.zeros((256, 256), np.int32)
    difference[:25, :25] = rough(25, 25, 9, 3000)
    with Terrain(ArraySource(posts, grid), detail_factor=3) as terrain:
        put(terrain, {Block(-1, 0, 0): difference})
        fine = Fine(grid, posts, 3, {Block(-1, 0, 0): difference})
        edge = np.array([[8.0, 8.0], [8.0, 3.25], [0.1, 8.0], [11.0, 3.25], [0.1, 99.0]])
        inside = np.minimum(edge, 8.0)
        height, _ = fine.heights(inside[:, 0], inside[:, 1])
        found = sample(terrain, edge)
        np.testing.assert_allclose(found.height, height, rtol=0, atol=1e-14)
        assert found.state.tolist() == [0, 0, 0, 1, 1]
