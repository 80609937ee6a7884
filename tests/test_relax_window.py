"""Slumping of an array: cones and planes at the angle of repose, walls, bits that turn along."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

from terrasim.deform.relax_window import relax_window
from terrasim.deform.slump import START, Repose, Scratch, Slump
from terrasim.errors import InputError
from terrasim.grid import Span
from terrasim.kernels.detail import NO_GROUND
from terrasim.kernels.relaxation import PLOT

Heights = npt.NDArray[np.int64]

PER_METRE = 1e5
HOLE = int(np.iinfo(np.int64).min)
VOLUME = 0.1
"""Of the column that becomes a cone [m^3]."""


def slopes_of(heights: Heights) -> npt.NDArray[np.float64]:
    """Root of the mean square slope over each cell's two triangles [counts]."""
    h = heights.astype(np.float64)
    south, north = np.diff(h[:-1], axis=1), np.diff(h[1:], axis=1)
    west, east = np.diff(h[:, :-1], axis=0), np.diff(h[:, 1:], axis=0)
    return np.asarray(np.sqrt((south**2 + north**2 + west**2 + east**2) / 2.0))


def steepest(heights: Heights) -> float:
    return float(slopes_of(heights).max())


def energy(heights: Heights, repose: Repose) -> float:
    """Half the square of the slopes' excess over the angle, summed over cells."""
    return float((np.maximum(slopes_of(heights) - repose.slope, 0.0) ** 2).sum() / 2.0)


def column(angle_deg: float, posts: int) -> tuple[Heights, Repose, float, float]:
    """A column, how its sand rests, and height and base radius of the cone it becomes [m].

    Spacing is the cone's base radius over ``posts``; the column a quarter of the radius wide.
    """
    slope = math.tan(math.radians(angle_deg))
    radius = (3.0 * VOLUME / (math.pi * slope)) ** (1 / 3)
    spacing = radius / posts
    at = np.arange(-int(1.25 * posts) - 2, int(1.25 * posts) + 3)
    inside = np.hypot(at[:, None], at) < 0.25 * posts
    heights = np.zeros(inside.shape, dtype=np.int64)
    heights[inside] = round(VOLUME / spacing**2 / np.count_nonzero(inside) * PER_METRE)
    volume = int(heights.sum()) / PER_METRE * spacing**2
    height = (3.0 * volume * slope**2 / math.pi) ** (1 / 3)
    return heights, Repose(angle_deg, spacing, PER_METRE), height, height / slope


def radial_slopes(heights: Heights, spacing: float, radius: float) -> list[float]:
    """Slope from 0.3 to 0.8 of the base radius in 16 directions, by least squares over them."""
    reach = np.linspace(0.3, 0.8, 200) * radius
    middle = heights.shape[0] // 2
    found = []
    for direction in np.arange(16) * math.pi / 8:
        x = reach * math.cos(direction) / spacing + middle
        y = reach * math.sin(direction) / spacing + middle
        found.append(-float(np.polyfit(reach, on_triangles(heights, x, y) / PER_METRE, 1)[0]))
    return found


def on_triangles(
    heights: Heights, x: npt.NDArray[np.float64], y: npt.NDArray[np.float64]
) -> npt.NDArray[np.float64]:
    """The surface of the triangulated posts, x along columns [posts]."""
    col, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    u, v = x - col, y - row
    near, far = heights[row, col], heights[row + 1, col + 1]
    mid = np.where(u >= v, heights[row, col + 1], heights[row + 1, col])
    return np.asarray(near + (mid - near) * np.maximum(u, v) + (far - mid) * np.minimum(u, v))


def rough() -> Heights:
    """Hills with a cliff, a pit and holes, larger than three plots and no multiple of them."""
    rng = np.random.default_rng(5)
    walk = np.cumsum(np.cumsum(rng.integers(-100, 101, (110, 141)), axis=0), axis=1)
    heights = (20 * walk).astype(np.int64)
    heights[40:60, 30:50] += 200_000
    heights[80, 80] -= 900_000
    heights[70:80, 100:130] = HOLE
    heights[0, :5] = HOLE
    return heights


ROUGH_REPOSE = Repose(33.0, 0.05, PER_METRE)


