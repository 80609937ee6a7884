"""Jobs beside the step: what is wanted, in which order, and reads that are slow or fail."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator

import numpy as np
import pytest

import terrasim as ts
from terrasim.cache.cache import Cache
from terrasim.cache.needs import Boxes, Disc, region_blocks
from terrasim.cache.pool import BLOCK_BYTES
from terrasim.counts import Counts
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
    """Every post has its own height; what is read is written down."""

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
        return read_block(self, key, 0)


class Gate:
    """Lets a source's reads through one by one, and says which have begun."""

    def __init__(self, source: Numbered) -> None:
        self.begun = threading.Semaphore(0)
        self.pass_on = threading.Semaphore(0)
        source.before = self.hold_up

    def hold_up(self, key: Block) -> None:
        self.begun.release()
        assert self.pass_on.acquire(timeout=WAIT_S)


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


def run_queue(cache: Cache, until: Callable[[], bool]) -> None:
    """Work in steps until the queue has done what is asked."""
    for _ in range(100_000):
        cache.work(1000.0)
        if until():
            return
    pytest.fail("the queue stands still")


@pytest.fixture
def source() -> Numbered:
    return Numbered()


@pytest.fixture
def terrain(source: Numbered) -> Iterator[ts.Terrain]:
    """One loader thread, so that blocks are read in the order they are asked for."""
    with ts.Terrain(source, pool_bytes=LAYERS * BLOCK_BYTES, loaders=1) as terrain:
        yield terrain


def test_wanted_blocks_come_in_the_order_of_need(terrain: ts.Terrain, source: Numbered) -> None:
    cache = terrain.cache
    wanted = [(0, 3), (5, 5), (2, 2), (7, 0), (1, 6)]
    cache.want([on(row, col) for row, col in wanted])
    assert cache.pending == 5
    run_queue(cache, lambda: not cache.pending)
    assert source.read == [TOP, *(Block(0, row, col) for row, col in wanted)]
    assert cache.counters.misses == cache.counters.stalls == 0
    assert cache.counters.loads == 6
    assert required_of(terrain) == {TOP}
    cache.require([on(row, col) for row, col in wanted])
    assert (cache.counters.hits, cache.counters.stalls) == (5, 0)


def test_without_a_budget_one_block_is_placed_a_step(source: Numbered) -> None:
    with ts.Terrain(source, pool_bytes=LAYERS * BLOCK_BYTES, loaders=4) as terrain:
        cache = terrain.cache
        cache.want([on(0, col) for col in range(7)])
        steps = 0
        while cache.pending and steps < 100_000:
            before = cache.counters.loads
            cache.work(0.0)
            steps += 1
            assert cache.counters.loads <= before + 1
        assert cache.counters.loads == 8
        assert cache.counters.queue_over == steps


def test_a_block_that_is_no_longer_wanted_is_not_read(
    terrain: ts.Terrain, source: Numbered
) -> None:
    gate = Gate(source)
    cache = terrain.cache
    cache.want([on(0, 0), on(0, 1), on(0, 2)])
    cache.work(1.0)
    assert gate.begun.acquire(timeout=WAIT_S)
    cache.want([on(7, 7)])
    cache.work(1.0)
    gate.pass_on.release(3)
    run_queue(cache, lambda: cache.is_resident(Block(0, 7, 7)))
    assert source.read == [TOP, Block(0, 0, 0), Block(0, 7, 7)]
    # What had begun could not be called back: it is placed, or it would hold its slot for ever.
    run_queue(cache, lambda: cache.is_resident(Block(0, 0, 0)))


def test_the_more_urgent_half_of_too_many_wanted_blocks_comes(terrain: ts.Terrain) -> None:
    """And what came before as less urgent makes room for it."""
    cache = terrain.cache
    needs = [on(0, col) for col in range(8)] + [on(1, col) for col in range(8)]
    for order in (needs, needs[::-1]):
        cache.require([on(5, 5), on(5, 6)])
        cache.want(order)
        run_queue(cache, lambda: not cache.pending)
        first = {need.blocks(GRID, 0)[0] for need in order[:5]}
        assert set(cache.residents) == {TOP, Block(0, 5, 5), Block(0, 5, 6), *first}


