"""Levels from streamed rows, and their exact errors, against post-by-post references."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from terrasim.counts import HOLE, MAX_COUNT, Counts
from terrasim.errors import RunError
from terrasim.grid import Block, Grid
from terrasim.kernels.addressing import BLOCK
from terrasim.sources.array_source import ArraySource
from terrasim.sources.source import block_indices
from terrasim.store.pyramid import SourceRows, block_error, block_rows, cell_errors, level_errors


def rough(rows: int, cols: int, seed: int = 0, holes: int = 0, reach: int = 10**6) -> Counts:
    """Independent random heights with some holes."""
    rng = np.random.default_rng(seed)
    posts = rng.integers(-reach, reach, (rows, cols), dtype=np.int32)
    posts[rng.integers(0, rows, holes), rng.integers(0, cols, holes)] = HOLE
    return posts


def reference_errors(fine: Counts, coarse: Counts, level: int) -> list[list[int]]:
    """Each cell's error in Python's own integers, post by post."""
    size = 1 << level
    errors = [[0] * (coarse.shape[1] - 1) for _ in range(coarse.shape[0] - 1)]
    for (r, row), c in product(enumerate(errors), range(coarse.shape[1] - 1)):
        for v, u in product(range(size + 1), repeat=2):
            h = int(fine[r * size + v, c * size + u])
            (p00, p10), (p01, p11) = coarse[r : r + 2, c : c + 2].tolist()
            for corner, line in (
                (p10, size * p00 + u * (p10 - p00) + v * (p11 - p10) if u >= v else None),
                (p01, size * p00 + v * (p01 - p00) + u * (p11 - p01) if v >= u else None),
            ):
                if line is not None and HOLE not in (h, p00, p11, corner):
                    row[c] = max(row[c], -(-abs(size * h - line) // size))
    return errors


@settings(max_examples=30, deadline=None)
@given(
    level=st.integers(1, 4),
    cells=st.tuples(st.integers(1, 4), st.integers(1, 4)),
    holes=st.integers(0, 6),
    reach=st.sampled_from([3, 10**6, MAX_COUNT]),
    seed=st.integers(0, 10**6),
)
def test_cell_errors_equal_whole_number_arithmetic(
    level: int, cells: tuple[int, int], holes: int, reach: int, seed: int
) -> None:
    """To the count, rounded up, at any range of heights, beside holes and over both triangles."""
    fine = rough((cells[0] << level) + 1, (cells[1] << level) + 1, seed, holes, reach)
    coarse = fine[:: 1 << level, :: 1 << level]
    got = cell_errors(fine, (0, 0), coarse, (0, 0), level)
    assert got.tolist() == reference_errors(fine, coarse, level)


def test_cell_errors_go_by_indices_not_by_place_in_the_array() -> None:
    """A window of posts at negative indices gives what the same window gives at the origin."""
    fine = rough(17, 25)
    coarse = fine[::8, ::8]
    whole = cell_errors(fine, (0, 0), coarse, (0, 0), 3)
    np.testing.assert_array_equal(cell_errors(fine, (-32, 8), coarse, (-4, 1), 3), whole)
    part = cell_errors(fine[8:, 8:], (-24, 16), coarse[1:, 1:], (-3, 2), 3)
    np.testing.assert_array_equal(part, whole[1:, 1:])


@pytest.mark.parametrize("strip", [1, 3, 8, 11])
def test_a_cell_taller_than_a_strip_is_the_worst_of_its_parts(strip: int) -> None:
    """Each strip tells of the rows it holds; together they tell of the cell."""
    fine = rough(17, 33, holes=3)
    coarse = fine[::16, ::16]
    parts = [
        cell_errors(fine[row : row + strip + 1], (row, 0), coarse, (0, 0), 4)
        for row in range(0, 16, strip)
    ]
    whole = cell_errors(fine, (0, 0), coarse, (0, 0), 4)
    np.testing.assert_array_equal(np.max(parts, axis=0), whole)
    assert (parts[0] < whole).any()


def test_the_largest_step_that_counts_allow_does_not_overflow() -> None:
    """From the lowest height to the highest is 2^32 - 2 counts."""
    fine = np.full((5, 5), -MAX_COUNT, dtype=np.int32)
    fine[1, 2] = MAX_COUNT
    assert cell_errors(fine, (0, 0), fine[::4, ::4], (0, 0), 2).tolist() == [[2**32 - 2]]


def test_a_level_splits_its_cells_along_the_rising_diagonal() -> None:
    """Posts of the ridge u = v are met exactly; across the other diagonal the surface is off."""
    u, v = np.meshgrid(np.arange(9), np.arange(9))
    rising = (-np.abs(u - v) * 800).astype(np.int32)
    falling = (-np.abs(u + v - 8) * 800).astype(np.int32)
    assert cell_errors(rising, (0, 0), rising[::8, ::8], (0, 0), 3).max() == 0
    assert cell_errors(falling, (0, 0), falling[::8, ::8], (0, 0), 3).max() == 8 * 800


@settings(max_examples=12, deadline=None)
@given(
    rows=st.integers(2, 1100),
    cols=st.integers(2, 700),
    row=st.integers(-1500, 1500),
    col=st.integers(-1500, 1500),
    seed=st.integers(0, 1000),
)
# The last post of a level is odd and its block's last: the next level needs one block more.
@example(rows=512, cols=512, row=0, col=0, seed=0)
@example(rows=300, cols=700, row=724, col=-189, seed=0)
def test_streamed_levels_are_sub_samples_with_the_edge_carried_on(
    rows: int, cols: int, row: int, col: int, seed: int
) -> None:
    """Every row of blocks of every level comes once, complete, from rows read once in order."""
    grid = Grid(rows, cols, 1.0, row=row, col=col)
    source = ArraySource(rough(rows, cols, seed), grid)
    seen = []
    for level, block_row, posts in block_rows(source, grid):
        span = grid.blocks(level)
        at_cols = np.arange(span.col0 * BLOCK, span.col1 * BLOCK)
        expected = source.posts(level, block_indices(block_row), at_cols)
        np.testing.assert_array_equal(posts, expected)
        seen.append((level, block_row))
    wanted = [(n, r) for n in range(grid.levels) for r in range(*grid.blocks(n)[:2])]
    assert sorted(seen) == wanted


def test_rows_are_read_once_from_the_south() -> None:
    """A stream that cannot go back will do."""
    asked: list[tuple[int, int]] = []

    class Stream:
        def read_rows(self, row: int, count: int) -> Counts:
            asked.append((row, count))
            return np.zeros((count, 300), dtype=np.int32)

    grid = Grid(700, 300, 1.0, row=-100)
    assert len(list(block_rows(Stream(), grid))) == len(grid_rows(grid))
    assert asked == [(0, 100), (100, 256), (356, 256), (612, 88)]


def grid_rows(grid: Grid) -> list[int]:
    """All rows of blocks of all levels."""
    return [r for level in range(grid.levels) for r in range(*grid.blocks(level)[:2])]


def test_any_source_gives_rows() -> None:
    """They are counted from the southern edge, whatever index that has."""
    posts = rough(9, 7)
    source = ArraySource(posts, Grid(9, 7, 1.0, row=-40, col=13))
    np.testing.assert_array_equal(SourceRows(source).read_rows(2, 5), posts[2:7])


@pytest.mark.parametrize("wrong", [np.zeros((2, 5), np.int64), np.zeros((2, 4), np.int32)])
def test_rows_of_another_kind_are_refused(wrong: Counts) -> None:
    """A reader's mistake never becomes ground."""

    class Stream:
        def read_rows(self, row: int, count: int) -> Counts:
            return wrong[row : row + count]

    with pytest.raises(RunError, match="the grid expects int32"):
        list(block_rows(Stream(), Grid(2, 5, 1.0)))


