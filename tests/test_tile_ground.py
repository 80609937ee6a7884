"""Heights of tiles: base and detail, in as many parts as are shown."""

from __future__ import annotations

import numpy as np
import pytest
from detail_ground import add_detail, base_between, rough_ground

from terrasim.counts import Counts
from terrasim.output.tile_ground import DetailPosts, detailed, fine_cells, most_parts
from terrasim.output.tile_history import TileHistory
from terrasim.output.tiles import TILE, Tile, choose_tiles


@pytest.mark.parametrize(
    ("factor", "cells", "room", "parts"),
    [(8, 10, 630, 8), (8, 10, 629, 4), (12, 1, 100, 6), (7, 1, 47, 1), (1024, 3, 10**9, 1024)],
)
def test_parts_divide_the_factor_and_keep_to_the_room(
    factor: int, cells: int, room: int, parts: int
) -> None:
    assert most_parts(factor, cells, room) == parts


@pytest.mark.parametrize(("factor", "parts"), [(6, 6), (6, 3), (6, 2), (6, 1), (5, 5)])
def test_a_tile_s_heights_are_base_and_detail(factor: int, parts: int) -> None:
    """Against the sum over the whole tile; detail comes in pieces that reach beyond it."""
    rng = np.random.default_rng(9)
    counts: Counts = rng.integers(-9_999, 9_999, (TILE + 1, TILE + 1), np.int32)
    side = TILE * factor + 1
    whole = np.zeros((side + 10, side + 10), np.int32)
    for r, c in ((0, 0), (5, 5), (100, 200), (side - 20, side - 9), (177, 60)):
        whole[r : r + 19, c : c + 14] = rng.integers(-99, 99, whole[r : r + 19, c : c + 14].shape)
    middle = side // 2
    pieces = [
        DetailPosts(r - 5, c - 5, whole[r : r + middle + 7, c : c + middle + 7])
        for r in (0, middle + 7)
        for c in (0, middle + 7)
    ]
    fine = np.logical_or.reduce([fine_cells(piece, factor) for piece in pieces])
    ground = detailed(counts, fine, pieces, factor, parts)
    step = factor // parts
    line = np.arange(TILE * parts + 1)
    rows, cols = np.repeat(line, line.size), np.tile(line, line.size)
    detail = whole[5:-5, 5:-5]
    expected = (base_between(counts, factor) + detail)[::step, ::step]
    np.testing.assert_array_equal(ground.heights(rows, cols).reshape(expected.shape), expected)
    touched = np.zeros((TILE, TILE), bool)
    for r, c in np.argwhere(detail):
        touched[
            max(-(-r // factor) - 1, 0) : r // factor + 1,
            max(-(-c // factor) - 1, 0) : c // factor + 1,
        ] = True
    np.testing.assert_array_equal(fine, touched)


def test_tiles_are_those_of_the_terrain() -> None:
    """A tile that reaches beyond the edge has no fine cells there."""
    with rough_ground(2) as terrain:
        span = terrain.detail.posts
        every = np.ones((span.row1 - span.row0, span.col1 - span.col0), np.int32)
        add_detail(terrain, every)
        choice = choose_tiles(terrain.grid, [], most_cells=1 << 22)
        fine = TileHistory(terrain, choice).cover().fine
        assert sum(int(mask.sum()) for mask in fine.values()) == 299 * 329
        assert fine[Tile(0, -5, -1)].sum() == (290 - 256) * 60
