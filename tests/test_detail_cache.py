"""Detail blocks in the pool: they come, go and come back with the level-0 block they lie on."""

from __future__ import annotations

import time

import numpy as np
import numpy.typing as npt
import pytest
from detail_oracle import block_of, put, rough

from terrasim.cache.coarsen import coarsen
from terrasim.cache.needs import Disc
from terrasim.cache.pool import BLOCK_BYTES
from terrasim.counts import HOLE, MAX_COUNT, Counts
from terrasim.detail.grid import DetailGrid
from terrasim.errors import InputError, RunError
from terrasim.grid import Block, Grid, Indices
from terrasim.kernels.addressing import ABSENT
from terrasim.query import sample
from terrasim.raycast import raycast
from terrasim.sources.array_source import ArraySource
from terrasim.sources.source import BlockData, describe
from terrasim.terrain import Terrain

FACTOR = 4
GRID = Grid(1500, 1500, 1.0, row=-300, col=-20)
DETAIL = DetailGrid(GRID, FACTOR)
BASES = [Block(0, row, col) for row in range(-2, 5) for col in range(-1, 6)]
ROUGH = ArraySource(rough(1500, 1500, 1), GRID)


def terrain_of(layers: int = 12, detail_layers: int = 8, **options: object) -> Terrain:
    """A terrain with small pools."""
    return Terrain(
        ROUGH,
        pool_bytes=layers * BLOCK_BYTES,
        detail_factor=FACTOR,
        detail_pool_bytes=detail_layers * BLOCK_BYTES,
        **options,  # type: ignore[arg-type]
    )