@pytest.mark.parametrize("strip", [37, 256, 5000])
@pytest.mark.parametrize(("row", "col"), [(0, 0), (-300, 77), (511, -1)])
def test_level_errors_do_not_depend_on_how_they_are_streamed(
    strip: int, row: int, col: int
) -> None:
    """Equal to those of the same terrain in memory, for strips lower and higher than the cells."""
    source = ArraySource(rough(1030, 400, holes=40), Grid(1030, 400, 1.0, row=row, col=col))
    for level, (error, _) in enumerate(level_errors(source, strip=strip)):
        span = source.grid.blocks(level)
        expected = [
            [source.block(Block(level, r, c)).error for c in range(span.col0, span.col1)]
            for r in range(span.row0, span.row1)
        ]
        assert error.tolist() == expected


def test_the_edge_carried_on_is_measured_where_holes_hide_it_inside() -> None:
    """A cell one beyond the terrain knows ground that none inside does."""
    posts = np.zeros((300, 300), dtype=np.int32)
    posts[0, 1::2] = posts[1::2, 0] = 1000
    posts[1, :] = posts[:, 1] = HOLE
    posts[0, 1] = posts[1, 0] = 1000
    for row, col in ((-299, 1), (1, -299), (-299, -299)):
        source = ArraySource(posts, Grid(300, 300, 1.0, row=row, col=col))
        error = level_errors(source)[1].error
        assert error.max() == 1000
        assert error.tolist() == [
            [source.block(Block(1, r, c)).error for c in range(*source.grid.blocks(1)[2:])]
            for r in range(*source.grid.blocks(1)[:2])
        ]


