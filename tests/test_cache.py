"""What is resident, when, and what the counters say about it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence

import numpy as np
import pytest

import terrasim as ts
from terrasim.cache.needs import Boxes, Disc, Need, region_blocks
from terrasim.cache.pool import BLOCK_BYTES
from terrasim.counts import Counts
from terrasim.errors import RunError
from terrasim.grid import Block, Grid, Indices
from terrasim.kernels.addressing import ABSENT, BLOCK
from terrasim.sources.source import BlockData, read_block

SIDE = 8
"""Level-0 blocks along a side; then 4, 2 and one at the top."""
GRID = Grid(SIDE * BLOCK - 8, SIDE * BLOCK - 8, 1.0)
TOP = Block(3, 0, 0)
LAYERS = 8
"""The least a pool may have: seven beside the top."""
WAIT_S = 30.0
"""Longest wait for a thread; only a failing test waits so long."""


class Numbered:
    """Every post has its own height and every block its own error; what is read is written down."""

    synthetic = "numbered"

    def __init__(self) -> None:
        self.grid = GRID
        self.read: list[Block] = []
        self.before: Callable[[Block], None] | None = None

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        row, col = self.grid.clamp_rows(rows << level), self.grid.clamp_cols(cols << level)
        return (row[:, None] * 4096 + col[None, :]).astype(np.int32)

    def block(self, key: Block) -> BlockData:
        self.read.append(key)
        if self.before:
            self.before(key)
        return read_block(self, key, error_of(key))


def error_of(key: Block) -> int:
    """An error that tells levels and blocks apart."""
    return key.level * 1000 + key.row * 10 + key.col


def on(row: int, col: int, level: int = 0) -> Disc:
    """A need that lies inside one block."""
    scale = BLOCK << level
    return Disc((row + 0.5) * scale, (col + 0.5) * scale, 10.0, level)


def over(row0: int, row1: int, col0: int, col1: int, level: int = 0) -> Boxes:
    """A need for a rectangle of level-0 blocks, ends included, at any level without more."""
    rows = np.array([[row0 * BLOCK], [row1 * BLOCK + 200]])
    cols = np.array([[col0 * BLOCK], [col1 * BLOCK + 200]])
    return Boxes(rows[0], rows[1], cols[0], cols[1], level)


def required_of(terrain: ts.Terrain) -> set[Block]:
    """Everything in the table of what is required."""
    return {
        key
        for level in range(GRID.levels)
        for key in region_blocks(GRID, GRID.posts(level), level)
        if terrain.cache.required.get(key) != ABSENT
    }


def posts_of(terrain: ts.Terrain, key: Block) -> Counts:
    """A required block's posts as a kernel would find them."""
    return terrain.cache.pool.read(terrain.cache.required.get(key))


@pytest.fixture
def source() -> Numbered:
    return Numbered()


@pytest.fixture
def terrain(source: Numbered) -> Iterator[ts.Terrain]:
    """One loader thread, so that blocks are read in the order they are asked for."""
    with ts.Terrain(source, pool_bytes=LAYERS * BLOCK_BYTES, loaders=1) as terrain:
        yield terrain


def test_opening_reads_the_coarsest_level_and_nothing_else(
    source: Numbered, terrain: ts.Terrain
) -> None:
    assert source.read == [TOP]
    assert terrain.cache.residents == [TOP]
    assert required_of(terrain) == {TOP}
    assert terrain.cache.capacity == LAYERS - 1


def test_what_is_required_is_there_when_require_returns(terrain: ts.Terrain) -> None:
    random = np.random.default_rng(0)
    for _ in range(60):
        row, col = random.uniform(0, SIDE * BLOCK, 2)
        need = Disc(float(row), float(col), 100.0, int(random.integers(0, 4)))
        terrain.cache.require([need])
        blocks = need.blocks(GRID, need.level)
        assert required_of(terrain) == {*blocks, TOP}
        for key in blocks:
            assert terrain.cache.is_resident(key)
            expected = terrain.source.block(key)
            assert np.array_equal(posts_of(terrain, key), expected.posts)
            bounds = (expected.lowest, expected.highest, expected.error)
            assert terrain.cache.describe(key) == bounds
            layer = terrain.cache.required.get(key)
            assert terrain.error.numpy()[layer] == expected.error


def test_only_the_last_steps_blocks_are_in_the_required_table(terrain: ts.Terrain) -> None:
    """Others may well be resident."""
    terrain.cache.require([on(0, 0), on(1, 1)])
    terrain.cache.require([on(1, 1), on(2, 2)])
    assert required_of(terrain) == {Block(0, 1, 1), Block(0, 2, 2), TOP}
    assert terrain.cache.is_resident(Block(0, 0, 0))
    terrain.cache.require([])
    assert required_of(terrain) == {TOP}