def test_the_queue_never_takes_a_required_block(terrain: ts.Terrain) -> None:
    cache = terrain.cache
    random = np.random.default_rng(1)
    cache.require([over(0, 1, 0, 2)])
    needed = required_of(terrain)
    for _ in range(40):
        row, col = random.uniform(0, 2000, 2)
        cache.want([Disc(float(row), float(col), 500.0, int(random.integers(0, 3)))])
        run_queue(cache, lambda: not cache.pending)
        assert required_of(terrain) == needed
        assert needed <= set(cache.residents)
    assert cache.counters.evictions > 20


def test_a_required_block_on_its_way_is_not_read_twice(
    terrain: ts.Terrain, source: Numbered
) -> None:
    gate = Gate(source)
    terrain.cache.want([on(0, 0)])
    terrain.cache.work(1.0)
    assert gate.begun.acquire(timeout=WAIT_S)
    gate.pass_on.release()
    terrain.cache.require([on(0, 0)])
    assert source.read == [TOP, Block(0, 0, 0)]
    assert terrain.cache.counters.stalls == 1


def test_climbing_reuses_what_the_dive_brought(source: Numbered) -> None:
    """Down through all levels and up again over the same place: nothing is read twice."""
    with ts.Terrain(source, pool_bytes=30 * BLOCK_BYTES) as terrain:
        for level in (3, 2, 1, 0, 1, 2, 3):
            need = Disc(1000.0, 1000.0, 200.0, level)
            terrain.cache.require([need])
            assert required_of(terrain) == {TOP, *need.blocks(GRID, level)}
        assert len(source.read) == len(set(source.read))
        assert terrain.cache.counters.evictions == 0
        assert terrain.cache.counters.stalls == 3


# Failures


def fail_once(source: Numbered, bad: Block) -> None:
    """Let the next read of a block fail, as a disk might."""

    def before(key: Block) -> None:
        if key == bad:
            source.before = None
            raise OSError("the disk is gone")

    source.before = before


def test_a_failed_read_of_a_required_block_is_raised_and_can_be_tried_again(
    terrain: ts.Terrain, source: Numbered
) -> None:
    cache = terrain.cache
    cache.require([on(0, 0), on(6, 6)])
    fail_once(source, Block(0, 0, 2))
    with pytest.raises(OSError, match="the disk is gone"):
        cache.require([over(0, 0, 0, 4)])
    assert required_of(terrain) <= {TOP, *(Block(0, 0, col) for col in range(5))}
    cache.require([over(0, 0, 0, 4)])
    assert required_of(terrain) == {TOP, *(Block(0, 0, col) for col in range(5))}
    for col in range(5):
        key = Block(0, 0, col)
        posts = cache.pool.read(cache.required.get(key))
        assert np.array_equal(posts, source.block(key).posts)
    cache.require([over(7, 7, 0, 6)])
    assert len(cache.residents) == LAYERS


def test_a_failed_read_of_a_wanted_block_is_raised_by_the_queue(
    terrain: ts.Terrain, source: Numbered
) -> None:
    cache = terrain.cache
    fail_once(source, Block(0, 0, 1))
    cache.want([on(0, col) for col in range(7)])
    with pytest.raises(OSError, match="the disk is gone"):
        run_queue(cache, lambda: not cache.pending)
    run_queue(cache, lambda: not cache.pending)
    assert set(cache.residents) == {TOP, *(Block(0, 0, col) for col in range(7))}
    assert terrain.cache.counters.evictions == 0


def test_a_failed_read_is_raised_by_hold_and_by_a_query(
    terrain: ts.Terrain, source: Numbered
) -> None:
    fail_once(source, Block(0, 0, 1))
    with pytest.raises(OSError, match="the disk is gone"):
        terrain.cache.hold([Block(0, 0, 0), Block(0, 0, 1)])
    fail_once(source, Block(0, 4, 4))
    points = np.array([[4.5 * BLOCK, 4.5 * BLOCK]])
    with pytest.raises(OSError, match="the disk is gone"):
        ts.sample(terrain, points)
    posts = source.posts(0, np.array([1152]), np.array([1152]))
    assert ts.sample(terrain, points).height[0] == posts[0, 0] * 1e-5
    assert len(terrain.cache.hold(Block(0, 0, col) for col in range(7))) == 7


