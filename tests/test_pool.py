"""The pool's size, and what is written into its layers."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

import terrasim as ts
from terrasim.cache.pool import BLOCK_BYTES, BLOCK_POSTS, MAX_LAYERS, Pool, layers_for
from terrasim.counts import HOLE, Counts
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.kernels.addressing import BLOCK

CPU = wp.get_device("cpu")
LARGE = Grid(10_000, 10_000, 1.0)


def noise(seed: int) -> Counts:
    """A block of posts of every value, holes and extremes among them."""
    posts = np.random.default_rng(seed).integers(-(2**31), 2**31, (BLOCK, BLOCK), dtype=np.int32)
    posts[0, :3] = HOLE, 2**31 - 1, HOLE + 1
    return posts


def blocks_of(grid: Grid) -> int:
    """Number of blocks of all levels."""
    spans = [grid.blocks(level) for level in range(grid.levels)]
    return sum((span.row1 - span.row0) * (span.col1 - span.col0) for span in spans)


def test_a_pool_holds_as_many_blocks_as_fit_into_its_bytes() -> None:
    assert layers_for(LARGE, 64 << 20) == 256
    assert layers_for(LARGE, 8 * BLOCK_BYTES) == 8
    assert layers_for(LARGE, 9 * BLOCK_BYTES - 1) == 8
    assert BLOCK_BYTES == 256 * 1024


def test_a_pool_is_never_larger_than_the_terrain() -> None:
    assert layers_for(LARGE, 2**40) == blocks_of(LARGE)
    assert layers_for(Grid(2, 2, 1.0), BLOCK_BYTES) == 1
    with ts.Terrain(ts.ArraySource(np.zeros((300, 300), np.int32), Grid(300, 300, 1.0))) as terrain:
        assert terrain.cache.pool.layers == blocks_of(terrain.grid)


@pytest.mark.parametrize("pool_bytes", [8 * BLOCK_BYTES - 1, 0, -5])
def test_a_pool_too_small_is_refused_with_what_it_needs(pool_bytes: int) -> None:
    rule = f"pool of {pool_bytes} bytes is too small: it must hold 8 blocks, 2097152 bytes"
    with pytest.raises(InputError, match=rule):
        layers_for(LARGE, pool_bytes)


def test_a_pool_beyond_what_an_int32_addresses_is_refused() -> None:
    vast = Grid(2**20, 2**20, 1.0)
    assert layers_for(vast, MAX_LAYERS * BLOCK_BYTES) == MAX_LAYERS
    assert MAX_LAYERS * BLOCK_POSTS <= 2**31 - 1
    with pytest.raises(InputError, match=f"too large: at most {MAX_LAYERS * BLOCK_BYTES} bytes"):
        layers_for(vast, (MAX_LAYERS + 1) * BLOCK_BYTES)


def test_the_pool_has_room_for_the_top_and_four_blocks_beside_it() -> None:
    """A terrain that begins in the last cell of a block has a top of three by three."""
    grid = Grid(1024, 1024, 1.0, row=1022, col=1022)
    span = grid.blocks(grid.top)
    assert (span.row1 - span.row0, span.col1 - span.col0) == (3, 3)
    with pytest.raises(InputError, match="it must hold 13 blocks"):
        layers_for(grid, 12 * BLOCK_BYTES)
    posts = np.random.default_rng(0).integers(-(10**6), 10**6, (1024, 1024), dtype=np.int32)
    source = ts.ArraySource(posts, grid)
    with ts.Terrain(source, pool_bytes=13 * BLOCK_BYTES) as terrain:
        assert terrain.cache.capacity == 4
        rows, cols = np.meshgrid(np.arange(1022, 2046, 31), np.arange(1022, 2046, 31))
        points = np.column_stack([cols.ravel(), rows.ravel()]).astype(np.float64)
        found = ts.sample(terrain, points)
        assert np.array_equal(found.height, posts[rows.ravel() - 1022, cols.ravel() - 1022] * 1e-5)


def test_the_bytes_of_a_pool_are_those_of_its_arrays() -> None:
    pool = Pool(11, CPU)
    assert pool.posts.dtype is wp.int32
    assert pool.posts.size * 4 == pool.posts.numpy().nbytes == 11 * BLOCK_BYTES
    assert pool.error.shape == pool.used.shape == (11,)
    with ts.Terrain(ts.Flat(LARGE), pool_bytes=11 * BLOCK_BYTES + 7) as terrain:
        assert terrain.pool.numpy().nbytes == 11 * BLOCK_BYTES
        assert terrain.error.numpy().nbytes == 4 * 11
        assert terrain.used.numpy().nbytes == 11


def test_a_layer_holds_what_was_written_and_others_are_left_alone() -> None:
    pool = Pool(5, CPU)
    for layer in (3, 0, 4, 1, 2):
        assert pool.write(layer, noise(layer), 100 + layer) is None
    pool.write(2, noise(9), -1)
    pool.set_error(4, 77)
    for layer, seed in enumerate((0, 1, 9, 3, 4)):
        assert np.array_equal(pool.read(layer), noise(seed))
        flat = pool.posts.numpy()[layer * BLOCK_POSTS : (layer + 1) * BLOCK_POSTS]
        assert np.array_equal(flat, noise(seed).reshape(-1))
    assert pool.error.numpy().tolist() == [100, 101, -1, 103, 77]


def test_what_was_read_from_a_layer_is_a_copy() -> None:
    pool = Pool(2, CPU)
    pool.write(1, noise(1), 0)
    before = pool.read(1)
    before[:] = 0
    assert np.array_equal(pool.read(1), noise(1))


def test_used_layers_are_told_once() -> None:
    pool = Pool(6, CPU)
    pool.used.numpy()[[1, 4]] = 1
    assert pool.take_used().tolist() == [1, 4]
    assert pool.take_used().tolist() == []
