"""The detail grid's numbers, its place in the pointer tables, and what a terrain refuses of it."""

from __future__ import annotations

import tracemalloc
from typing import Any

import numpy as np
import pytest
import warp as wp

from terrasim.cache.detail_table import DetailTable, section_entries
from terrasim.cache.pool import BLOCK_BYTES
from terrasim.cache.table import Table
from terrasim.detail.grid import MAX_FACTOR, DetailGrid
from terrasim.errors import InputError
from terrasim.grid import Block, Grid, Span
from terrasim.kernels.addressing import ABSENT
from terrasim.kernels.detail import detail_layer
from terrasim.kernels.lattice import Lattice
from terrasim.query import sample
from terrasim.sources.analytic import Plane
from terrasim.terrain import Terrain

CPU = wp.get_device("cpu")
GRID = Grid(600, 700, 1.0, row=-300, col=-270)


@wp.kernel(enable_backward=False)  # type: ignore[untyped-decorator]
def find(
    table: wp.array(dtype=int),  # type: ignore[valid-type]
    lattice: Lattice,
    keys: wp.array(dtype=wp.vec2i),  # type: ignore[valid-type]
    layer_out: wp.array(dtype=int),  # type: ignore[valid-type]
) -> None:
    i = wp.tid()
    layer_out[i] = detail_layer(table, lattice, keys[i][0], keys[i][1])


def found_by_kernels(table: Table, detail: DetailTable, layers: int, keys: list[Block]) -> Any:
    """Layers of detail blocks as a kernel finds them."""
    lattice: Any = Lattice()
    lattice.factor, lattice.detail = 2, detail.start
    lattice.layers, lattice.mask = layers, detail.mask
    asked: Any = wp.array([key[1:] for key in keys], dtype=wp.vec2i, device=CPU)
    answer = wp.zeros(len(keys), dtype=int, device=CPU)
    wp.launch(find, dim=len(keys), inputs=[table.entries, lattice, asked], outputs=[answer])
    return answer.numpy()


@pytest.mark.parametrize("factor", [1, 2, 3, 7, 64, 1024])
def test_a_level_0_block_holds_factor_by_factor_detail_blocks_and_no_other_does(
    factor: int,
) -> None:
    detail = DetailGrid(GRID, factor)
    blocks = GRID.blocks(0)
    assert (detail.row0, detail.col0) == (-512, -512)
    for row in range(blocks.row0, blocks.row1):
        for col in range(blocks.col0, blocks.col1):
            span = detail.blocks_in(Block(0, row, col))
            assert (span.row1 - span.row0, span.col1 - span.col0) == (factor, factor)
            for r in (span.row0, span.row1 - 1):
                for c in (span.col0, span.col1 - 1):
                    assert detail.base_of(Block(-1, r, c)) == Block(0, row, col)


def test_detail_posts_are_numbered_from_the_terrains_first_block() -> None:
    detail = DetailGrid(GRID, 3)
    assert detail.posts == Span(212 * 3, (212 + 599) * 3 + 1, 242 * 3, (242 + 699) * 3 + 1)
    assert detail.blocks == Span(2, 10, 2, 12)
    assert detail.spacing == pytest.approx(1.0 / 3.0, rel=1e-15)


def test_terrains_that_differ_by_whole_blocks_alone_number_their_detail_alike() -> None:
    away = Grid(600, 700, 1.0, row=-300 + 256 * 3_000_000, col=-270 - 256 * 3_000_000)
    there, here = DetailGrid(away, 64), DetailGrid(GRID, 64)
    assert there.posts == here.posts
    assert there.blocks == here.blocks


@pytest.mark.parametrize("factor", [0, -1, 2.0, 2.5, "2", None, True, MAX_FACTOR + 1, float("nan")])
def test_a_factor_that_is_no_whole_number_in_range_is_refused_by_name(factor: Any) -> None:
    with pytest.raises(InputError, match=r"^detail_factor must be a whole number from 1 to 4096"):
        DetailGrid(GRID, factor)


def test_more_detail_posts_than_can_be_numbered_are_refused_with_what_could_be() -> None:
    wide = Grid(2_000_000, 100, 1.0)
    with pytest.raises(InputError, match=r"detail_factor = 1024 .* take at most 536 here"):
        DetailGrid(wide, 1024)
    assert DetailGrid(wide, 536).blocks.row1 == (1_999_999 * 536 >> 8) + 1