def test_counters_follow_a_script(terrain: ts.Terrain) -> None:
    counters = terrain.cache.counters

    def numbers() -> tuple[int, ...]:
        c = counters
        return (c.hits, c.misses, c.stalls, c.loads, c.evictions, c.written_back)

    assert numbers() == (0, 0, 0, 1, 0, 0)
    terrain.cache.require([on(0, 0)])
    assert numbers() == (0, 1, 1, 2, 0, 0)
    terrain.cache.require([on(0, 0)])
    assert numbers() == (1, 1, 1, 2, 0, 0)
    terrain.cache.require([over(0, 0, 0, 2), on(0, 1)])
    assert numbers() == (2, 3, 2, 4, 0, 0)
    terrain.cache.require([Disc(1.0, 1.0, 5.0, level=3)])
    assert numbers() == (3, 3, 2, 4, 0, 0)
    terrain.cache.require([over(1, 1, 0, 4)])
    assert numbers() == (3, 8, 3, 9, 1, 0)
    assert counters.load_bytes == 9 * BLOCK_BYTES
    terrain.cache.edited(Block(0, 1, 0), 0, 1, 2)
    terrain.cache.hold([Block(1, 3, col) for col in range(4)])
    terrain.cache.hold([Block(0, 7, col) for col in range(7)])
    assert numbers() == (3, 8, 3, 20, 12, 1)
    assert counters.coarsened == counters.fallbacks == counters.off_terrain == 0


def test_the_least_recently_used_block_goes_first(terrain: ts.Terrain) -> None:
    cache = terrain.cache
    for col in range(7):
        cache.require([on(0, col)])
    cache.require([on(0, 0)])
    cache.hold([Block(0, 0, 2)])
    points = np.array([[4.5 * BLOCK, 0.5 * BLOCK]])
    ts.sample(terrain, points)
    went = []
    for col in range(7):
        before = set(cache.residents)
        cache.require([on(1, col)])
        (gone,) = before - set(cache.residents)
        went.append(gone.col)
    assert went == [1, 3, 5, 6, 0, 2, 4]


def test_a_block_that_a_query_read_stays_before_what_it_did_not(terrain: ts.Terrain) -> None:
    """Even where the same query brings in the block that needs the room."""
    cache = terrain.cache
    for col in range(7):
        cache.require([on(0, col)])
    points = (np.array([[0.5, 0.5], [0.5, 3.5]]) * BLOCK).tolist()
    ts.sample(terrain, points)
    assert cache.is_resident(Block(0, 0, 0))
    assert not cache.is_resident(Block(0, 0, 1))


def test_an_edited_block_comes_back_as_it_left(terrain: ts.Terrain, source: Numbered) -> None:
    cache = terrain.cache
    key = Block(0, 2, 2)
    (layer,) = cache.hold([key])
    posts = cache.pool.read(layer)
    posts[5:9, 7:200] -= 123_456
    cache.pool.write(layer, posts, 77)
    cache.edited(key, -5, 5, 77)
    assert cache.describe(key) == (-5, 5, 77)
    assert terrain.error.numpy()[layer] == 77
    cache.hold([Block(0, 7, col) for col in range(7)])
    assert not cache.is_resident(key)
    assert terrain.ground.edited == [key]
    (layer,) = cache.hold([key])
    assert np.array_equal(cache.pool.read(layer), posts)
    assert cache.describe(key) == (-5, 5, 77)
    assert terrain.error.numpy()[layer] == 77
    assert source.read.count(key) == 1


def test_a_block_that_was_read_again_without_an_edit_is_not_written_again(
    terrain: ts.Terrain,
) -> None:
    cache = terrain.cache
    cache.hold([Block(0, 2, 2)])
    cache.edited(Block(0, 2, 2), 0, 0, 0)
    for _ in range(3):
        cache.hold([Block(0, 7, col) for col in range(7)])
        cache.hold([Block(0, 2, 2)])
    assert cache.counters.written_back == 1


def test_flushed_blocks_stay_and_are_clean(terrain: ts.Terrain) -> None:
    cache = terrain.cache
    cache.hold([Block(0, 2, 2), TOP])
    cache.edited(Block(0, 2, 2), 1, 2, 3)
    cache.edited(TOP, 4, 5, 6)
    cache.flush()
    assert terrain.ground.edited == [Block(0, 2, 2), TOP]
    assert terrain.ground.block(TOP).highest == 5
    assert cache.is_resident(Block(0, 2, 2))
    cache.flush()
    assert cache.counters.written_back == 2


def test_more_blocks_than_the_pool_holds_are_refused_with_the_remedy(terrain: ts.Terrain) -> None:
    cache = terrain.cache
    keys = [Block(0, 0, col) for col in range(8)]
    with pytest.raises(RunError, match=r"8 blocks .* holds 7; raise pool_bytes"):
        cache.hold(keys)
    assert cache.residents == [TOP]
    assert len(cache.hold([*keys[:7], TOP])) == LAYERS


