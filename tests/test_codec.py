"""Packed posts: exact for every int32, small where the ground is, refused where damaged."""

from __future__ import annotations

import struct
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from terrasim.counts import HOLE, MAX_COUNT, Counts
from terrasim.errors import InputError, RunError
from terrasim.kernels.addressing import BLOCK
from terrasim.store.codec import CODEC, MAX_POSTS, StoreCorrupt, common_factor, pack, unpack


def hills(step: int = 1, seed: int = 0) -> Counts:
    """Rolling ground of 300 m with noise, heights in whole steps of the given counts."""
    rng = np.random.default_rng(seed)
    y, x = np.mgrid[0:BLOCK, 0:BLOCK] / BLOCK
    metres = 300 * np.sin(5 * x + 1) * np.cos(4 * y) + rng.normal(0, 0.3, x.shape)
    posts: Counts = np.rint(metres * 10).astype(np.int32) * np.int32(step)
    return posts


@settings(max_examples=200, deadline=None)
@given(
    shape=st.tuples(st.integers(1, 9), st.integers(1, 9)),
    factor=st.sampled_from([1, 2, 10_000, 2**20, 2**30]),
    reach=st.sampled_from([0, 1, 100, 2**15, 2**31 - 1]),
    shift=st.integers(-MAX_COUNT, MAX_COUNT),
    holes=st.sampled_from([0.0, 0.2, 0.9, 1.0]),
    seed=st.integers(0, 2**32 - 1),
)
def test_any_posts_come_back_bit_for_bit(
    shape: tuple[int, int], factor: int, reach: int, shift: int, holes: float, seed: int
) -> None:
    """Whatever the range, the steps, the shape and the holes."""
    rng = np.random.default_rng(seed)
    values = rng.integers(-reach, reach, shape, endpoint=True) * factor + shift
    posts = np.clip(values, -MAX_COUNT, MAX_COUNT).astype(np.int32)
    posts[rng.random(shape) < holes] = HOLE
    got = unpack(pack(posts))
    assert got.dtype == np.int32
    np.testing.assert_array_equal(got, posts)


def test_a_checkerboard_of_extremes_comes_back() -> None:
    """The residual of the largest jumps wraps around int32 and back."""
    board = np.indices((BLOCK, BLOCK)).sum(axis=0) % 2
    posts = np.where(board == 0, MAX_COUNT, -MAX_COUNT).astype(np.int32)
    posts[3, 5] = 0
    np.testing.assert_array_equal(unpack(pack(posts)), posts)


def test_ground_in_decimetres_packs_as_small_as_its_numbers() -> None:
    """Heights in steps of 0.1 m (10,000 counts) cost what the same heights in single counts do."""
    coarse, plain = pack(hills(step=10_000)), pack(hills(step=1))
    assert len(coarse) == len(plain)
    np.testing.assert_array_equal(unpack(coarse), hills(step=10_000))


def test_a_datum_between_the_steps_does_not_hide_them() -> None:
    """The first height is taken out before the common factor is sought."""
    assert len(pack(hills(step=10_000) + np.int32(4321))) == len(pack(hills(step=10_000)))


def test_the_common_factor_divides_every_value() -> None:
    """Also when a single value breaks the pattern, wherever it stands."""
    values = np.arange(65536, dtype=np.int64) * 60
    assert common_factor(values) == 60
    values[777] += 15
    assert common_factor(values) == 15
    values[65535] += 1
    assert common_factor(values) == 1
    assert common_factor(np.zeros(5, dtype=np.int64)) == 0
    assert common_factor(np.array([0, -(2**32), 2**31], dtype=np.int64)) == 2**31


def test_smooth_ground_packs_to_less_than_an_eighth() -> None:
    """A paraboloid has a constant residual: the prediction takes out all of it but the rims."""
    y, x = np.mgrid[0:BLOCK, 0:BLOCK]
    assert len(pack((x * x + x * y - 2 * y * y).astype(np.int32))) < BLOCK * BLOCK * 4 / 100
    assert len(pack(hills(step=10_000))) < BLOCK * BLOCK * 4 / 4


def test_level_ground_and_nothing_at_all_take_a_header() -> None:
    """A block of one value costs 20 bytes; so does one of holes alone."""
    for value in (0, MAX_COUNT, HOLE):
        posts = np.full((BLOCK, BLOCK), value, dtype=np.int32)
        blob = pack(posts)
        assert len(blob) == 20
        np.testing.assert_array_equal(unpack(blob), posts)


def test_a_hole_costs_little_and_spoils_no_neighbour() -> None:
    """Holes are no heights: a few do not widen the residual."""
    posts = hills(step=10_000)
    whole = len(pack(posts))
    posts[100:103, 50:60] = HOLE
    posts[0, :4] = HOLE
    np.testing.assert_array_equal(unpack(pack(posts)), posts)
    assert len(pack(posts)) < whole * 1.05


