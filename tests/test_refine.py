"""Detail below a source's spacing: the source's posts stay, and errors are never too small."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from terrasim.counts import HOLE, MAX_COUNT, Counts
from terrasim.errors import InputError
from terrasim.grid import Block, Grid
from terrasim.sources.analytic import Plane, Sine
from terrasim.sources.array_source import ArraySource
from terrasim.sources.fractal import Fractal
from terrasim.sources.refine import Refined
from terrasim.sources.source import Source


def hills(rows: int, cols: int, amplitude: float = 20.0) -> Counts:
    """Smooth ground, with small steps."""
    grid = Grid(rows, cols, spacing=1.0)
    noise = Fractal(grid, amplitude, wavelength=128, octaves=7, seed=5)
    return noise.posts(0, np.arange(rows), np.arange(cols))


def rough(rows: int, cols: int, amplitude: int) -> Counts:
    """Independent random heights."""
    rng = np.random.default_rng(1)
    return rng.integers(-amplitude, amplitude, (rows, cols), dtype=np.int32)


def with_holes(posts: Counts) -> Counts:
    """The same with a few holes, one of them large."""
    posts = posts.copy()
    rng = np.random.default_rng(6)
    posts[rng.integers(0, len(posts), 12), rng.integers(0, posts.shape[1], 12)] = HOLE
    posts[3:8, 4:7] = HOLE
    return posts


def ridges(rows: int, cols: int) -> Counts:
    """Double ridges, flat at level 2, over which a cubic swings higher than they are."""
    line = np.array([0, 1, 1, 0], dtype=np.int32)
    return np.broadcast_to(10_000 * np.resize(line, cols), (rows, cols)).astype(np.int32)


def source_of(posts: Counts, row: int = 0, col: int = 0) -> ArraySource:
    """The posts a metre apart."""
    return ArraySource(posts, Grid(len(posts), posts.shape[1], 1.0, row=row, col=col))


def everything(source: Refined) -> Counts:
    """All level-0 posts."""
    grid = source.grid
    return source.posts(
        0, np.arange(grid.row, grid.row + grid.rows), np.arange(grid.col, grid.col + grid.cols)
    )


CASES: dict[str, Callable[[int, int], Source]] = {
    "hills": lambda n, m: source_of(hills(n, m)),
    "hills with holes": lambda n, m: source_of(with_holes(hills(n, m)), row=-9, col=5),
    "rough": lambda n, m: source_of(rough(n, m, 30_000), row=7),
    "cliffs": lambda n, m: source_of(rough(n, m, 300_000)),
    "cliffs with holes": lambda n, m: source_of(with_holes(rough(n, m, 300_000))),
    "plane": lambda n, m: Plane(Grid(n, m, spacing=1.0), slope_x=0.1, slope_y=0.2),
}


@pytest.mark.parametrize("case", CASES)
@pytest.mark.parametrize("factor", [2, 8, 32])
@pytest.mark.parametrize("relief", [0.0, 0.02])
def test_every_block_is_its_posts_with_an_error_never_too_small(
    case: str, factor: int, relief: float
) -> None:
    """The same posts in memory have the same blocks, and an exact error that is no larger."""
    source = Refined(CASES[case](700 // factor + 3, 500 // factor + 3), factor, relief, seed=2)
    grid = source.grid
    plain = ArraySource(everything(source), grid)
    for level in range(grid.levels):
        span = grid.blocks(level)
        for row in range(span.row0, span.row1):
            for col in range(span.col0, span.col1):
                key = Block(level, row, col)
                block, truth = source.block(key), plain.block(key)
                np.testing.assert_array_equal(block.posts, truth.posts)
                assert (block.lowest, block.highest) == (truth.lowest, truth.highest)
                assert block.error >= truth.error, key
                assert block.error == source.bound(key)


def test_levels_far_above_the_source_are_bounded_by_its_neighbouring_blocks() -> None:
    """On smooth ground of several blocks a level they are far below the cap of 25,000 counts."""
    posts = Fractal(Grid(1200, 600, spacing=1.0), 3.0, wavelength=256, octaves=3).posts(
        0, np.arange(1200), np.arange(600)
    )
    source = Refined(source_of(posts), 2, relief=0.001)
    plain = ArraySource(everything(source), source.grid)
    for key in (Block(2, 0, 0), Block(2, 1, 0), Block(2, 2, 1), Block(3, 1, 0), Block(3, 0, 0)):
        truth, error = plain.block(key).error, source.block(key).error
        assert truth <= error < 8000


def test_a_cubic_swings_beyond_what_the_level_is_off() -> None:
    """Ridges that a coarse level does not show stand out of it further by the cubic's bulge."""
    own = source_of(ridges(1040, 40))
    source = Refined(own, 2, relief=0.0)
    truth = ArraySource(everything(source), source.grid).block(Block(3, 0, 0)).error
    assert own.block(Block(2, 0, 0)).error == 10_000
    assert source.bound(Block(3, 0, 0)) >= truth == 11_250


