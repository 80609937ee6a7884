"""Fractal terrain: the same to the bit however it is read, and errors that are never too small."""

from __future__ import annotations

import hashlib
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from terrasim.errors import InputError
from terrasim.grid import Block, Grid
from terrasim.sources.array_source import ArraySource
from terrasim.sources.fractal import Fractal
from terrasim.sources.gradient_noise import add_octave, octave_error, octaves

HUGE = Grid(2**30 - 1, 2**30 - 1, spacing=1.0, row=-(2**29), col=-(2**29))


@pytest.mark.parametrize(
    ("rows", "wavelength", "count", "roughness"),
    [(513, 256, 8, 0.5), (701, 256, 9, 0.5), (701, 16, 3, 0.9), (513, 2048, 2, 1.0)],
)
def test_every_block_is_its_posts_with_an_error_never_too_small(
    rows: int, wavelength: int, count: int, roughness: float
) -> None:
    """The same posts in memory have the same blocks, and an exact error that is no larger."""
    grid = Grid(rows, 777, spacing=1.0, row=-512, col=-300)
    source = Fractal(grid, 50.0, wavelength, count, roughness, seed=4)
    plain = ArraySource(source.posts(0, np.arange(rows) - 512, np.arange(777) - 300), grid)
    for level in range(grid.levels):
        span = grid.blocks(level)
        for row in range(span.row0, span.row1):
            for col in range(span.col0, span.col1):
                key = Block(level, row, col)
                block, truth = source.block(key), plain.block(key)
                np.testing.assert_array_equal(block.posts, truth.posts)
                assert (block.lowest, block.highest) == (truth.lowest, truth.highest)
                assert block.error >= truth.error, key


def test_a_window_reads_what_the_whole_reads() -> None:
    """Any indices in any order, negative too, give the bits of one large read, at any level."""
    source = Fractal(HUGE, 500.0, wavelength=4096, octaves=13, seed=9)
    rng = np.random.default_rng(3)
    for level, row0, col0 in ((0, -300, -5_000_000), (2, -70, 400), (13, -9, 30_000)):
        rows, cols = np.arange(row0, row0 + 600), np.arange(col0, col0 + 500)
        whole = source.posts(level, rows, cols)
        for _ in range(15):
            row = rng.integers(0, len(rows), rng.integers(1, 300))
            col = rng.integers(0, len(cols), rng.integers(1, 300))
            part = source.posts(level, rows[row], cols[col])
            np.testing.assert_array_equal(part, whole[np.ix_(row, col)])


def test_a_coarse_post_is_the_post_of_level_0() -> None:
    """Levels are sub-samples: bits of the posts they keep, also where they are lattice nodes."""
    source = Fractal(HUGE, 500.0, wavelength=256, octaves=9, seed=1)
    rows, cols = np.arange(-40, 50), np.arange(-400_000, -399_950)
    for level in (1, 4, 8, 10):
        coarse = source.posts(level, rows, cols)
        np.testing.assert_array_equal(coarse, source.posts(0, rows << level, cols << level))


def test_threads_read_the_same_terrain() -> None:
    """Blocks read by four threads at once are those read by one."""
    source = Fractal(HUGE, 500.0, seed=5)
    keys = [Block(level, 3, -4) for level in range(12)] * 3
    with ThreadPoolExecutor(4) as pool:
        blocks = list(pool.map(source.block, keys))
    for key, block in zip(keys, blocks, strict=True):
        np.testing.assert_array_equal(block.posts, source.block(key).posts)


def test_the_terrain_of_a_seed_stays_as_it_is() -> None:
    """A change of the noise would change every terrain that names a seed: it must be meant."""
    source = Fractal(HUGE, 500.0, wavelength=512, octaves=10, seed=7)
    posts = source.posts(0, np.arange(-100, 100), np.arange(900_000, 900_200))
    digest = hashlib.sha256(posts.astype("<i4").tobytes()).hexdigest()
    assert digest[:16] == "ae96b77a447d8986"


def test_seeds_and_places_differ() -> None:
    """Another seed, or the same seed a period of small numbers away, is another terrain."""
    rows = np.arange(200)
    posts = Fractal(HUGE, 100.0, seed=1).posts(0, rows, rows)
    scale = posts.std()
    assert scale > 100_000
    others = [
        Fractal(HUGE, 100.0, seed=2).posts(0, rows, rows),
        Fractal(HUGE, 100.0, seed=1).posts(0, rows + 2**20, rows),
        Fractal(HUGE, 100.0, seed=1).posts(0, rows, rows - 2**28),
        posts.T,
    ]
    for other in others:
        assert np.abs(other.astype(np.int64) - posts).mean() > 0.3 * scale


def test_heights_keep_to_their_amplitude() -> None:
    """Whatever the octaves, no height is further from the mean than the amplitude."""
    for wavelength, count, roughness in ((2, 2, 1.0), (8, 3, 0.7), (64, 1, 0.5)):
        source = Fractal(HUGE, 10.0, wavelength, count, roughness, height=-3.0)
        posts = source.posts(0, np.arange(900), np.arange(900)) / 1e5
        assert np.abs(posts + 3.0).max() <= 10.0
        assert np.abs(posts + 3.0).max() > 3.0


@pytest.mark.parametrize("pinned", [True, False])
def test_an_octave_keeps_to_its_slope_and_curvature(pinned: bool) -> None:
    """Finite differences over a fine lattice stay within what the error bound is made of."""
    for seed in range(5):
        (octave,) = octaves(seed, 7, 1, amplitude=1.0, ratio=1.0, pinned=pinned)
        heights = np.zeros((513, 513))
        add_octave(heights, octave, np.arange(513), np.arange(513))
        assert np.abs(heights).max() <= 1.0
        if pinned:
            assert not heights[::128, ::128].any()
        for step in (2, 8, 32):
            coarse = heights[::step, ::step]
            middle = heights[step // 2 :: step, step // 2 :: step]
            off = np.abs((coarse[:-1, :-1] + coarse[1:, 1:]) / 2.0 - middle).max()
            assert off <= octave_error(octave, step, smooth=True)
            assert off <= octave_error(octave, step, smooth=False)


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"wavelength": 100}, "power of two from 2"),
        ({"wavelength": 1}, "power of two from 2"),
        ({"wavelength": 8, "octaves": 5}, "between 1 and 4"),
        ({"octaves": 0}, "octaves must lie between 1"),
        ({"roughness": 0.0}, "roughness must be above 0"),
        ({"roughness": float("nan")}, "roughness must be above 0"),
        ({"seed": -1}, "seed must lie between 0"),
        ({"amplitude": float("inf")}, "amplitude must be finite"),
        ({"amplitude": 30_000.0}, "set a datum nearer"),
    ],
)
def test_what_makes_no_noise_is_refused(settings: dict[str, int], text: str) -> None:
    """Each bad value is named with its rule."""
    with pytest.raises(InputError, match=text):
        Fractal(HUGE, **{"amplitude": 1.0, **settings})  # type: ignore[arg-type]
