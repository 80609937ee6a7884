"""A terrain far from the origin answers as one at the origin."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import terrasim as ts
from terrasim.cache.pool import BLOCK_BYTES
from terrasim.counts import Counts
from terrasim.grid import Grid
from terrasim.kernels.addressing import BLOCK

SIDE = 700
"""Posts along a side: three levels."""
FAR = 39_062 * BLOCK
"""Posts, here metres: about 10,000 km, a whole number of blocks of level 1 but not of level 2."""
VERY_FAR = 9_766 * (BLOCK << 2)
"""A whole number of blocks of every level."""

Metres = npt.NDArray[np.float64]


def rough() -> Counts:
    """Steep ground at 4,000 m."""
    noise = np.random.default_rng(0).normal(4e8, 2e5, (SIDE, SIDE))
    posts: Counts = np.rint(noise).astype(np.int32)
    return posts


def answers(grid: Grid, points: Metres) -> list[dict[str, Any]]:
    """All answers of all levels, from a pool that holds a third of the terrain."""
    with ts.Terrain(ts.ArraySource(rough(), grid), pool_bytes=8 * BLOCK_BYTES) as terrain:
        return [
            vars(ts.sample_all(terrain, points, level=level))
            | {"quick": ts.sample(terrain, points, level=level).height}
            for level in range(grid.levels)
        ]


def exact_points() -> Metres:
    """Points on and around the terrain, in steps of 2^-24 m: exact at 10,000 km too."""
    random = np.random.default_rng(1)
    points = random.integers(-(5 << 24), (SIDE + 5) << 24, (20_000, 2)) / 2.0**24
    points[::3] = np.floor(points[::3])
    points[1::3, 1] = np.floor(points[1::3, 1]) + points[1::3, 0] - np.floor(points[1::3, 0])
    return points


@pytest.mark.parametrize(
    ("row", "col"), [(VERY_FAR, VERY_FAR), (-VERY_FAR, VERY_FAR), (0, -VERY_FAR)]
)
def test_far_away_by_whole_blocks_every_bit_is_the_same(row: int, col: int) -> None:
    here = answers(Grid(SIDE, SIDE, 1.0), exact_points())
    there = answers(Grid(SIDE, SIDE, 1.0, row=row, col=col), exact_points() + np.array([col, row]))
    for level, (near, far) in enumerate(zip(here, there, strict=True)):
        for name, values in near.items():
            assert values.tobytes() == far[name].tobytes(), (name, level)


@pytest.mark.parametrize("shift", [FAR, -FAR, 3 * BLOCK])
def test_blocks_cut_elsewhere_change_only_their_own_bounds(shift: int) -> None:
    """The levels' posts are the same as long as the shift is a whole number of their spacing."""
    here = answers(Grid(SIDE, SIDE, 1.0), exact_points())
    there = answers(
        Grid(SIDE, SIDE, 1.0, row=shift, col=-shift), exact_points() + np.array([-shift, shift])
    )
    for near, far in zip(here, there, strict=True):
        for name, values in near.items():
            assert name == "error" or values.tobytes() == far[name].tobytes(), name


def test_far_away_by_the_origin_of_coordinates_every_bit_is_the_same() -> None:
    """UTM and the like: the posts begin at zero, their world coordinates do not."""
    here = answers(Grid(SIDE, SIDE, 1.0), exact_points())
    there = answers(Grid(SIDE, SIDE, 1.0, x=1e7, y=-1e7), exact_points() + np.array([1e7, -1e7]))
    for near, far in zip(here, there, strict=True):
        for name, values in near.items():
            assert values.tobytes() == far[name].tobytes(), name


@pytest.mark.parametrize("spacing", [1.0, 0.3, 30.0 / 7.0])
@pytest.mark.parametrize("shift", [FAR + 77, -FAR - 1, 12_345_678])
def test_any_other_shift_keeps_heights_to_ten_micrometres(shift: int, spacing: float) -> None:
    """A coordinate is rounded to 2 nm there; the ground rises 8 m a post at most."""
    points = np.random.default_rng(2).uniform(0.0, (SIDE - 1) * spacing, (20_000, 2))
    near = answers(Grid(SIDE, SIDE, spacing), points)[0]
    grid = Grid(SIDE, SIDE, spacing, row=shift, col=shift)
    far = answers(grid, points + shift * spacing)[0]
    np.testing.assert_allclose(far["height"], near["height"], rtol=0, atol=1e-5)


def test_a_datum_far_above_keeps_differences_exact() -> None:
    """Heights are counted from it, so those of a coarse datum differ by the datum alone."""
    points = exact_points()
    low = answers(Grid(SIDE, SIDE, 1.0), points)[0]
    high = answers(Grid(SIDE, SIDE, 1.0, datum=8192.0), points)[0]
    for name in ("normal", "slope", "error", "state"):
        assert low[name].tobytes() == high[name].tobytes()
    np.testing.assert_allclose(high["height"] - 8192.0, low["height"], rtol=0, atol=2e-12)