def test_layers_are_given_in_the_order_asked_also_for_a_block_asked_twice(
    terrain: ts.Terrain,
) -> None:
    a, b = Block(0, 0, 0), Block(0, 0, 1)
    layers = terrain.cache.hold([b, a, b, TOP])
    assert layers == [terrain.cache.resident.get(key) for key in (b, a, b, TOP)]


# Coarsening


def test_the_finest_and_largest_need_is_coarsened_first(terrain: ts.Terrain) -> None:
    """9 + 4 + 1 blocks of level 0; the nine become four, then the four become one."""
    cache = terrain.cache
    cache.require([on(7, 7), over(4, 5, 4, 5), over(0, 2, 0, 2)])
    stand_in = {Block(1, row, col) for row in (0, 1) for col in (0, 1)}
    assert required_of(terrain) == {Block(0, 7, 7), Block(1, 2, 2), *stand_in, TOP}
    assert cache.counters.coarsened == 2
    assert cache.counters.coarsened_error == error_of(Block(1, 2, 2))


def test_a_coarser_need_is_raised_only_when_no_finer_one_is_left(terrain: ts.Terrain) -> None:
    """5 + 4 blocks: the larger is raised to the smaller's level, then as the larger again."""
    cache = terrain.cache
    cache.require([over(0, 1, 4, 7, level=1), over(0, 4, 1, 1)])
    assert required_of(terrain) == {
        *(Block(1, 0, col) for col in (2, 3)),
        *(Block(0, row, 1) for row in range(5)),
        TOP,
    }
    assert cache.counters.coarsened == 0
    cache.require([over(0, 3, 4, 7, level=1), over(0, 4, 1, 1)])
    assert required_of(terrain) == {
        *(Block(1, row, col) for row in (0, 1) for col in (2, 3)),
        *(Block(1, row, 0) for row in range(3)),
        TOP,
    }
    assert cache.counters.coarsened == 1


def test_of_two_needs_alike_the_first_is_coarsened(terrain: ts.Terrain) -> None:
    terrain.cache.require([over(0, 1, 0, 1), over(4, 5, 4, 5)])
    fine = {Block(0, row, col) for row in (4, 5) for col in (4, 5)}
    assert required_of(terrain) == {Block(1, 0, 0), *fine, TOP}


def test_needs_that_share_blocks_are_counted_once(terrain: ts.Terrain) -> None:
    terrain.cache.require([over(0, 0, 0, 6), over(0, 0, 0, 5), on(0, 3), on(0, 0, level=3)])
    assert terrain.cache.counters.coarsened == 0
    assert required_of(terrain) == {TOP, *(Block(0, 0, col) for col in range(7))}


def test_a_need_for_everything_ends_at_the_level_that_fits(terrain: ts.Terrain) -> None:
    terrain.cache.require([Disc(1000.0, 1000.0, 5000.0)])
    assert required_of(terrain) == {TOP, *(Block(2, row, col) for row in (0, 1) for col in (0, 1))}
    assert terrain.cache.counters.coarsened == 2
    assert terrain.cache.counters.coarsened_error == error_of(Block(2, 1, 1))


def test_a_need_without_blocks_is_not_coarsened(terrain: ts.Terrain) -> None:
    none = np.zeros(0, np.int64)
    terrain.cache.require([Boxes(none, none, none, none), over(0, 3, 0, 3, level=1)] * 2)
    terrain.cache.require([Boxes(none, none, none, none), over(0, 7, 0, 7, level=1)])
    assert terrain.cache.counters.coarsened == 1


def test_a_need_coarser_than_the_top_gets_the_top(terrain: ts.Terrain) -> None:
    terrain.cache.require([on(0, 0, level=5)])
    assert required_of(terrain) == {TOP}
    terrain.cache.want([on(0, 0, level=5)])
    assert terrain.cache.pending == 0


NEEDS: list[Sequence[Need]] = [
    [over(0, 3, 0, 3), on(7, 7)],
    [over(1, 2, 1, 4), over(1, 3, 5, 6, level=1)],
    [Disc(900.0, 1200.0, 400.0), Disc(100.0, 100.0, 300.0), on(3, 3, level=1)],
    [on(2, 5)],
]


def test_coarsening_is_the_same_whatever_was_resident_and_however_slow_the_disk(
    source: Numbered, terrain: ts.Terrain
) -> None:
    with ts.Terrain(Numbered(), pool_bytes=LAYERS * BLOCK_BYTES, loaders=3) as other:
        random = np.random.default_rng(0)
        source.before = lambda key: time.sleep(0.001 * ((key.row + key.col) % 4))
        for needs in NEEDS * 3:
            col = float(random.uniform(0, 2000))
            terrain.cache.want([Disc(col, 500.0, 600.0)])
            terrain.cache.work(0.1)
            ts.sample(terrain, random.uniform(0, 2000, (20, 2)))
            terrain.cache.require(needs)
            other.cache.require(needs)
            assert required_of(terrain) == required_of(other)
            assert terrain.cache.counters.coarsened == other.cache.counters.coarsened
            assert terrain.cache.counters.coarsened_error == other.cache.counters.coarsened_error