@pytest.mark.parametrize("seed", range(4))
def test_the_hash_of_detail_blocks_answers_as_a_dictionary_does(seed: int) -> None:
    """Blocks come and go in any order, close together so that searches run into each other."""
    rng = np.random.default_rng(seed)
    layers, most = 9, 40
    tables = [Table(GRID, layers, CPU, section_entries(layers, most)) for _ in range(2)]
    detail, plain = DetailTable(tables, layers, most), dict[Block, int]()
    choices = [Block(-1, int(r), int(c)) for r, c in rng.integers(0, 12, (200, 2))]
    for turn in range(600):
        key = choices[int(rng.integers(len(choices)))]
        if key in plain:
            detail.clear(key)
            del plain[key]
        elif len(plain) < most:
            detail.set(key, turn)
            plain[key] = turn
        assert detail.get(key) == plain.get(key, ABSENT)
        if turn % 50 == 0:
            expected = [plain.get(key, ABSENT) for key in choices]
            assert [detail.get(key) for key in choices] == expected
            for table in tables:
                assert found_by_kernels(table, detail, layers, choices).tolist() == expected
    detail.clear(Block(-1, 999, 999))


def test_kernels_and_the_host_hash_the_largest_numbers_alike() -> None:
    keys = [Block(-1, row, col) for row in (0, 2**22 - 1) for col in (0, 77, 2**22 - 1)]
    table = Table(GRID, 9, CPU, section_entries(9, 64))
    detail = DetailTable([table], 9, 64)
    for layer, key in enumerate(keys):
        detail.set(key, 9 + layer)
    assert found_by_kernels(table, detail, 9, keys).tolist() == list(range(9, 15))


def test_flags_behind_a_table_leave_the_table_as_it_was() -> None:
    grid = Grid(3000, 3000, 1.0)
    plain, table = Table(grid, 12, CPU), Table(grid, 12, CPU, section_entries(12, 5))
    detail = DetailTable([table], 12, 5)
    for layer in range(12):
        key = Block(0, layer % 4, layer // 4)
        plain.set(key, layer)
        table.set(key, layer)
        detail.flag(layer, has_detail=True)
        detail.set(Block(-1, layer % 5, 0), 12 + layer % 5)
    size = len(plain.entries)
    assert np.array_equal(table.entries.numpy()[:size], plain.entries.numpy())
    assert len(table.entries) == size + 12 + 3 * 16


def test_a_terrain_takes_its_factor_from_its_argument_and_without_one_has_no_detail() -> None:
    with Terrain(Plane(GRID), detail_factor=7) as terrain:
        assert terrain.detail.factor == terrain.lattice.factor == 7
        assert terrain.cache.detail_capacity == 256
    with Terrain(Plane(GRID)) as terrain:
        assert terrain.detail.factor == terrain.lattice.factor == 1
        assert terrain.cache.detail_capacity == 0
        assert terrain.pool.shape == (terrain.cache.pool.layers * 65536,)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"detail_factor": 2.5}, "detail_factor must be a whole number"),
        (
            {"detail_factor": 4, "detail_pool_bytes": 0},
            "detail_pool_bytes must be at least 1048576",
        ),
        ({"detail_factor": 4, "detail_pool_bytes": BLOCK_BYTES * 4 - 1}, "at least 1048576"),
        (
            {"detail_factor": 1024, "detail_pool_bytes": 1 << 40},
            "detail_pool_bytes must be at most",
        ),
    ],
)
def test_a_terrain_refuses_a_bad_factor_or_pool_before_it_reads_anything(
    options: dict[str, Any], message: str
) -> None:
    with pytest.raises(InputError, match=message):
        Terrain(Plane(GRID), **options)


def test_a_million_posts_a_side_with_detail_of_1024_cost_what_was_touched() -> None:
    """Opened, queried, and edited in one place: memory follows the blocks, not the numbers."""
    grid = Grid(1_000_000, 1_000_000, 1.0)
    tracemalloc.start()
    with Terrain(Plane(grid), detail_factor=1024, detail_pool_bytes=8 * BLOCK_BYTES) as terrain:
        key = Block(-1, terrain.detail.blocks.row1 - 2, 1_500_001)
        [layer] = terrain.cache.hold_details([key])
        posts = np.full((256, 256), 1024 * 100_000, np.int32)
        terrain.cache.pool.write(layer, posts, 0)
        terrain.cache.edited(key, int(posts.min()), int(posts.max()), 0)
        x = (key.col * 256 + 100.5) / 1024
        y = (key.row * 256 + 100.5) / 1024
        heights = sample(terrain, [[x, y], [x + 1.0, y], [x, y - 1.0]]).height
        assert heights.tolist() == [1.0, 0.0, 0.0]
        terrain.cache.flush()
        assert terrain.ground.edited == [key, terrain.detail.base_of(key)]
        used = tracemalloc.get_traced_memory()[0]
    tracemalloc.stop()
    # The pointer tables' directories and a few blocks on their way; the pools lie in Warp's memory.
    assert used < 4 << 20