def on(base: Block, number: int = 0) -> Block:
    """One of a level-0 block's detail blocks."""
    span = DETAIL.blocks_in(base)
    return Block(-1, span.row0 + number // FACTOR, span.col0 + number % FACTOR)


def need(base: Block) -> Disc:
    """What needs one level-0 block alone."""
    return Disc(base.row * 256 + 128.0, base.col * 256 + 128.0, 10.0)


def crowd_out(terrain: Terrain, *spared: Block) -> None:
    """Bring in so many other blocks that all but these leave the pool."""
    for key in BASES:
        if key not in spared:
            terrain.cache.hold([key])


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


def test_detail_makes_room_for_detail_whole_blocks_at_a_time_the_least_used_first() -> None:
    with terrain_of(layers=40, detail_layers=6) as terrain:
        cache = terrain.cache
        for n, base in enumerate(BASES[:3]):
            put(terrain, {on(base, 1): block_of(n, 50), on(base, 2): block_of(n + 9, 50)})
        cache.hold([BASES[0]])
        cache.hold_details([on(BASES[4], 7)])
        # The second went, both its blocks, though there is room for its posts.
        assert not cache.is_resident(BASES[1])
        assert not cache.is_resident(on(BASES[1], 1))
        assert cache.is_resident(on(BASES[0], 1))
        assert cache.is_resident(on(BASES[2], 2))
        assert cache.counters.evictions == 1


def test_more_detail_than_the_pool_holds_is_refused_and_names_what_to_raise() -> None:
    with terrain_of(layers=40, detail_layers=6) as terrain:
        put(terrain, {on(BASES[0], n): block_of(n, 50) for n in range(4)})
        put(terrain, {on(BASES[1], n): block_of(n, 50) for n in range(4)})
        message = "8 detail blocks are needed at once but the pool holds 6; raise detail_pool_bytes"
        with pytest.raises(RunError, match=message):
            terrain.cache.hold(BASES[:2])
        with pytest.raises(RunError, match="7 detail blocks"):
            terrain.cache.hold_details([on(BASES[0], n) for n in range(4, 7)])
        assert terrain.cache.details(BASES[0]) == [on(BASES[0], n) for n in range(4)]
        terrain.cache.hold_details([on(BASES[0], n) for n in range(6)])
    with Terrain(ROUGH) as terrain, pytest.raises(RunError, match="has no detail"):
        terrain.cache.hold_details([Block(-1, 0, 0)])


def test_queries_and_rays_over_more_detail_than_fits_go_by_parts() -> None:
    rng = np.random.default_rng(3)
    points = rng.uniform(-10.0, 1000.0, (3000, 2))
    origins = np.column_stack([rng.uniform(-10.0, 1000.0, (300, 2)), np.full(300, 2.0)])
    ways = rng.normal(size=(300, 3)) * [1.0, 1.0, 0.02]
    blocks = {on(base, n): block_of(n, 50) for base in BASES for n in (0, 10, 15)}
    answers = []
    for detail_layers in (12, 1000):
        with terrain_of(layers=70, detail_layers=detail_layers) as terrain:
            put(terrain, blocks)
            hits = raycast(terrain, origins, ways, max_distance=900.0)
            found = sample(terrain, points).height
            answers.append((found.tobytes(), hits.distance.tobytes(), hits.point.tobytes()))
    assert answers[0] == answers[1]


def test_a_point_whose_blocks_have_more_detail_than_fits_is_refused() -> None:
    corner = [Block(0, 0, 0), Block(0, 0, 1), Block(0, 1, 0), Block(0, 1, 1)]
    with terrain_of(layers=40, detail_layers=6) as terrain:
        for base in corner:
            put(terrain, {on(base, n): block_of(n, 50) for n in range(2)})
        with pytest.raises(RunError, match="raise detail_pool_bytes"):
            sample(terrain, [[255.5, 255.5]])
        with pytest.raises(RunError, match="raise detail_pool_bytes"):
            raycast(terrain, [[255.5, 255.5, 9.0]], [[0.0, 0.0, -1.0]], max_distance=20.0)
        assert np.isfinite(sample(terrain, [[254.5, 255.5]]).height).all()


def test_needs_with_more_detail_than_fits_are_coarsened_the_most_detailed_first() -> None:
    """The same ones whatever was resident, whether or not edits had been written back."""
    for crowded in (False, True):
        with terrain_of(layers=40, detail_layers=6) as terrain:
            for base, count in zip(BASES[:3], (2, 4, 3), strict=True):
                put(terrain, {on(base, n): block_of(n, 50) for n in range(count)})
            # Zero again, so it does not count, written back or not.
            put(terrain, {on(BASES[0], 1): np.zeros((256, 256), np.int32)})
            if crowded:
                crowd_out(terrain, *BASES[:3])
            terrain.cache.require([need(base) for base in BASES[:5]])
            assert terrain.cache.counters.coarsened == 1
            there = [base for base in BASES[:5] if terrain.cache.required.get(base) != ABSENT]
            assert there == [BASES[0], BASES[2], BASES[3], BASES[4]]
            up = Block(1, BASES[1].row >> 1, BASES[1].col >> 1)
            assert terrain.cache.required.get(up) != ABSENT
            assert all(terrain.cache.is_resident(on(base)) for base in (BASES[0], BASES[2]))


def test_coarsening_for_detail_alone_leaves_needs_without_it_where_they_are() -> None:
    counts = {BASES[0]: 5, BASES[1]: 2, BASES[2]: 2}
    needs = [need(base) for base in BASES[:4]]
    fitting = coarsen(needs, GRID, 100, frozenset(), lambda key: counts.get(key, 0), 4)
    assert fitting.steps == 1
    assert set(BASES[1:4]) < set(fitting.blocks)
    assert {key.level for key in fitting.raised} == {1}
    # Two needs of one block: its detail is gone only when both are raised.
    fitting = coarsen([*needs, needs[0]], GRID, 100, frozenset(), lambda key: counts.get(key, 0), 4)
    assert fitting.steps == 2
    assert BASES[0] not in fitting.blocks


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


def test_what_got_too_much_detail_since_is_left_to_the_levels_above() -> None:
    with terrain_of(layers=40, detail_layers=6) as terrain:
        cache = terrain.cache
        for base in BASES[:2]:
            put(terrain, {on(base, n): block_of(n, 50) for n in range(3)})
        cache.require([need(base) for base in BASES[:3]])
        put(terrain, {on(BASES[1], 3): block_of(3, 50)})
        assert not cache.is_resident(BASES[0])
        cache.restore()
        there = [base for base in BASES[:3] if cache.required.get(base) != ABSENT]
        assert there == [BASES[0], BASES[2]]
        assert cache.counters.coarsened == 1


def test_what_is_wanted_is_what_its_detail_leaves_room_for() -> None:
    with terrain_of(layers=40, detail_layers=6) as terrain:
        for base in BASES[:4]:
            put(terrain, {on(base, n): block_of(n, 50) for n in range(2)})
        crowd_out(terrain, *BASES[:4])
        terrain.cache.require([need(BASES[0])])
        terrain.cache.want([need(base) for base in BASES[1:4]])
        for _ in range(3000):
            terrain.cache.work(10.0)
            if not terrain.cache.pending:
                break
            time.sleep(0.001)
        assert terrain.cache.pending == 0
        assert [terrain.cache.is_resident(base) for base in BASES[:4]] == [True, True, True, False]


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
