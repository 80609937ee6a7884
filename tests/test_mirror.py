"""Mirrored extension: addresses against a plain array, errors never too small; resampling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from terrasim.counts import HOLE, Counts
from terrasim.errors import InputError
from terrasim.grid import Block, Grid, Indices
from terrasim.sources.analytic import Plane, Sine
from terrasim.sources.array_source import ArraySource
from terrasim.sources.fractal import Fractal
from terrasim.sources.mirror import Mirrored
from terrasim.sources.resample import resample_power_of_two
from terrasim.sources.source import BlockData


def rough(rows: int, cols: int, *, holes: int = 0, row: int = 0, col: int = 0) -> ArraySource:
    """Independent random heights of a metre."""
    rng = np.random.default_rng(1)
    posts = rng.integers(-100_000, 100_000, (rows, cols), dtype=np.int32)
    posts[rng.integers(0, rows, holes), rng.integers(0, cols, holes)] = HOLE
    return ArraySource(posts, Grid(rows, cols, spacing=2.0, x=50.0, row=row, col=col))


def hills(rows: int, cols: int) -> ArraySource:
    """Smooth ground, with small steps."""
    grid = Grid(rows, cols, spacing=2.0)
    noise = Fractal(grid, 20.0, wavelength=256, octaves=7)
    return ArraySource(noise.posts(0, np.arange(rows), np.arange(cols)), grid)


def slope(rows: int, cols: int) -> ArraySource:
    """A plane, which has no error but where an edge cuts its cells."""
    plane = Plane(Grid(rows, cols, spacing=2.0), slope_x=0.25, slope_y=0.5)
    return ArraySource(plane.posts(0, np.arange(rows), np.arange(cols)), plane.grid)


def spike_beside_a_hole() -> ArraySource:
    """Flat but for a spike that stands on ground only where its cell is split the other way."""
    posts = np.zeros((257, 257), dtype=np.int32)
    posts[8, 8], posts[9, 9] = HOLE, 1_000_000
    return ArraySource(posts, Grid(257, 257, spacing=2.0))


def unfolded(posts: Counts, rows: Indices, cols: Indices) -> Counts:
    """The mirrored terrain by NumPy's own reflection of a plain array."""
    high, wide = posts.shape
    period = np.pad(posts, ((0, max(high - 2, 0)), (0, max(wide - 2, 0))), mode="reflect")
    return period[np.ix_(rows % period.shape[0], cols % period.shape[1])]


@given(data=st.data())
@settings(max_examples=60, deadline=None, derandomize=True)
def test_any_place_of_a_huge_terrain_is_a_place_of_the_source(data: st.DataObject) -> None:
    """Anywhere, at any level, negative indices too: the post NumPy's reflection has there."""
    k, j = data.draw(st.integers(1, 6)), data.draw(st.integers(1, 6))
    own = rough(2**k + 1, 2**j + 1, row=data.draw(st.sampled_from([0, -3, 64])))
    source = Mirrored(own, 2**30 - 1, 2**30 - 1, row=-(2**29), col=-(2**29))
    level = data.draw(st.integers(0, source.grid.top))
    span = source.grid.posts(level)
    draw = st.lists(st.integers(span.row0, span.row1 - 1), min_size=1, max_size=20)
    rows, cols = np.array(data.draw(draw)), np.array(data.draw(draw))
    plain = own.read_rows(0, own.grid.rows)
    # The last row of this terrain is no post of coarse levels: they are moved to it.
    last = 2**29 - 2
    expected = unfolded(plain, np.minimum(rows << level, last), np.minimum(cols << level, last))
    np.testing.assert_array_equal(source.posts(level, rows, cols), expected)