def test_a_terrain_whose_top_cannot_be_read_does_not_open(source: Numbered) -> None:
    fail_once(source, TOP)
    threads = threading.active_count()
    with pytest.raises(OSError, match="the disk is gone"):
        ts.Terrain(source)
    assert threading.active_count() == threads


def test_what_a_step_requires_goes_last_and_in_the_same_order_always(terrain: ts.Terrain) -> None:
    """A query between ``require`` and the step takes other blocks first, then the last by key."""
    cache = terrain.cache
    cache.require([over(0, 0, 0, 3)])
    cache.want([on(7, 0), on(7, 1), on(7, 2)])
    run_queue(cache, lambda: not cache.pending)
    cache.hold([Block(0, 4, col) for col in range(3)])
    assert required_of(terrain) == {TOP, *(Block(0, 0, col) for col in range(4))}
    cache.hold([Block(0, 5, col) for col in range(5)])
    assert required_of(terrain) == {TOP, Block(0, 0, 0), Block(0, 0, 1)}
    cache.require([over(0, 0, 0, 3)])
    assert required_of(terrain) == {TOP, *(Block(0, 0, col) for col in range(4))}


def test_closing_ends_the_loader_threads(source: Numbered) -> None:
    threads = threading.active_count()
    with ts.Terrain(source, loaders=3) as terrain:
        terrain.cache.require([over(0, 2, 0, 2)])
        terrain.cache.want([over(4, 6, 0, 6)])
        terrain.cache.work(1.0)
        assert threading.active_count() > threads
    assert threading.active_count() == threads


def test_what_was_read_in_vain_does_not_block_the_queue(source: Numbered) -> None:
    """Blocks that were read but are wanted no longer give up their places among those asked for."""
    gate = Gate(source)
    gate.pass_on.release(1)
    with ts.Terrain(source, pool_bytes=LAYERS * BLOCK_BYTES, loaders=1) as terrain:
        assert gate.begun.acquire(timeout=WAIT_S)
        for row in (0, 6):
            terrain.cache.want([on(row, row)])
            terrain.cache.work(1e3)
            assert gate.begun.acquire(timeout=WAIT_S)
            # Wanted no longer once it has begun: it cannot be called back.
            terrain.cache.want([])
            gate.pass_on.release(1)
        gate.pass_on.release(100)
        terrain.cache.want([on(3, 3)])
        run_queue(terrain.cache, lambda: terrain.cache.is_resident(Block(0, 3, 3)))


def test_a_terrain_that_does_not_wait_falls_back_until_the_ground_has_come(
    source: Numbered,
) -> None:
    """The step goes on at once with the top, what it lacks is counted and comes first."""
    gate = Gate(source)
    gate.pass_on.release(1)
    with ts.Terrain(source, pool_bytes=LAYERS * BLOCK_BYTES, late="fallback") as terrain:
        cache = terrain.cache
        cache.require([on(2, 2)])
        assert (cache.counters.late, cache.counters.stalls) == (1, 0)
        assert not cache.is_resident(Block(0, 2, 2))
        cache.want([on(5, 5)])
        cache.work(1e3)
        gate.pass_on.release(100)
        run_queue(cache, lambda: cache.is_resident(Block(0, 2, 2)))
        assert source.read[1] == Block(0, 2, 2)
        cache.require([on(2, 2)])
        assert cache.counters.late == 1
        assert terrain.required is cache.resident.entries


def test_a_step_finds_what_it_required_though_a_query_displaced_it(terrain: ts.Terrain) -> None:
    """The table that contact reads is made whole again before it is handed out."""
    cache = terrain.cache
    cache.require([on(0, 0), on(4, 4)])
    cache.hold([Block(0, 7, col) for col in range(7)])
    assert not cache.is_resident(Block(0, 0, 0))
    assert terrain.required is cache.required.entries
    assert {Block(0, 0, 0), Block(0, 4, 4)} <= required_of(terrain)
    assert cache.is_resident(Block(0, 0, 0))