@pytest.mark.parametrize("angle_deg", [30.0, 35.0, 40.0])
def test_a_column_becomes_the_cone_of_its_angle(angle_deg: float) -> None:
    """The height (3 V tan^2 / pi)^(1/3) within 2 %, slopes in 16 directions 1 %, volume exact."""
    heights, repose, height, radius = column(angle_deg, 50)
    done = relax_window(heights, repose, iterations=1000)
    after = heights + done.change
    assert done.awake is None
    # Without gaining pace it would be 750.
    assert done.iterations < 350
    assert int(done.change.sum()) == 0
    assert after.max() / PER_METRE == pytest.approx(height, rel=0.02)
    slopes = radial_slopes(after, repose.spacing, radius)
    np.testing.assert_allclose(slopes, math.tan(math.radians(angle_deg)), rtol=0.01)
    assert steepest(after) <= repose.slope + START


def test_a_small_column_becomes_a_cone_too() -> None:
    """The pace that sweeps gain does not throw sand further than it comes to rest."""
    heights, repose, height, radius = column(35.0, 12)
    done = relax_window(heights, repose, iterations=1000)
    after = heights + done.change
    assert after.max() / PER_METRE == pytest.approx(height, rel=0.02)
    slopes = radial_slopes(after, repose.spacing, radius)
    np.testing.assert_allclose(slopes, math.tan(math.radians(35.0)), rtol=0.02)


def test_iterations_grow_no_faster_than_the_square_of_the_posts() -> None:
    """Slumping is a diffusion: twice the posts across take four times the iterations."""
    taken = []
    for posts in (10, 20, 40):
        heights, repose, _, _ = column(35.0, posts)
        taken.append(relax_window(heights, repose, iterations=2000).iterations)
    assert np.divide(taken[1:], taken[:-1]).max() < 5.0


@pytest.mark.parametrize("spacing", [0.001, 0.02, 1000.0])
@pytest.mark.parametrize("angle_deg", [1.0, 35.0, 60.0])
def test_a_plane_at_the_angle_stays(angle_deg: float, spacing: float) -> None:
    """At any of 16 directions, rounded to counts, not a bit changes."""
    repose = Repose(angle_deg, spacing, PER_METRE)
    at = np.arange(40)
    for direction in np.arange(16) * math.pi / 8:
        along = at * math.cos(direction) + at[:, None] * math.sin(direction)
        plane = np.rint(repose.slope * along).astype(np.int64)
        done = relax_window(plane, repose, iterations=3)
        assert (done.iterations, done.moved, done.awake) == (1, 0, None)
        assert not done.change.any()


def test_nothing_moves_unless_a_cell_is_steeper() -> None:
    """The steepest cell decides, with START counts to spare."""
    rng = np.random.default_rng(4)
    heights = np.cumsum(rng.integers(-500, 501, (50, 60)), axis=0)

    def moved(slope: float) -> int:
        repose = Repose(math.degrees(math.atan(slope / PER_METRE)), 1.0, PER_METRE)
        return relax_window(heights, repose, iterations=2).moved

    assert moved(steepest(heights) - START + 0.1) == 0
    # What is less than half a count along every edge is no flow yet.
    assert moved(steepest(heights) - START - 20.0) > 0


def test_a_plane_one_degree_too_steep_relaxes_to_the_angle() -> None:
    steep = Repose(36.0, 0.1, PER_METRE)
    repose = Repose(35.0, 0.1, PER_METRE)
    plane = np.rint(steep.slope * np.arange(40) * np.ones((34, 1))).astype(np.int64)
    done = relax_window(plane, repose, iterations=1000)
    assert done.awake is None
    slopes = np.diff((plane + done.change)[17])
    # Rounding leaves up to START counts; between walls the ends are the last to settle.
    np.testing.assert_allclose(slopes[5:-5], repose.slope, atol=START + 2.0)
    assert int(done.change.sum()) == 0


TURNS: dict[str, Callable[[Any], Any]] = {
    "north and south": lambda a: a[::-1],
    "east and west": lambda a: a[:, ::-1],
    "a quarter turn": np.rot90,
    "half a turn": lambda a: np.rot90(a, 2),
    "three quarters": lambda a: np.rot90(a, 3),
    "one diagonal": lambda a: a.T,
    "the other diagonal": lambda a: np.rot90(a).T,
}


