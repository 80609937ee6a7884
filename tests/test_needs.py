"""Needs name exactly the blocks that the ground under them reads."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.cache.needs import Boxes, Disc, region_blocks
from terrasim.errors import InputError
from terrasim.grid import Block, Grid, Span
from terrasim.kernels.addressing import BLOCK

GRID = Grid(2000, 3000, 1.0, row=-900, col=-1300)

Cells = npt.NDArray[np.int64]


def read_by(grid: Grid, level: int, rows: Cells, cols: Cells) -> set[Block]:
    """Blocks of the posts at the corners of a level's cells over level-0 cells."""
    rows = np.clip(rows, grid.row, grid.row + grid.rows - 2) >> level
    cols = np.clip(cols, grid.col, grid.col + grid.cols - 2) >> level
    return {
        Block(level, row, col)
        for up in (0, 1)
        for right in (0, 1)
        for row, col in np.unique(
            np.column_stack([(rows + up) // BLOCK, (cols + right) // BLOCK]), axis=0
        ).tolist()
    }


def points_of(disc: Disc, random: np.random.Generator) -> tuple[Cells, Cells]:
    """Level-0 cells under many points of a disc, its rim among them."""
    turn = random.uniform(0.0, 2.0 * np.pi, 20_000)
    reach = np.where(turn < 3.0, 1.0, np.sqrt(random.random(20_000)))
    reach *= disc.radius * 2**disc.level * (1.0 - 1e-9)
    rows, cols = disc.row + reach * np.sin(turn), disc.col + reach * np.cos(turn)
    return np.floor(rows).astype(np.int64), np.floor(cols).astype(np.int64)


@pytest.mark.parametrize("level", range(GRID.levels))
@pytest.mark.parametrize("seed", range(25))
def test_a_disc_has_every_block_that_its_cells_read(seed: int, level: int) -> None:
    random = np.random.default_rng(seed)
    row = random.uniform(GRID.row - 400.0, GRID.row + GRID.rows + 400.0)
    col = random.uniform(GRID.col - 400.0, GRID.col + GRID.cols + 400.0)
    disc = Disc(row, col, random.choice([0.0, 3.0, 100.0, 700.0]), int(random.integers(0, 3)))
    found = disc.blocks(GRID, level)
    assert len(found) == len(set(found))
    assert read_by(GRID, level, *points_of(disc, random)) <= set(found)


@pytest.mark.parametrize("level", range(GRID.levels))
def test_a_disc_has_no_block_out_of_its_reach(level: int) -> None:
    """A block is read by cells from one before its first post to its last."""
    random = np.random.default_rng(level)
    for _ in range(50):
        disc = Disc(random.uniform(-900, 1099), random.uniform(-1300, 1699), 150.0, 1)
        for key in disc.blocks(GRID, level):
            assert distance(disc, key) <= 300.0 / 2**level


def distance(disc: Disc, key: Block) -> float:
    """From a disc's middle to the nearest cell that reads a block [posts of the block's level]."""
    away = []
    for centre, index in ((disc.row, key.row), (disc.col, key.col)):
        place, first = centre / 2**key.level, index * BLOCK - 1.0
        away.append(max(first - place, 0.0, place - (first + BLOCK + 1.0)))
    return float(np.hypot(*away))


def test_the_nearest_block_of_a_disc_comes_first() -> None:
    disc = Disc(100.0, -200.0, 900.0)
    found = disc.blocks(GRID, 0)
    away = [distance(disc, key) for key in found]
    assert len(found) > 20
    assert away == sorted(away)
    assert found[0] == Block(0, 0, -1)


@pytest.mark.parametrize(("row", "col"), [(-5000.0, 3.0), (7.0, 9999.0), (9999.0, -9999.0)])
def test_a_disc_off_the_terrain_has_the_nearest_edge(row: float, col: float) -> None:
    found = Disc(row, col, 2.0).blocks(GRID, 0)
    edge_row = int(np.clip(row, GRID.row, GRID.row + GRID.rows - 1)) // BLOCK
    edge_col = int(np.clip(col, GRID.col, GRID.col + GRID.cols - 1)) // BLOCK
    assert Block(0, edge_row, edge_col) in found


def random_boxes(count: int, widest: int, seed: int) -> Boxes:
    """Boxes on and off the terrain."""
    random = np.random.default_rng(seed)
    row0 = random.integers(GRID.row - 300, GRID.row + GRID.rows + 300, count)
    col0 = random.integers(GRID.col - 300, GRID.col + GRID.cols + 300, count)
    high, wide = random.integers(0, widest, (2, count))
    return Boxes(row0, row0 + high, col0, col0 + wide)


@pytest.mark.parametrize("level", range(GRID.levels))
@pytest.mark.parametrize(("count", "widest"), [(1, 600), (5, 3), (63, 40), (64, 3), (200, 700)])
def test_boxes_have_exactly_the_blocks_that_their_cells_read(
    level: int, count: int, widest: int
) -> None:
    boxes = random_boxes(count, widest, count + level)
    expected = set()
    for r0, r1, c0, c1 in zip(boxes.row0, boxes.row1, boxes.col0, boxes.col1, strict=True):
        # Every block of a box has one of these cells: they are closer than blocks are wide.
        cells = np.meshgrid([*range(r0, r1, 100), r1], [*range(c0, c1, 100), c1])
        expected |= read_by(GRID, level, cells[0].ravel(), cells[1].ravel())
    assert boxes.blocks(GRID, level) == sorted(expected)


def test_boxes_that_span_more_blocks_than_a_byte_counts_are_found() -> None:
    """The packed form of a range has eight bits for its height."""
    grid = Grid(300 * BLOCK, 300, 1.0)
    row0 = np.zeros(100, np.int64)
    row1 = np.full(100, 290 * BLOCK)
    boxes = Boxes(row0, row1, row0, row0)
    assert boxes.blocks(grid, 0) == [Block(0, row, 0) for row in range(291)]


def test_boxes_far_apart_on_a_vast_terrain_are_found() -> None:
    last = 2**30 - 1000
    grid = Grid(2**31 - 4000, 2**31 - 4000, 1.0, row=-last, col=-last)
    corner = np.repeat([-last, last - 5000], 50)
    found = Boxes(corner, corner, corner[::-1], corner[::-1]).blocks(grid, 0)
    low, high = -last // BLOCK, (last - 5000) // BLOCK
    assert found == [Block(0, low, high), Block(0, high, low)]


def test_no_boxes_need_nothing() -> None:
    none = np.zeros(0, np.int64)
    assert Boxes(none, none, none, none).blocks(GRID, 0) == []


def test_a_region_has_the_blocks_that_hold_its_posts_within_the_terrain() -> None:
    span = GRID.posts(1)
    whole = region_blocks(GRID, span, 1)
    inside = GRID.blocks(1)
    assert len(whole) == (inside.row1 - inside.row0) * (inside.col1 - inside.col0)
    assert region_blocks(GRID, Span(-9999, 9999, -9999, 9999), 1) == whole
    assert region_blocks(GRID, Span(-1, 1, 255, 256), 0) == [Block(0, -1, 0), Block(0, 0, 0)]


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"row": np.nan}, "row must be finite, got nan"),
        ({"col": np.inf}, "col must be finite, got inf"),
        ({"radius": np.nan}, "radius must be finite and not negative, got nan"),
        ({"radius": -1.0}, "radius must be finite and not negative, got -1.0"),
        ({"level": -1}, "level must not be negative, got -1"),
    ],
)
def test_a_disc_that_is_nowhere_is_refused(values: dict[str, Any], words: str) -> None:
    good: dict[str, Any] = {"row": 0.0, "col": 0.0, "radius": 1.0}
    with pytest.raises(InputError, match=words):
        Disc(**(good | values))
