"""Detail blocks in the pool: they come, go and come back with the level-0 block they lie on."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from detail_oracle import block_of, put
from detail_pool import BASES, DETAIL, FACTOR, GRID, ROUGH, crowd_out, need, on, terrain_of

from terrasim.counts import HOLE, MAX_COUNT, Counts
from terrasim.errors import InputError
from terrasim.grid import Block, Grid, Indices
from terrasim.kernels.addressing import ABSENT
from terrasim.query import sample
from terrasim.sources.array_source import ArraySource
from terrasim.sources.source import BlockData, describe
from terrasim.terrain import Terrain


def shown(terrain: Terrain, key: Block) -> list[int]:
    """Layers of a detail block in both tables."""
    table = terrain.cache.detail_table
    assert table is not None
    first = table.start + terrain.cache.pool.layers - terrain.cache.detail_capacity
    found = []
    for entries in (terrain.cache.resident.entries.numpy(), terrain.cache.required.entries.numpy()):
        slots = entries[first:].reshape(-1, 3).tolist()
        there = [layer for row, col, layer in slots if layer >= 0 and (row, col) == key[1:]]
        assert len(there) <= 1
        found.append(there[0] if there else ABSENT)
    return found


def flags(terrain: Terrain) -> list[Block]:
    """Resident level-0 blocks whose flags say that they have detail, the same in both tables."""
    table = terrain.cache.detail_table
    assert table is not None
    places = {key: table.start + terrain.cache.layer_of(key) for key in terrain.cache.residents}
    marked = [
        [key for key, place in places.items() if entries.numpy()[place] == 1]
        for entries in (terrain.cache.resident.entries, terrain.cache.required.entries)
    ]
    assert marked[0] == marked[1]
    return marked[0]


def test_held_detail_begins_zero_lies_behind_the_base_and_is_found_in_both_tables() -> None:
    with terrain_of() as terrain:
        base = BASES[8]
        keys = [on(base, 5), on(base, 0)]
        layers = terrain.cache.hold_detail(base, keys)
        assert min(layers) >= terrain.cache.pool.layers - terrain.cache.detail_capacity
        for key, layer in zip(keys, layers, strict=True):
            assert not terrain.cache.pool.read(layer).any()
            assert shown(terrain, key) == [layer, layer]
            assert terrain.cache.layer_of(key) == layer
            assert terrain.cache.is_resident(key)
        assert flags(terrain) == [base]
        assert terrain.cache.residents.count(base) == 1


def test_detail_that_was_held_and_not_edited_is_gone_at_the_next_call() -> None:
    with terrain_of() as terrain:
        terrain.cache.hold_details([on(BASES[3]), on(BASES[9])])
        terrain.cache.hold_details([on(BASES[9])])
        assert not terrain.cache.is_resident(on(BASES[3]))
        assert flags(terrain) == [BASES[9]]
        terrain.cache.require([])
        assert flags(terrain) == []
        assert terrain.ground.edited == []


def test_detail_leaves_with_its_block_and_comes_back_with_it_to_the_bit() -> None:
    points = np.random.default_rng(1).uniform(0.0, 250.0, (500, 2))
    with terrain_of() as terrain:
        base = Block(0, 0, 0)
        blocks = {on(base, n): block_of(n, 30_000) for n in (0, 5, 15)}
        put(terrain, blocks)
        before = sample(terrain, points).height.tobytes()
        ranges = terrain.cache.describe(base)
        crowd_out(terrain, base)
        assert not terrain.cache.is_resident(base)
        assert not any(terrain.cache.is_resident(key) for key in blocks)
        assert all(shown(terrain, key) == [ABSENT, ABSENT] for key in blocks)
        assert flags(terrain) == []
        assert terrain.cache.details(base) == sorted(blocks)
        assert sample(terrain, points).height.tobytes() == before
        assert terrain.cache.describe(base) == ranges
        for key, posts in blocks.items():
            assert np.array_equal(terrain.cache.pool.read(terrain.cache.layer_of(key)), posts)
            assert terrain.cache.describe(key) == (int(posts.min()), int(posts.max()), 0)


def test_a_blocks_range_takes_in_its_detail_rounded_outward_and_loses_it_again() -> None:
    with terrain_of() as terrain:
        cache, base = terrain.cache, Block(0, 1, 1)
        cache.hold([base])
        own = cache.describe(base)
        posts = np.zeros((256, 256), np.int32)
        posts[3, 4], posts[5, 6] = 4_000_001, -4_000_001
        put(terrain, {on(base, 3): posts})
        assert cache.describe(base) == (own[0] - 1_000_001, own[1] + 1_000_001, 0)
        layer = cache.layer_of(base)
        assert cache.highest[layer] == own[1] + 1_000_001
        assert terrain.ground.block(base).highest == own[1]
        cache.flush()
        assert terrain.ground.block(base).highest == own[1] + 1_000_001
        crowd_out(terrain, base)
        # The base alone changes: its own range is what is told, not what was stored.
        [layer] = cache.hold([base])
        cache.edited(base, own[0] - 7, own[1] + 9, 0)
        assert cache.describe(base) == (own[0] - 7 - 1_000_001, own[1] + 9 + 1_000_001, 0)
        put(terrain, {on(base, 3): np.zeros((256, 256), np.int32)})
        assert cache.describe(base) == (own[0] - 7, own[1] + 9, 0)


def test_a_range_stays_within_what_an_int32_holds_and_a_block_of_holes_keeps_none() -> None:
    posts = np.full((300, 300), MAX_COUNT, np.int32)
    posts[:256, :256] = HOLE
    with Terrain(ArraySource(posts, Grid(300, 300, 1.0)), detail_factor=2) as terrain:
        high = np.full((256, 256), 100, np.int32)
        put(terrain, {Block(-1, 0, 0): high, Block(-1, 2, 2): high})
        assert terrain.cache.describe(Block(0, 0, 0)) == (HOLE, HOLE, 0)
        assert terrain.cache.describe(Block(0, 1, 1)) == (MAX_COUNT, MAX_COUNT, 0)


def test_detail_that_is_zero_again_is_dropped_when_it_is_written_back() -> None:
    with terrain_of() as terrain:
        cache, base = terrain.cache, Block(0, 1, 1)
        key = on(base, 6)
        put(terrain, {key: block_of(1, 500)})
        crowd_out(terrain, base)
        assert terrain.ground.details(base) == [key]
        put(terrain, {key: np.zeros((256, 256), np.int32)})
        assert cache.details(base) == []
        cache.hold([base])
        assert not cache.is_resident(key)
        assert flags(terrain) == []
        assert terrain.ground.details(base) == []
        assert terrain.ground.kept()[key].data is None
        assert not terrain.ground.block(key).posts.any()


def test_edits_are_what_a_store_is_given_and_forgets_what_it_holds() -> None:
    with terrain_of() as terrain:
        base = Block(0, 0, 3)
        first, second = on(base, 1), on(base, 2)
        put(terrain, {first: block_of(1, 500), second: block_of(2, 500)})
        assert terrain.cache.dirty == 3
        terrain.cache.flush()
        kept = terrain.ground.kept()
        assert sorted(kept) == [first, second, base]
        put(terrain, {second: block_of(3, 500)})
        terrain.cache.flush()
        terrain.ground.forget(kept)
        assert second in terrain.ground.edited
        assert first not in terrain.ground.edited
        terrain.ground.clear()
        terrain.cache.discard()
        assert terrain.cache.details(base) == []
        assert flags(terrain) == []
        terrain.cache.hold([base])
        assert flags(terrain) == []


class WithDetail:
    """A source that holds detail itself, as a store does."""

    def __init__(self, blocks: dict[Block, Counts]) -> None:
        self.grid, self.synthetic, self.detail_factor = GRID, "", FACTOR
        self._blocks = blocks
        self.read: list[Block] = []

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        return ROUGH.posts(level, rows, cols)

    def block(self, key: Block) -> BlockData:
        self.read.append(key)
        return describe(self._blocks[key], 0) if key.level < 0 else ROUGH.block(key)

    def details(self, key: Block) -> list[Block]:
        return [one for one in self._blocks if DETAIL.base_of(one) == key]


def test_a_source_may_hold_detail_and_says_its_factor() -> None:
    base = Block(0, 0, 0)
    blocks = {on(base, n): block_of(n, 30_000) for n in (3, 9)}
    points = np.random.default_rng(2).uniform(0.0, 250.0, (300, 2))
    with terrain_of() as terrain:
        put(terrain, blocks)
        expected = sample(terrain, points).height.tobytes()
    source = WithDetail(blocks)
    with Terrain(source) as terrain:
        assert terrain.detail.factor == FACTOR
        assert sample(terrain, points).height.tobytes() == expected
        zero = np.zeros((256, 256), np.int32)
        put(terrain, {on(base, 3): zero, on(base, 4): block_of(4, 10)})
        terrain.cache.flush()
        # What was written stands before what the source has.
        assert terrain.ground.details(base) == [on(base, 4), on(base, 9)]
    with pytest.raises(InputError, match="detail_factor must be 4, that of the source's detail"):
        Terrain(source, detail_factor=8)


def test_a_source_that_lists_a_detail_block_is_asked_for_no_other() -> None:
    base = Block(0, 0, 0)
    source = WithDetail({on(base, 3): block_of(1, 10)})
    with Terrain(source) as terrain:
        terrain.cache.hold([Block(0, 1, 1), base])
        assert [key for key in source.read if key.level < 0] == [on(base, 3)]


def test_what_a_step_requires_is_brought_back_with_its_detail() -> None:
    with terrain_of(layers=12, detail_layers=8) as terrain:
        base = Block(0, 0, 0)
        put(terrain, {on(base, 3): block_of(1, 50)})
        terrain.cache.require([need(base)])
        terrain.cache.hold([key for key in BASES if key != base][: terrain.cache.capacity])
        assert not terrain.cache.is_resident(base)
        terrain.cache.restore()
        assert terrain.cache.required.get(base) == terrain.cache.layer_of(base)
        assert flags(terrain) == [base]
        assert shown(terrain, on(base, 3))[1] == terrain.cache.layer_of(on(base, 3))


@pytest.mark.parametrize("seed", range(3))
def test_any_order_of_edits_and_evictions_leaves_the_same_ground(seed: int) -> None:
    """A small pool against plain arrays: what was written is what is there, wherever it is."""
    rng = np.random.default_rng(seed)
    plain: dict[Block, npt.NDArray[np.int32]] = {}
    with terrain_of(layers=14, detail_layers=9) as terrain:
        cache = terrain.cache
        for _ in range(150):
            base = BASES[int(rng.integers(len(BASES)))]
            act = int(rng.integers(4))
            if act == 0:
                cache.require([need(base), need(BASES[int(rng.integers(len(BASES)))])])
                cache.want([need(one) for one in BASES[:5]])
                cache.work(1.0)
            elif act == 1:
                cache.hold([base])
            else:
                key = on(base, int(rng.integers(3)))
                posts = block_of(int(rng.integers(1000)), 50) * np.int32(rng.random() < 0.7)
                put(terrain, {key: posts})
                plain[key] = posts
            for key in cache.residents:
                there = [one for one in plain if DETAIL.base_of(one) == key and plain[one].any()]
                assert cache.details(key) == (sorted(there) if key.level == 0 else [])
                for one in there if key.level == 0 else []:
                    layer = cache.layer_of(one)
                    assert shown(terrain, one) == [layer, layer]
                    assert np.array_equal(cache.pool.read(layer), plain[one])
        cache.flush()
        for key, posts in plain.items():
            assert np.array_equal(terrain.ground.block(key).posts, posts)