@pytest.mark.parametrize("turn", TURNS.values(), ids=TURNS)
def test_the_result_turns_with_the_ground(turn: Callable[[Any], Any]) -> None:
    heights = rough()
    straight = relax_window(heights, ROUGH_REPOSE, iterations=6)
    turned = relax_window(np.ascontiguousarray(turn(heights)), ROUGH_REPOSE, iterations=6)
    np.testing.assert_array_equal(turned.change, turn(straight.change))
    assert turned.moved == straight.moved > 0


def tower() -> Heights:
    """A tower whose foot comes to a plot's side in one iteration and far beyond it in the next."""
    heights = np.zeros((110, 141), dtype=np.int64)
    heights[72:81, 60:69] = 10**9
    return heights


@pytest.mark.parametrize(
    ("heights", "repose"),
    [(rough(), ROUGH_REPOSE), (tower(), Repose(1.0, 0.002, PER_METRE))],
    ids=["rough", "tower"],
)
@pytest.mark.parametrize(("rows", "cols"), [(1, 0), (7, 30), (31, 16)])
def test_where_the_plots_lie_changes_nothing(
    rows: int, cols: int, heights: Heights, repose: Repose
) -> None:
    """What an iteration moves stops at no plot's side, and wakes what it comes to."""
    moved = np.full((110 + rows, 141 + cols), HOLE)
    moved[rows:, cols:] = heights
    straight = relax_window(heights, repose, iterations=6)
    np.testing.assert_array_equal(
        relax_window(moved, repose, iterations=6).change[rows:, cols:], straight.change
    )


@pytest.mark.parametrize(("part", "threads"), [(1, 1), (2, 1), (3, 2), (None, 3)])
def test_neither_parts_nor_threads_change_a_bit(part: int | None, threads: int) -> None:
    heights = rough()
    whole = relax_window(heights, ROUGH_REPOSE, iterations=3)
    cut = relax_window(heights, ROUGH_REPOSE, iterations=3, part=part, threads=threads)
    np.testing.assert_array_equal(cut.change, whole.change)
    assert cut.moved == whole.moved


def test_many_iterations_are_one_after_another() -> None:
    heights = rough()
    at_once = relax_window(heights, ROUGH_REPOSE, iterations=6)
    moved = 0
    for _ in range(6):
        one = relax_window(heights, ROUGH_REPOSE, iterations=1)
        heights = heights + one.change
        moved += one.moved
    np.testing.assert_array_equal(heights, rough() + at_once.change)
    assert moved == at_once.moved


def test_what_else_lies_in_the_scratch_arrays_does_not_matter() -> None:
    """Posts beyond a part's margin are not written before they are read."""
    size = 6 * PLOT
    heights = np.full((size, size), np.nan)
    heights[PLOT:-PLOT, PLOT:-PLOT] = np.random.default_rng(2).integers(
        0, 100_000, (size - 2 * PLOT, size - 2 * PLOT)
    )
    repose = Repose(35.0, 0.1, PER_METRE)
    scratch, other = (Scratch(wp.get_device("cpu"), 2) for _ in range(2))
    clean, dirty = Slump(heights, repose, scratch), Slump(heights, repose, other)
    for values, rubbish in ((scratch, 0.0), (other, -3e9)):
        for array in (values.height, values.excess, *values.flows):
            array.fill_(rubbish)
    other.excess.fill_(0.5)
    awake = np.zeros(clean.shape, dtype=np.bool_)
    awake[2, 3] = True
    assert clean.iterate(awake)[:4] == dirty.iterate(awake)[:4]
    np.testing.assert_array_equal(clean.heights(), dirty.heights())


def test_holes_are_walls() -> None:
    """No sand crosses a line of holes, nor falls into it, and holes stay."""
    rng = np.random.default_rng(8)
    heights = rng.integers(0, 300_000, (50, 60)).astype(np.int64)
    heights[:, 20] = HOLE
    heights[30, 40] = NO_GROUND
    done = relax_window(heights, Repose(30.0, 0.05, PER_METRE), iterations=40)
    assert done.change[:, :20].any()
    assert int(done.change[:, :20].sum()) == 0
    assert int(done.change[:, 21:].sum()) == 0
    assert not done.change[heights <= NO_GROUND].any()


