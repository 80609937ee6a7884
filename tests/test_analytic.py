"""Terrains of one formula: their heights, and block errors against the same posts in memory."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.counts import to_metres
from terrasim.errors import InputError
from terrasim.grid import Block, Grid
from terrasim.sources.analytic import Cone, Flat, Plane, Sine
from terrasim.sources.array_source import ArraySource
from terrasim.sources.error_bound import curvature_bound, slope_bound
from terrasim.sources.source import Source

# One whose edges are posts of every level, and one whose edges run through cells.
ALIGNED = Grid(1025, 513, spacing=0.5, row=-512, col=0)
UNEVEN = Grid(701, 777, spacing=0.5, row=-300, col=-513)

SHAPES: list[Source] = [
    shape
    for grid in (ALIGNED, UNEVEN)
    for shape in (
        Flat(grid, 3.0),
        Plane(grid, 3.0, slope_x=0.1234567, slope_y=-0.3, row=7),
        Plane(grid, 3.0, slope_x=0.25, slope_y=-0.5),
        Sine(grid, amplitude=20.0, wavelength=50.0),
        Sine(grid, amplitude=20.0, wavelength=57.3, wavelength_y=110.0, height=-4.0, row=5),
        Cone(grid, height=30.0, radius=100.0, dx=0.3),
        Cone(grid, height=-30.0, radius=450.0, row=-1000),
    )
]


def name_of(source: Source) -> str:
    """Name of a case."""
    return f"{type(source).__name__}-{source.grid.rows}"


@pytest.mark.parametrize("source", SHAPES, ids=name_of)
def test_every_block_is_its_posts_with_an_error_never_too_small(source: Source) -> None:
    """The same posts in memory have the same blocks, and an exact error that is no larger."""
    grid = source.grid
    rows, cols = (
        np.arange(grid.row, grid.row + grid.rows),
        np.arange(grid.col, grid.col + grid.cols),
    )
    plain = ArraySource(source.posts(0, rows, cols), grid)
    for level in range(grid.levels):
        span = grid.blocks(level)
        for row in range(span.row0, span.row1):
            for col in range(span.col0, span.col1):
                key = Block(level, row, col)
                block, truth = source.block(key), plain.block(key)
                np.testing.assert_array_equal(block.posts, truth.posts)
                assert (block.lowest, block.highest) == (truth.lowest, truth.highest)
                assert block.error >= truth.error, key


@pytest.mark.parametrize("source", SHAPES, ids=name_of)
def test_a_window_reads_what_the_whole_reads(source: Source) -> None:
    """Any indices in any order, beyond the edges too, give the bits of one large read."""
    rng = np.random.default_rng(2)
    for level in (0, 1, 3):
        rows, cols = np.arange(-900, 900) >> level, np.arange(-700, 900) >> level
        whole = source.posts(level, rows, cols)
        for _ in range(20):
            row = rng.integers(0, len(rows), rng.integers(1, 40))
            col = rng.integers(0, len(cols), rng.integers(1, 40))
            part = source.posts(level, rows[row], cols[col])
            np.testing.assert_array_equal(part, whole[np.ix_(row, col)])


def test_heights_are_those_of_the_formulas() -> None:
    """Each shape is within half a count of its formula."""
    grid = dataclasses.replace(UNEVEN, datum=100.0)
    rows, cols = np.arange(-300, 400, 7), np.arange(-513, 200, 11)
    y, x = 0.5 * rows[:, None], 0.5 * cols[None, :]
    shapes: list[tuple[Source, npt.NDArray[np.float64]]] = [
        (Flat(grid, 103.0), 103.0 + 0.0 * (x + y)),
        (Plane(grid, 103.0, 0.1234567, -0.3), 103.0 + 0.1234567 * x - 0.3 * y),
        (Sine(grid, 20.0, 57.3, height=99.0), 99.0 + 20.0 * np.sin(2.0 * np.pi * x / 57.3) + 0 * y),
        (
            Sine(grid, 20.0, 50.0, 80.0),
            20.0 * np.sin(2.0 * np.pi * x / 50.0) * np.sin(2.0 * np.pi * y / 80.0),
        ),
        (
            Cone(grid, 30.0, 100.0, ground=98.0, row=4, col=-6, dx=0.3, dy=-0.1),
            98.0 + 30.0 * np.maximum(0.0, 1.0 - np.hypot(x + 2.7, y - 1.9) / 100.0),
        ),
    ]
    for source, expected in shapes:
        heights = to_metres(source.posts(0, rows, cols), grid.datum)
        np.testing.assert_allclose(heights, expected, rtol=0.0, atol=0.5000001e-5)


def test_far_from_the_origin_a_shape_is_the_same_to_the_bit() -> None:
    """10,000 km away, measured from a post there, every count is as at the origin."""
    far = 20_000_000
    near_grid = Grid(512, 512, spacing=0.5)
    far_grid = dataclasses.replace(near_grid, row=far, col=-far)
    rows, cols = np.arange(512), np.arange(512)
    for near, away in (
        (Plane(near_grid, 1.0, 0.37, 0.21), Plane(far_grid, 1.0, 0.37, 0.21, row=far, col=-far)),
        (Sine(near_grid, 9.0, 33.3, 21.7), Sine(far_grid, 9.0, 33.3, 21.7, row=far, col=-far)),
        (
            Cone(near_grid, 9.0, 90.0, row=200, col=250, dx=0.1),
            Cone(far_grid, 9.0, 90.0, row=far + 200, col=250 - far, dx=0.1),
        ),
    ):
        np.testing.assert_array_equal(
            near.posts(0, rows, cols), away.posts(0, rows + far, cols - far)
        )


def test_waves_of_whole_posts_repeat_to_the_bit_over_the_largest_terrain() -> None:
    """Eight million waves of 20 km on, the counts are the same."""
    grid = Grid(2**30 - 1, 2**30 - 1, spacing=0.1, row=-(2**29), col=-(2**29))
    waves = Sine(grid, amplitude=20_000.0, wavelength=6.3, wavelength_y=2.1)
    rows, cols = np.arange(100), np.arange(100)
    np.testing.assert_array_equal(
        waves.posts(0, rows, cols), waves.posts(0, rows - 21_000_000, cols + 504_000_000)
    )


def test_a_plane_of_whole_counts_a_post_has_no_error() -> None:
    """Rising by whole counts from post to post it is itself at every level; else within one."""
    key = Block(1, 0, 0)
    assert Plane(ALIGNED, slope_x=0.5, slope_y=0.25).bound(key) == 0
    assert Plane(ALIGNED, slope_x=0.5 + 1e-5 / 3.0).bound(key) == 1
    assert Plane(UNEVEN, slope_x=0.5).bound(Block(1, -1, -1)) == 0
    assert Plane(UNEVEN, slope_x=0.5).bound(Block(1, -1, -2)) > 0


def test_a_paraboloid_reaches_the_curvature_bound() -> None:
    """x^2 + y^2 over a right triangle is off by H^2 / 2 in the middle of the long side, no more."""
    leg = 0.7
    middle = 2.0 * (leg / 2.0) ** 2
    assert leg**2 - middle == pytest.approx(curvature_bound(leg, 2.0, 0.0, 2.0))
    # A kink of slopes +-1 in the middle of a leg is off by H / 2.
    assert slope_bound(leg, 1.0, 0.0) == pytest.approx(leg / 2.0)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: Flat(UNEVEN, math.nan), "height must be finite, got nan"),
        (lambda: Flat(UNEVEN, 30_000.0), "set a datum nearer"),
        (lambda: Plane(UNEVEN, slope_x=math.inf), "slope_x must be finite"),
        (lambda: Plane(UNEVEN, slope_x=200.0), "use gentler slopes"),
        (lambda: Sine(UNEVEN, 1.0, 0.0), "wavelength must be positive"),
        (lambda: Sine(UNEVEN, 1.0, math.inf), "wavelength must be finite"),
        (lambda: Sine(UNEVEN, 1.0, 1.0, math.nan), "wavelength_y must be positive"),
        (lambda: Sine(UNEVEN, 21_000.0, 9.0, height=900.0), "set a datum nearer"),
        (lambda: Cone(UNEVEN, 1.0, -2.0), "radius must be positive"),
        (lambda: Cone(UNEVEN, math.nan, 2.0), "height must be finite"),
    ],
)
def test_what_has_no_heights_is_refused(make: object, text: str) -> None:
    """Each bad value is named with its rule."""
    assert callable(make)
    with pytest.raises(InputError, match=text):
        make()
