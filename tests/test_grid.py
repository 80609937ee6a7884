"""Posts, blocks and levels of a grid, against brute force."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from terrasim.errors import InputError
from terrasim.grid import MAX_INDEX, Block, Grid, Span
from terrasim.kernels.addressing import BLOCK

GRIDS = [
    Grid(2, 2, 1.0),
    Grid(257, 513, 1.0),
    Grid(256, 256, 1.0, row=-1, col=1),
    Grid(300, 40, 1.0, row=-517, col=255),
    Grid(1024, 1024, 1.0, row=1022, col=-1022),
]


def read_at(grid: Grid, level: int) -> tuple[set[int], set[int]]:
    """Rows and columns of a level's posts that the corners of level-0 cells' cells are."""
    rows = {r >> level for r in range(grid.row, grid.row + grid.rows - 1)}
    cols = {c >> level for c in range(grid.col, grid.col + grid.cols - 1)}
    return rows | {r + 1 for r in rows}, cols | {c + 1 for c in cols}


@pytest.mark.parametrize("grid", GRIDS)
def test_a_levels_posts_are_the_corners_of_the_cells_that_cover_the_terrain(grid: Grid) -> None:
    for level in range(grid.levels):
        rows, cols = read_at(grid, level)
        assert grid.posts(level) == Span(min(rows), max(rows) + 1, min(cols), max(cols) + 1)


@pytest.mark.parametrize("grid", GRIDS)
def test_a_levels_blocks_are_those_that_hold_its_posts(grid: Grid) -> None:
    for level in range(grid.levels):
        rows, cols = ({post // BLOCK for post in posts} for posts in read_at(grid, level))
        span = grid.blocks(level)
        held = set(product(range(span.row0, span.row1), range(span.col0, span.col1)))
        assert held == set(product(rows, cols))


@given(st.integers(2, 2**20), st.integers(2, 2**20))
def test_the_top_is_the_first_level_at_which_a_block_holds_the_terrain(
    rows: int, cols: int
) -> None:
    top = Grid(rows, cols, 1.0).top
    cells = max(rows, cols) - 1
    assert cells < BLOCK << top
    assert top == 0 or cells >= BLOCK << (top - 1)
    assert Grid(rows, cols, 1.0).levels == top + 1


def test_a_block_is_ordered_by_level_row_and_column() -> None:
    keys = [Block(1, 0, 0), Block(0, 1, -1), Block(0, -1, 5), Block(0, 1, -2)]
    assert sorted(keys) == [Block(0, -1, 5), Block(0, 1, -2), Block(0, 1, -1), Block(1, 0, 0)]


def test_indices_beyond_the_edge_are_moved_to_it() -> None:
    grid = Grid(10, 20, 1.0, row=-5, col=100)
    beyond = np.array([-(2**40), -6, -5, 0, 4, 5, 2**40])
    assert grid.clamp_rows(beyond).tolist() == [-5, -5, -5, 0, 4, 4, 4]
    assert grid.clamp_cols(beyond + 100).tolist() == [100, 100, 100, 100, 104, 105, 119]


def test_a_post_stands_where_its_index_says() -> None:
    grid = Grid(10, 20, 0.25, x=1e6, y=-3.0, row=-5, col=100)
    assert grid.post_x([100, 119]).tolist() == [1e6 + 25.0, 1e6 + 29.75]
    assert grid.post_y(-5).item() == -4.25


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"rows": 1}, "at least 2 x 2 posts, got 1 x 9"),
        ({"cols": 0}, "at least 2 x 2 posts, got 9 x 0"),
        ({"spacing": 0.0}, "spacing must be positive and finite .*, got 0.0"),
        ({"spacing": -1.0}, "spacing must be positive"),
        ({"spacing": math.nan}, "spacing must be positive and finite .*, got nan"),
        ({"spacing": math.inf}, "spacing must be positive and finite .*, got inf"),
        ({"x": math.nan}, "x must be finite, got nan"),
        ({"y": -math.inf}, "y must be finite, got -inf"),
        ({"datum": math.inf}, "datum must be finite, got inf"),
        ({"row": MAX_INDEX}, "indices must stay within"),
        ({"col": -MAX_INDEX - 1}, "indices must stay within"),
    ],
)
def test_a_grid_that_cannot_be_addressed_is_refused(values: dict[str, float], words: str) -> None:
    good: dict[str, float] = {"rows": 9, "cols": 9, "spacing": 1.0}
    with pytest.raises(InputError, match=words):
        Grid(**(good | values))  # type: ignore[arg-type]