def test_ground_one_post_wide_slumps_along_itself() -> None:
    heights = np.full((40, 3), HOLE)
    heights[:, 1] = 0
    heights[20, 1] = 100_000
    repose = Repose(45.0, 0.05, PER_METRE)
    done = relax_window(heights, repose, iterations=200)
    after = (heights + done.change)[:, 1]
    assert done.awake is None
    assert np.abs(np.diff(after)).max() <= repose.slope + START
    assert int(after.sum()) == 100_000


def test_only_what_is_near_what_is_too_steep_changes() -> None:
    heights = np.zeros((200, 230), dtype=np.int64)
    heights[100, 150] = 30_000
    done = relax_window(heights, Repose(35.0, 0.05, PER_METRE), iterations=100)
    assert done.awake is None
    # A cone of this volume has a base radius of 2.3 posts.
    changed = np.argwhere(done.change)
    assert np.abs(changed - (100, 150)).max() <= 4


def test_what_is_still_awake_is_named() -> None:
    heights = np.zeros((200, 230), dtype=np.int64)
    heights[90:110, 140:160] = 300_000
    done = relax_window(heights, Repose(35.0, 0.05, PER_METRE), iterations=1)
    assert done.awake is not None
    assert done.awake == Span(64, 128, 128, 192)


STIFF: dict[str, tuple[float, float, int, int]] = {
    "a cliff of 10 km over 1 km posts": (35.0, 1000.0, 10**9, 30),
    "a cliff of 10 km over 1 m posts": (35.0, 1.0, 10**9, 30),
    "a spike of 20 km": (35.0, 1.0, 2 * 10**9, 1),
    "a spike of 1 m over 1 mm posts": (35.0, 0.001, 10**5, 1),
    "a shallow angle": (1.0, 0.01, 10**6, 30),
    "no angle": (0.0, 1.0, 10**7, 30),
    "a steep angle": (80.0, 0.01, 10**6, 30),
    "a pit": (35.0, 0.1, -(10**8), 1),
}


@pytest.mark.parametrize(("angle_deg", "spacing", "height", "width"), STIFF.values(), ids=STIFF)
def test_stiff_ground_stays_within_its_range(
    angle_deg: float, spacing: float, height: int, width: int
) -> None:
    """Volume is exact, no post leaves the range of those around it, and E only falls."""
    heights = np.zeros((61, 70), dtype=np.int64)
    heights[20 : 20 + width, 30 : 30 + width] = height
    repose = Repose(angle_deg, spacing, PER_METRE)
    before = energy(heights, repose)
    for _ in range(10):
        done = relax_window(heights, repose, iterations=1)
        after = heights + done.change
        assert int(done.change.sum()) == 0
        assert after.min() >= heights.min()
        assert after.max() <= heights.max()
        heights, was, before = after, before, energy(after, repose)
        assert before <= was


@pytest.mark.parametrize("slope", [0.5, 2.0, 50.0, 700.0])
def test_any_ground_comes_to_rest(slope: float) -> None:
    """What rounding leaves of one iteration does not wake the next."""
    rng = np.random.default_rng(3)
    for largest in (10, 1_000, 20_000):
        heights = rng.integers(-largest, largest + 1, (24, 24))
        repose = Repose(math.degrees(math.atan(slope / PER_METRE)), 1.0, PER_METRE)
        done = relax_window(heights, repose, iterations=1000)
        assert done.awake is None
        assert steepest(heights + done.change) <= repose.slope + START


def test_finer_counts_come_nearer_to_the_angle() -> None:
    """On a detail grid of factor 1,000 the same posts have 1,000 times the counts."""
    heights, repose, _, _ = column(35.0, 25)
    fine = Repose(repose.angle_deg, repose.spacing, 1000 * PER_METRE)
    assert fine.parts * 1000 <= 2**20
    done = relax_window(heights * 1000, fine, iterations=60)
    coarse = relax_window(heights, repose, iterations=60)
    # The same slide but for rounding.
    np.testing.assert_allclose(done.change / 1000, coarse.change, atol=40.0)
    assert int(done.change.sum()) == 0


def test_heights_that_are_no_counts_are_refused() -> None:
    repose = Repose(35.0, 1.0, PER_METRE)
    for bad in (np.zeros((3, 3)), np.zeros(3, dtype=np.int64), np.zeros((0, 3), dtype=np.int64)):
        with pytest.raises(InputError, match="heights to relax must be a 2-D array of whole"):
            relax_window(bad, repose, iterations=1)  # type: ignore[arg-type, unused-ignore]