def test_one_block_is_measured_alone_as_in_the_whole() -> None:
    """For whoever changed a block and needs its error again."""
    source = ArraySource(rough(900, 700, holes=9), Grid(900, 700, 1.0, row=-70, col=200))
    for level, (error, _) in enumerate(level_errors(source)):
        span = source.grid.blocks(level)
        for (r, c), counts in np.ndenumerate(error):
            assert block_error(source, Block(level, span.row0 + r, span.col0 + c)) == counts


def test_a_single_spike_is_seen_in_full_at_every_level() -> None:
    """It stands between the posts of every coarser level, in one block of each."""
    posts = np.zeros((1025, 1025), dtype=np.int32)
    posts[301, 777] = 12_345
    for error, _ in level_errors(ArraySource(posts, Grid(1025, 1025, 1.0)))[1:]:
        assert error.max() == 12_345
        assert np.count_nonzero(error) == 1


def test_a_plane_is_the_same_at_every_level() -> None:
    """Where the terrain's sides are a power of two long nothing is lost, at the edges either."""
    r, c = np.mgrid[0:1025, 0:1025]
    levels = level_errors(ArraySource((3 * r - 7 * c).astype(np.int32), Grid(1025, 1025, 1.0)))
    assert [int(error.max()) for error, _ in levels] == [0, 0, 0, 0]


def test_triangles_with_a_hole_at_a_corner_are_skipped_and_counted() -> None:
    """A post inside belongs to six triangles; one between the coarse posts to none."""
    posts = np.zeros((513, 513), dtype=np.int32)
    posts[64, 64] = posts[3, 3] = HOLE
    posts[65, 65] = 500
    levels = level_errors(ArraySource(posts, Grid(513, 513, 1.0)), strip=100)
    assert [skipped for _, skipped in levels] == [0, 6, 6]
    # The post of 500 lies inside skipped triangles alone.
    assert [int(error.max()) for error, _ in levels] == [0, 0, 0]


def test_progress_ends_at_one() -> None:
    """And never goes back."""
    told: list[float] = []
    level_errors(ArraySource(rough(600, 600), Grid(600, 600, 1.0)), progress=told.append)
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)
