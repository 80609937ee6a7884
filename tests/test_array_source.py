"""The source in memory: addressing, edges, and block errors against brute force."""

from __future__ import annotations

from itertools import product
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrasim.counts import HOLE, Counts
from terrasim.errors import InputError
from terrasim.grid import Block, Grid
from terrasim.kernels.addressing import BLOCK
from terrasim.sources.array_source import ArraySource
from terrasim.store.build import build_store
from terrasim.store.store import open_store


def rough(rows: int, cols: int, seed: int = 0) -> Counts:
    """Independent random heights of +-10 m."""
    return np.random.default_rng(seed).integers(-1_000_000, 1_000_000, (rows, cols), dtype=np.int32)


def surface(corners: Counts, u: float, v: float) -> float:
    """Height in a cell of corners [row, col]; NaN in a triangle with a hole."""
    (h00, h10), (h01, h11) = corners.astype(np.float64)
    low = h00 + u * (h10 - h00) + v * (h11 - h10)
    high = h00 + v * (h01 - h00) + u * (h11 - h01)
    low_ok = HOLE not in (h00, h10, h11)
    high_ok = HOLE not in (h00, h01, h11)
    if u >= v and low_ok:
        return float(low)
    if v >= u and high_ok:
        return float(high)
    return float("nan")


def brute_error(source: ArraySource, key: Block) -> float:
    """Largest distance over the block's cells and one beyond the terrain, post by post."""
    step = 1 << key.level
    worst = 0.0
    span = source.grid.posts(key.level)
    for r in range(max(span.row0 - 1, key.row * BLOCK), min(span.row1, (key.row + 1) * BLOCK)):
        for c in range(max(span.col0 - 1, key.col * BLOCK), min(span.col1, (key.col + 1) * BLOCK)):
            corners = source.posts(key.level, np.array([r, r + 1]), np.array([c, c + 1]))
            fine = source.posts(
                0,
                np.arange(r * step, (r + 1) * step + 1),
                np.arange(c * step, (c + 1) * step + 1),
            )
            for i, j in np.ndindex(fine.shape):
                if fine[i, j] != HOLE:
                    gap = abs(float(fine[i, j]) - surface(corners, j / step, i / step))
                    worst = max(worst, 0.0 if np.isnan(gap) else gap)
    return worst


def test_level_posts_are_sub_samples_with_edges_held() -> None:
    """Post (r, c) of level l is post (r << l, c << l), moved to the edge beyond it."""
    heights = rough(7, 9)
    source = ArraySource(heights, Grid(7, 9, 1.0, row=-2, col=3))
    got = source.posts(1, np.array([-3, -1, 0, 2, 9]), np.array([0, 2, 5, 7]))
    np.testing.assert_array_equal(got, heights[np.ix_([0, 0, 2, 6, 6], [0, 1, 7, 8])])


def test_a_block_holds_its_posts_and_their_range() -> None:
    """The block at negative indices begins with the extended edge; holes are outside the range."""
    heights = rough(30, 20)
    heights[4, 5] = HOLE
    source = ArraySource(heights, Grid(30, 20, 1.0, row=-10, col=-10))
    data = source.block(Block(0, -1, -1))
    np.testing.assert_array_equal(data.posts[-10:, -10:], heights[:10, :10])
    np.testing.assert_array_equal(data.posts[0, -10:], heights[0, :10])
    corner = heights[:10, :10]
    ground = corner[corner != HOLE]
    assert (data.lowest, data.highest, data.error) == (ground.min(), ground.max(), 0)


@settings(max_examples=25, deadline=None)
@given(
    rows=st.integers(2, 14),
    cols=st.integers(2, 14),
    row=st.integers(-20, 20),
    col=st.integers(-20, 20),
    holes=st.integers(0, 5),
    level=st.integers(1, 3),
    seed=st.integers(0, 1000),
)
def test_block_error_equals_brute_force(
    rows: int, cols: int, row: int, col: int, holes: int, level: int, seed: int
) -> None:
    """Each block's error is the largest distance at any level-0 post, rounded up to a count."""
    heights = rough(rows, cols, seed)
    rng = np.random.default_rng(seed)
    heights[rng.integers(0, rows, holes), rng.integers(0, cols, holes)] = HOLE
    source = ArraySource(heights, Grid(rows, cols, 1.0, row=row, col=col))
    span = source.grid.blocks(level)
    for r, c in product(range(span.row0, span.row1), range(span.col0, span.col1)):
        key = Block(level, r, c)
        assert source.block(key).error == np.ceil(brute_error(source, key) - 1e-6)