def test_equal_posts_give_equal_bytes_in_any_layout() -> None:
    """Content addressing rests on it."""
    posts = hills()
    wide = np.zeros((BLOCK, 2 * BLOCK), dtype=np.int32)
    wide[:, ::2] = posts
    assert pack(wide[:, ::2]) == pack(posts) == pack(np.asfortranarray(posts))


def test_what_comes_back_is_ours_to_change() -> None:
    """No two readers share an array."""
    blob = pack(hills())
    unpack(blob)[:] = 7
    np.testing.assert_array_equal(unpack(blob), hills())


def test_threads_pack_and_unpack_at_once() -> None:
    """Each has its own compressor."""
    blocks = [hills(step=1 + seed, seed=seed) for seed in range(24)]
    with ThreadPoolExecutor(4) as pool:
        got = list(pool.map(lambda posts: unpack(pack(posts)), blocks))
    for posts, back in zip(blocks, got, strict=True):
        np.testing.assert_array_equal(back, posts)


@pytest.mark.parametrize(
    "posts",
    [
        np.zeros((3, 3)),
        np.zeros((3, 3), np.int64),
        np.zeros(9, np.int32),
        np.zeros((0, 4), np.int32),
        np.broadcast_to(np.int32(0), (MAX_POSTS, 2)),
    ],
)
def test_what_is_no_block_is_refused(posts: Counts) -> None:
    """The message says what was got."""
    with pytest.raises(InputError, match="2-D int32") as error:
        pack(posts)
    assert str(posts.shape) in str(error.value)


def test_every_cut_blob_is_refused() -> None:
    """However much is missing, down to nothing."""
    posts = hills(step=10_000)
    posts[9, 9] = HOLE
    blob = pack(posts)
    for length in [*range(64), *range(64, len(blob), 997), len(blob) - 1]:
        with pytest.raises(StoreCorrupt):
            unpack(blob[:length])
    with pytest.raises(StoreCorrupt):
        unpack(blob + b"\0")


def test_a_damaged_blob_never_brings_anything_but_its_own_error() -> None:
    """Flipped bits may still make a block, which its hash then refuses; else it is StoreCorrupt."""
    posts = hills(step=10_000)
    posts[9, 9] = HOLE
    blob = bytearray(pack(posts))
    refused = 0
    for bit in [*range(400), *range(400, 8 * len(blob), 4001)]:
        blob[bit // 8] ^= 1 << bit % 8
        try:
            assert unpack(bytes(blob)).size <= MAX_POSTS
        except StoreCorrupt:
            refused += 1
        blob[bit // 8] ^= 1 << bit % 8
    assert refused > 200


@pytest.mark.parametrize(
    ("rows", "cols", "width", "holes", "step"),
    [
        (2**31, 2**31, 4, 0, 1),
        (2048, 2049, 0, 0, 1),
        (0, 5, 1, 0, 1),
        (256, 256, 3, 0, 1),
        (256, 256, 1, 7, 1),
        (256, 256, 1, 0, 0),
    ],
)
def test_a_header_that_claims_too_much_is_refused_before_anything_is_allocated(
    rows: int, cols: int, width: int, holes: int, step: int
) -> None:
    """Nothing of the size claimed is made: the largest claims 2^62 posts."""
    header = struct.pack("<BBBBIIiI", CODEC, width, holes, 0, rows, cols, 0, step)
    with pytest.raises(StoreCorrupt, match="claims"):
        unpack(header + zstandard.compress(bytes(100)))


def test_a_frame_that_would_unfold_to_gigabytes_is_refused_unread() -> None:
    """Its own claim must equal the header's."""
    bomb = zstandard.ZstdCompressor().compress(bytes(64 << 20))
    header = struct.pack("<BBBBIIiI", CODEC, 1, 0, 0, 256, 256, 0, 1)
    with pytest.raises(StoreCorrupt, match="frame claims 67108864 bytes"):
        unpack(header + bomb)
    nameless = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(64 << 20))
    with pytest.raises(StoreCorrupt, match="frame claims"):
        unpack(header + nameless)


def test_a_newer_codec_is_refused() -> None:
    """The first byte tells."""
    blob = bytearray(pack(hills()))
    blob[0] = CODEC + 1
    with pytest.raises(StoreCorrupt, match="codec"):
        unpack(bytes(blob))


def test_corruption_is_a_failed_run() -> None:
    """The command line ends with exit status 1."""
    assert issubclass(StoreCorrupt, RunError)


def test_real_ground_packs_to_a_third(shared_terrain: Path) -> None:
    """SRTM in whole metres: 1,201 posts a side, big-endian int16, -32768 where there is none."""
    metres = np.fromfile(shared_terrain / "N48W123.hgt", dtype=">i2").astype(np.int64)
    side = round(metres.size**0.5)
    counts = np.where(metres == -32768, HOLE, metres * 100_000).astype(np.int32)
    posts = counts.reshape(side, side)[300 : 300 + BLOCK, 300 : 300 + BLOCK]
    blob = pack(posts)
    np.testing.assert_array_equal(unpack(blob), posts)
    assert len(blob) < posts.nbytes / 3
