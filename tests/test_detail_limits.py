"""More detail than its pool holds: room is made, needs are coarsened, the rest is refused."""

from __future__ import annotations

import time

import numpy as np
import pytest
from detail_oracle import block_of, put
from detail_pool import BASES, GRID, ROUGH, crowd_out, need, on, terrain_of

from terrasim.cache.coarsen import coarsen
from terrasim.errors import RunError
from terrasim.grid import Block
from terrasim.kernels.addressing import ABSENT
from terrasim.query import sample
from terrasim.raycast import raycast
from terrasim.terrain import Terrain


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