def test_where_bends_are_clipped_the_error_is_that_of_a_kink() -> None:
    """Folds around the limit: clipping makes kinks inside cells, which no curvature bounds."""
    fold = np.random.default_rng(3).integers(-50_000, 50_000, 7)
    posts = (fold * np.where(np.arange(7) % 2, 1, -1)[:, None]).astype(np.int32)
    source = Refined(source_of(posts), 128, relief=0.0)
    key = Block(1, 0, 0)
    truth = ArraySource(everything(source), source.grid).block(key).error
    assert source.bound(key) >= truth > 90


@pytest.mark.parametrize("case", CASES)
def test_the_posts_of_the_source_stay(case: str) -> None:
    """Every factor-th post is the source's to the bit, holes included."""
    own = CASES[case](40, 50)
    source = Refined(own, 16, relief=0.3)
    grid = own.grid
    rows, cols = np.arange(grid.row, grid.row + 40), np.arange(grid.col, grid.col + 50)
    posts = own.posts(0, rows, cols)
    np.testing.assert_array_equal(everything(source)[::16, ::16], posts)
    np.testing.assert_array_equal(source.posts(0, rows * 16, cols * 16), posts)
    np.testing.assert_array_equal(source.posts(4, rows, cols), posts)
    assert source.grid.post_x(16 * grid.col) == grid.post_x(grid.col)
    assert source.synthetic.endswith("fractal detail below 1 m (seed 0)")


@pytest.mark.parametrize("case", ["hills with holes", "cliffs", "rough"])
def test_a_window_reads_what_the_whole_reads(case: str) -> None:
    """Any indices in any order, beyond the edges too, give the bits of one large read."""
    source = Refined(CASES[case](40, 50), 16, seed=8)
    rng = np.random.default_rng(3)
    for level in (0, 2, 4):
        rows, cols = np.arange(-200, 800) >> level, np.arange(-100, 950) >> level
        whole = source.posts(level, rows, cols)
        for _ in range(15):
            row = rng.integers(0, len(rows), rng.integers(1, 60))
            col = rng.integers(0, len(cols), rng.integers(1, 60))
            part = source.posts(level, rows[row], cols[col])
            np.testing.assert_array_equal(part, whole[np.ix_(row, col)])


def test_altitude_costs_no_precision() -> None:
    """The same ground 15 km higher has the same detail, count for count."""
    posts, up = with_holes(hills(30, 30)).astype(np.int64), 1_500_000_001
    low = everything(Refined(source_of(posts.astype(np.int32)), 64)).astype(np.int64)
    high = everything(
        Refined(source_of(np.where(posts == HOLE, HOLE, posts + up).astype(np.int32)), 64)
    )
    hole = low == HOLE
    np.testing.assert_array_equal(high == HOLE, hole)
    np.testing.assert_array_equal(high[~hole] - up, low[~hole])