CASES: dict[str, Callable[[], ArraySource]] = {
    "1 cell": lambda: rough(2, 2),
    "narrow": lambda: rough(5, 17),
    "small": lambda: rough(65, 65),
    "uneven": lambda: rough(257, 33, holes=2),
    "blocks": lambda: rough(513, 513),
    "holes": lambda: rough(257, 257, holes=4),
    "hills": lambda: hills(513, 513),
    "slope": lambda: slope(513, 513),
    "short slope": lambda: slope(65, 65),
    "spike beside a hole": spike_beside_a_hole,
    "off the blocks": lambda: rough(129, 129, row=-7, col=12),
    "half a block off": lambda: rough(513, 257, row=-384, col=128),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize(
    ("rows", "cols", "row", "col"),
    [(1025, 513, -512, -512), (900, 801, 0, -130), (1025, 801, -512, 0)],
)
def test_every_block_is_its_posts_with_an_error_never_too_small(
    case: str, rows: int, cols: int, row: int, col: int
) -> None:
    """The same posts in memory have the same blocks, and an exact error that is no larger."""
    source = Mirrored(CASES[case](), rows, cols, row=row, col=col)
    grid = source.grid
    plain = ArraySource(
        source.posts(0, np.arange(row, row + rows), np.arange(col, col + cols)), grid
    )
    for level in range(grid.levels):
        span = grid.blocks(level)
        for r in range(span.row0, span.row1):
            for c in range(span.col0, span.col1):
                key = Block(level, r, c)
                block, truth = source.block(key), plain.block(key)
                np.testing.assert_array_equal(block.posts, truth.posts)
                assert (block.lowest, block.highest) == (truth.lowest, truth.highest)
                assert block.error >= truth.error, key


def test_a_block_reflected_both_ways_has_the_error_of_the_source() -> None:
    """Turned by half a turn a cell keeps its diagonal; reflected once it does not."""
    own = hills(1025, 1025)
    source = Mirrored(own, 2**20 + 1, 2**20 + 1, row=-(2**19), col=-(2**19))
    assert source.bound(Block(1, -2, -2)) == own.block(Block(1, 1, 1)).error
    assert source.bound(Block(1, 4, 8)) == own.block(Block(1, 0, 0)).error
    assert source.bound(Block(1, 0, -1)) > own.block(Block(1, 0, 0)).error


@dataclass(frozen=True)
class Watched:
    """A source that remembers which levels were read."""

    own: ArraySource
    levels: list[int]
    synthetic: str = ""

    @property
    def grid(self) -> Grid:
        """The source's."""
        return self.own.grid

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        """The source's."""
        self.levels.append(level)
        return self.own.posts(level, rows, cols)

    def block(self, key: Block) -> BlockData:
        """The source's."""
        return self.own.block(key)


def test_coarse_levels_are_read_from_the_coarse_levels_of_the_source() -> None:
    """A stored source is not read at level 0 for a far view."""
    watched = Watched(rough(1025, 1025), [])
    source = Mirrored(watched, 2**20 + 1, 2**20 + 1, row=-(2**19), col=-(2**19))
    for level in range(source.grid.levels):
        watched.levels.clear()
        source.block(Block(level, -1, 0))
        assert set(watched.levels) == {min(level, 3)}


def test_opening_a_huge_terrain_reads_nothing() -> None:
    """A million posts each way cost a few numbers until a block is asked for."""
    watched = Watched(rough(1025, 1025), [])
    source = Mirrored(watched, 2**30 - 1, 2**20, row=-(2**29), col=5)
    assert source.grid.rows == 2**30 - 1
    assert watched.levels == []


def test_the_first_post_stays_where_it_is() -> None:
    """Post (0, 0) stands at the source's first post, wherever that one's indices begin."""
    own = rough(5, 9, row=-2, col=7)
    source = Mirrored(own, 100, 100, row=-20, col=-20)
    assert source.grid.post_x(0) == own.grid.post_x(7)
    assert source.grid.post_y(0) == own.grid.post_y(-2)
    assert source.posts(0, np.array([0]), np.array([0])) == own.read_rows(0, 1)[0, 0]
    assert source.synthetic == "mirrored extension of 5 x 9 posts"


def test_a_source_that_does_not_fold_is_refused_with_the_remedy() -> None:
    """1024 posts are no power of two plus one."""
    with pytest.raises(InputError, match=r"1024 x 1025 posts.*resample_power_of_two"):
        Mirrored(rough(1024, 1025), 10, 10)
    with pytest.raises(InputError, match="at least 2 x 2"):
        Mirrored(rough(3, 3), 1, 10)


def test_a_source_that_folds_is_not_resampled() -> None:
    """It is given back as it is."""
    own = rough(17, 33)
    assert resample_power_of_two(own) is own
    assert resample_power_of_two(own, 4) is own


def test_resampling_keeps_a_plane_and_its_place() -> None:
    """1024 posts become 1025 over the same ground; a plane's heights are within a count."""
    grid = Grid(1024, 1024, spacing=3.0, x=1000.0, y=-70.0, row=-5, col=11, datum=20.0)
    plane = Plane(grid, 30.0, slope_x=0.1, slope_y=-0.05)
    source = resample_power_of_two(plane)
    assert (source.grid.rows, source.grid.cols) == (1025, 1025)
    assert source.grid.post_x(1024) == pytest.approx(grid.post_x(11 + 1023))
    assert source.grid.post_y(0) == grid.post_y(-5)
    rows = cols = np.arange(1025)
    x, y = source.grid.post_x(cols) - grid.x, source.grid.post_y(rows) - grid.y
    expected = 10.0 + 0.1 * x[None, :] - 0.05 * y[:, None]
    np.testing.assert_allclose(source.posts(0, rows, cols) * 1e-5, expected, rtol=0, atol=1.01e-5)
    assert source.synthetic == (
        "a plane; resampled from 1024 x 1024 posts at 3 m to 1025 x 1025 at 2.99707 m"
    )
    assert Mirrored(source, 5000, 5000).grid.spacing == source.grid.spacing


def test_an_oblong_source_keeps_its_middle_and_says_what_it_left_out() -> None:
    """The spacing is the same both ways, so the longer side loses as much at both ends."""
    grid = Grid(344, 403, spacing=90.0)
    source = resample_power_of_two(Sine(grid, 10.0, 9000.0), 8)
    assert (source.grid.rows, source.grid.cols) == (257, 257)
    assert source.grid.spacing == 90.0 * 343 / 256
    assert source.grid.x == pytest.approx(90.0 * 59 / 2)
    assert "leaving out 0 rows and 59 columns" in source.synthetic
    wide = resample_power_of_two(rough(100, 410))
    assert (wide.grid.rows, wide.grid.cols) == (129, 513)


def test_resampling_makes_a_hole_wherever_one_has_a_part() -> None:
    """A hole spreads to the posts between it and the ground, and no further."""
    posts = np.zeros((4, 4), dtype=np.int32)
    posts[3, 3] = posts[1, 0] = HOLE
    source = resample_power_of_two(ArraySource(posts, Grid(4, 4, spacing=1.0)), 3)
    hole = source.posts(0, np.arange(9), np.arange(9)) == HOLE
    # Nine posts stand 3/8 of a cell apart: the last three lie in the last cell, and the first and
    # the last stand on posts of the source.
    expected = np.zeros((9, 9), dtype=np.bool_)
    expected[6:, 6:] = expected[1:6, :3] = True
    np.testing.assert_array_equal(hole, expected)


def test_what_does_not_fit_in_memory_is_not_resampled() -> None:
    """The rule and the remedy are named."""
    huge = Plane(Grid(2**20, 2**20, spacing=1.0))
    with pytest.raises(InputError, match="leaves 0 to 14 for the exponents; give a smaller one"):
        resample_power_of_two(huge)
    with pytest.raises(InputError, match="leaves 0 to 14"):
        resample_power_of_two(rough(9, 8), -1)
