"""Choosing tiles: a cover without overlap, fine in the focus, within the number of cells."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrasim.errors import InputError
from terrasim.grid import Grid, Span
from terrasim.output.tiles import TILE, Tile, choose_tiles, leaf_at


@settings(max_examples=30, deadline=None)
@given(
    rows=st.integers(2, 1500),
    cols=st.integers(2, 1500),
    row=st.integers(-3000, 3000),
    col=st.integers(-3000, 3000),
    seed=st.integers(0, 99),
)
def test_every_cell_lies_in_exactly_one_tile(
    rows: int, cols: int, row: int, col: int, seed: int
) -> None:
    grid = Grid(rows, cols, spacing=1.0, row=row, col=col)
    rng = np.random.default_rng(seed)
    r, c = row + int(rng.integers(rows)), col + int(rng.integers(cols))
    choice = choose_tiles(grid, [Span(r, r + 9, c, c + 9)], most_cells=1 << 30)
    tiles = frozenset(choice.tiles)
    assert choice.finest == 0
    covered = 0
    for tile in choice.tiles:
        box = tile.box
        high = min(box.row1, row + rows - 1) - max(box.row0, row)
        wide = min(box.col1, col + cols - 1) - max(box.col0, col)
        assert high > 0
        assert wide > 0
        covered += high * wide
    assert covered == (rows - 1) * (cols - 1)
    for _ in range(20):
        cell = (row + int(rng.integers(rows - 1)), col + int(rng.integers(cols - 1)))
        found = leaf_at(tiles, *cell, grid.top)
        assert found is not None
        assert found.box.row0 <= cell[0] < found.box.row1
        assert found.box.col0 <= cell[1] < found.box.col1


def test_detail_falls_off_with_the_distance_from_the_focus() -> None:
    grid = Grid(100_001, 100_001, spacing=1.0)
    choice = choose_tiles(grid, [Span(5000, 5100, 5000, 5100)], most_cells=4_000_000)
    near = leaf_at(frozenset(choice.tiles), 5050, 5050, grid.top)
    far = leaf_at(frozenset(choice.tiles), 99_000, 99_000, grid.top)
    assert near is not None
    assert near.level == 0
    assert far is not None
    assert far.level >= 7


def test_fewer_cells_make_the_focus_coarser() -> None:
    grid = Grid(20_001, 20_001, spacing=1.0)
    focus = [Span(0, 4000, 0, 4000)]
    fine = choose_tiles(grid, focus, most_cells=1 << 25)
    coarse = choose_tiles(grid, focus, most_cells=1 << 20)
    assert fine.finest == 0
    assert coarse.finest > 0
    assert len(coarse.tiles) * TILE * TILE <= 1 << 20


def test_too_few_cells_for_any_mesh_are_refused() -> None:
    with pytest.raises(InputError, match="allow more"):
        choose_tiles(Grid(20_001, 20_001, spacing=1.0), [], most_cells=10)


def test_a_tile_west_of_the_origin_covers_its_cells() -> None:
    assert Tile(1, -1, -2).box == Span(-128, 0, -256, -128)