def test_a_store_built_from_it_says_the_same_of_every_block(tmp_path: Path) -> None:
    """Posts, ranges and errors of all levels, measured there by kernels; with holes."""
    heights = rough(300, 550)
    heights[rough(1, 9, 1)[0] % 300, rough(1, 9, 2)[0] % 550] = HOLE
    source = ArraySource(heights, Grid(300, 550, 1.0, row=-20, col=7))
    build_store(source, source.grid, tmp_path / "a.store", provenance=source.provenance)
    with open_store(tmp_path / "a.store") as stored:
        for level in range(source.grid.levels):
            span = source.grid.blocks(level)
            for r, c in product(range(span.row0, span.row1), range(span.col0, span.col1)):
                mine, other = source.block(Block(level, r, c)), stored.block(Block(level, r, c))
                np.testing.assert_array_equal(mine.posts, other.posts)
                assert (mine.lowest, mine.highest) == (other.lowest, other.highest)
                assert mine.error == other.error


def test_an_error_measured_in_strips_equals_one_measured_whole(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """How the comparison is cut does not matter."""
    heights = rough(300, 70)
    whole = ArraySource(heights, Grid(300, 70, 1.0)).block(Block(1, 0, 0)).error
    monkeypatch.setattr("terrasim.sources.array_source._STRIP_POSTS", 64)
    assert ArraySource(heights, Grid(300, 70, 1.0)).block(Block(1, 0, 0)).error == whole > 0


def test_a_plane_has_no_error_at_any_level() -> None:
    """Sub-sampling a plane of even steps loses nothing inside the terrain."""
    rows, cols = np.mgrid[0:513, 0:513]
    source = ArraySource((rows * 16 + cols * 32).astype(np.int32), Grid(513, 513, 1.0))
    # The last post of a level begins cells that lie wholly outside, where the extended edge is
    # level across and even along: no error there either.
    assert [source.block(Block(level, 0, 0)).error for level in (0, 1)] == [0, 0]


def test_metres_become_counts_and_nan_a_hole() -> None:
    """One count is 10 micrometres above the datum."""
    source = ArraySource.from_metres([[100.0, 101.5], [np.nan, 99.99999]], spacing=2.0, datum=100.0)
    got = source.posts(0, np.arange(2), np.arange(2))
    np.testing.assert_array_equal(got, [[0, 150_000], [HOLE, -1]])
    assert source.grid == Grid(2, 2, 2.0, datum=100.0)


def test_rows_are_read_from_the_south() -> None:
    """The array's first row is the southern edge, also when it is streamed."""
    heights = rough(5, 4)
    np.testing.assert_array_equal(
        ArraySource(heights, Grid(5, 4, 1.0)).read_rows(1, 3), heights[1:4]
    )


@pytest.mark.parametrize(
    ("posts", "said"),
    [
        (np.zeros((3, 3)), "float64"),
        (np.zeros((3, 4), np.int32), "(3, 4)"),
        (np.zeros(3, np.int32), "(3,)"),
    ],
)
def test_wrong_arrays_are_refused(posts: Counts, said: str) -> None:
    """The message names what was got."""
    with pytest.raises(InputError, match=r"posts .*") as error:
        ArraySource(posts, Grid(3, 3, 1.0))
    assert said in str(error.value)


@pytest.mark.parametrize("bad", [np.inf, -np.inf, 30_000.0])
def test_heights_out_of_range_are_refused(bad: float) -> None:
    """Infinite heights and those beyond the counts' range never enter."""
    with pytest.raises(InputError, match="out of range"):
        ArraySource.from_metres([[0.0, bad], [0.0, 0.0]], spacing=1.0)
