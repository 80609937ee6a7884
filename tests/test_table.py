"""Pointer tables: every block is found where it was put, on host and device."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import warp as wp

import terrasim as ts
from terrasim.cache.pool import BLOCK_BYTES
from terrasim.cache.table import Table, table_entries
from terrasim.counts import Counts
from terrasim.errors import InputError
from terrasim.grid import Block, Grid, Indices
from terrasim.kernels.addressing import ABSENT, HEADER, PAGE
from terrasim.sources.source import BlockData, read_block

WIDE = Grid(70_000, 90_000, 1.0, row=-33_333, col=-50_001)
"""Five pages by six or seven at level 0."""
CPU = wp.get_device("cpu")


def look_up(table: Table, key: Block) -> int:
    """A block's entry by the formula that kernels/addressing.py states, with floor and modulo."""
    entries = table.entries.numpy()
    start, cols, row0, col0 = entries[HEADER * key.level : HEADER * key.level + HEADER].tolist()
    directory = start + (key.row // PAGE - row0) * cols + key.col // PAGE - col0
    return int(entries[int(entries[directory]) + key.row % PAGE * PAGE + key.col % PAGE])


def random_block(random: np.random.Generator, grid: Grid) -> Block:
    level = int(random.integers(0, grid.levels))
    span = grid.blocks(level)
    return Block(
        level,
        int(random.integers(span.row0, span.row1)),
        int(random.integers(span.col0, span.col1)),
    )


def corners(grid: Grid) -> Iterator[Block]:
    """First and last block of every level."""
    for level in range(grid.levels):
        span = grid.blocks(level)
        for row in (span.row0, span.row1 - 1):
            for col in (span.col0, span.col1 - 1):
                yield Block(level, row, col)


def test_a_new_table_holds_nothing() -> None:
    table = Table(WIDE, 20, CPU)
    assert {look_up(table, key) for key in corners(WIDE)} == {ABSENT}
    assert {table.get(key) for key in corners(WIDE)} == {ABSENT}


def test_a_table_is_as_long_as_announced() -> None:
    for layers in (8, 20, 500):
        assert len(Table(WIDE, layers, CPU).entries) == table_entries(WIDE, layers)


def test_random_changes_equal_a_dictionary() -> None:
    """With never more blocks than layers, so that every page in use has one of them."""
    layers = 25
    random = np.random.default_rng(0)
    table, plain = Table(WIDE, layers, CPU), dict[Block, int]()
    for step in range(6000):
        key = random_block(random, WIDE)
        if plain and (len(plain) == layers or random.random() < 0.4):
            key = list(plain)[int(random.integers(len(plain)))]
            table.clear(key)
            del plain[key]
        else:
            plain[key] = step
            table.set(key, step)
        other = random_block(random, WIDE)
        table.clear(other)
        plain.pop(other, None)
        for probe in (key, other, random_block(random, WIDE)):
            expected = plain.get(probe, ABSENT)
            assert table.get(probe) == look_up(table, probe) == expected
    for key, value in plain.items():
        assert look_up(table, key) == value
    assert np.count_nonzero(table.entries.numpy()[-layers * PAGE * PAGE :] != ABSENT) == len(plain)


def test_every_block_of_a_small_terrain_has_an_entry_of_its_own() -> None:
    grid = Grid(3000, 2000, 1.0, row=-1500, col=-700)
    keys = [
        Block(level, row, col)
        for level in range(grid.levels)
        for span in [grid.blocks(level)]
        for row in range(span.row0, span.row1)
        for col in range(span.col0, span.col1)
    ]
    table = Table(grid, len(keys), CPU)
    for layer, key in enumerate(keys):
        table.set(key, layer)
    assert [look_up(table, key) for key in keys] == list(range(len(keys)))
    for key in keys[::2]:
        table.clear(key)
    assert [look_up(table, key) for key in keys[1::2]] == list(range(1, len(keys), 2))


def test_publishing_on_the_cpu_changes_nothing() -> None:
    table = Table(WIDE, 20, CPU)
    table.set(Block(0, 3, 3), 7)
    before = table.entries.numpy().copy()
    table.publish()
    assert np.array_equal(table.entries.numpy(), before)


class Slope:
    """Heights that a formula gives anywhere, so that a vast terrain costs nothing."""

    synthetic = "slope"
    grid = WIDE

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        row, col = self.grid.clamp_rows(rows << level), self.grid.clamp_cols(cols << level)
        return (row[:, None] * 7919 + col[None, :] * 104_729).astype(np.int64).astype(np.int32)

    def block(self, key: Block) -> BlockData:
        return read_block(self, key, 0)


def test_kernels_find_blocks_of_any_page() -> None:
    random = np.random.default_rng(3)
    with ts.Terrain(Slope(), pool_bytes=40 * BLOCK_BYTES) as terrain:
        for level in range(WIDE.levels):
            rows = WIDE.row + random.integers(1 << level, WIDE.rows, 200) >> level << level
            cols = WIDE.col + random.integers(1 << level, WIDE.cols, 200) >> level << level
            points = np.column_stack([cols, rows]).astype(np.float64)
            found = ts.sample(terrain, points, level=level)
            posts = (rows * 7919 + cols * 104_729).astype(np.int32)
            assert np.array_equal(found.height, posts * 1e-5)
        assert terrain.cache.counters.evictions > 300


def test_a_terrain_too_large_for_a_table_is_refused() -> None:
    side = 2**31 - 10
    grid = Grid(side, side, 1.0, row=-(2**30) + 2, col=-(2**30) + 2)
    with pytest.raises(InputError, match="at most 2147483647 can be addressed; take fewer posts"):
        table_entries(grid, 8)
    narrow = Grid(side, 9, 1.0, row=-(2**30) + 2)
    assert table_entries(narrow, 8) < 2**20