def test_a_plane_stays_a_plane_up_to_its_edges() -> None:
    """The bicubic runs out straight, so a plane without noise is within half a count of itself."""
    grid = Grid(12, 15, spacing=1.0)
    fine = Plane(Grid(89, 113, spacing=0.125), slope_x=0.3, slope_y=-0.2)
    source = Refined(Plane(grid, slope_x=0.3, slope_y=-0.2), 8, relief=0.0)
    np.testing.assert_array_equal(everything(source), fine.posts(0, np.arange(89), np.arange(113)))


def test_the_bicubic_is_of_third_order() -> None:
    """Halving the spacing of a wave divides the largest error inside by about eight."""
    errors = []
    for posts in (41, 81, 161):
        spacing = 80.0 / (posts - 1)
        wave = Sine(Grid(posts, posts, spacing=spacing), 10.0, 40.0, 32.0)
        fine = Sine(Grid(8 * posts - 7, 8 * posts - 7, spacing=spacing / 8), 10.0, 40.0, 32.0)
        inside = np.arange(2 * 8, 8 * (posts - 1) - 16)
        off = Refined(wave, 8, relief=0.0).posts(0, inside, inside) - fine.posts(0, inside, inside)
        errors.append(np.abs(off).max())
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert (orders > 2.7).all()


def test_holes_are_the_triangles_that_had_one() -> None:
    """A fine post is a hole exactly if its place on the source's surface has none."""
    posts = np.zeros((4, 4), dtype=np.int32)
    posts[1, 1] = HOLE
    hole = everything(Refined(source_of(posts), 4)) == HOLE
    row, col = np.indices(hole.shape)
    v, u = row - 4, col - 4
    # The six triangles around a post form a hexagon, cut by the diagonal's direction.
    inside = (np.abs(u) < 4) & (np.abs(v) < 4) & (np.abs(u - v) < 4)
    np.testing.assert_array_equal(hole, inside)


def test_neighbouring_posts_are_as_near_as_smooth_ground_beside_holes_and_cliffs() -> None:
    """No rule makes a step: between fine posts the height changes by less than the coarse slope."""
    for posts in (with_holes(hills(30, 30)), rough(30, 30, 300_000)):
        fine = everything(Refined(source_of(posts), 64, relief=0.0)).astype(np.int64)
        for axis in (0, 1):
            known = (fine != HOLE)[:-1, :-1] & np.roll(fine != HOLE, -1, axis)[:-1, :-1]
            step = np.abs(np.diff(fine, axis=axis))[: known.shape[0], : known.shape[1]]
            ground = posts[posts != HOLE]
            steepest = (int(ground.max()) - int(ground.min())) / 64.0
            assert step[known].max() < 2.0 * steepest


def test_heights_at_the_end_of_the_range_are_held_there() -> None:
    """Detail above the highest count ends at it and becomes no hole."""
    posts = np.full((5, 5), MAX_COUNT, dtype=np.int32)
    fine = everything(Refined(source_of(posts), 8, relief=0.5))
    assert fine.max() == MAX_COUNT
    assert fine.min() > MAX_COUNT - 200_000


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        ({"factor": 3}, "power of two from 2"),
        ({"factor": 1}, "power of two from 2"),
        ({"relief": -0.1}, "relief must lie between 0 and 1"),
        ({"relief": float("nan")}, "relief must lie between 0 and 1"),
        ({"roughness": 1.5}, "roughness must be above 0"),
        ({"seed": 2**63}, "seed must lie between 0"),
        ({"factor": 2**28}, "post indices must stay within"),
    ],
)
def test_what_refines_nothing_is_refused(settings: dict[str, int], text: str) -> None:
    """Each bad value is named with its rule."""
    own = source_of(np.zeros((9, 9), dtype=np.int32))
    with pytest.raises(InputError, match=text):
        Refined(own, **{"factor": 4, **settings})
