"""Slumping of a terrain: the same bits as of an array, however it is asked for and held."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.counts import COUNTS_PER_M, HOLE, Counts
from terrasim.deform import relax_rounds
from terrasim.deform.apply import apply_stamps
from terrasim.deform.ledger import Ledger
from terrasim.deform.plots import clusters, plots_of, rects_of
from terrasim.deform.relax_window import relax_window
from terrasim.deform.relaxation import REACH, Rect, Relaxed, relax
from terrasim.deform.slump import Repose
from terrasim.deform.stamps import Gaussian
from terrasim.deform.window import NO_GROUND, read_window
from terrasim.errors import InputError
from terrasim.grid import Grid, Span
from terrasim.output.window import read_window as read_level
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

Heights = npt.NDArray[np.int64]

SMALL_POOL = 10 << 18
"""Bytes of ten blocks."""
GRID = Grid(420, 560, 0.05, row=-130, col=-77)
"""Its origin, the corner of four blocks, lies inside."""
ORIGIN = np.array([GRID.row, GRID.col])
ANGLE = 35.0
REPOSE = Repose(ANGLE, GRID.spacing, float(COUNTS_PER_M))
ALL = Rect(GRID.row, GRID.row + GRID.rows, GRID.col, GRID.col + GRID.cols)
HEAPS = (Rect(-22, 20, -30, 31), Rect(110, 118, 200, 204), Rect(270, 290, 440, 483))
"""One over the corner of four blocks, a small one, one in the terrain's corner."""


def heaps() -> Counts:
    """Three heaps on uneven ground that stands, and a wall of holes beside one."""
    counts = np.random.default_rng(3).integers(-200, 201, (GRID.rows, GRID.cols), dtype=np.int32)
    for rect in HEAPS:
        counts[_inside(rect)] += 60_000
    counts[200:230, 120:122] = HOLE
    return counts


def _inside(rect: Rect) -> tuple[slice, slice]:
    rows = slice(rect.row0 - GRID.row, rect.row1 - GRID.row)
    return rows, slice(rect.col0 - GRID.col, rect.col1 - GRID.col)


def opened(counts: Counts, pool_bytes: int = SMALL_POOL, threads: int = 1) -> Terrain:
    return Terrain(ArraySource(counts, GRID), pool_bytes=pool_bytes, threads=threads)


def ground(terrain: Terrain) -> Heights:
    """All posts of level 0 as they are now."""
    return read_window(terrain, GRID.row, GRID.col, GRID.rows, GRID.cols)


def after(
    regions: Sequence[Rect], *, calls: int = 1, iterations: int = 12, **terrain: int
) -> tuple[Heights, Ledger, Relaxed]:
    """Heights, summed ledger and last result of some calls that go on from one another."""
    ledger = Ledger()
    with opened(heaps(), **terrain) as ground_of:
        for _ in range(calls):
            done = relax(ground_of, regions, angle_deg=ANGLE, iterations=iterations)
            regions = done.awake
            ledger += done.ledger
        return ground(ground_of), ledger, done


@pytest.fixture(scope="module")
def straight() -> tuple[Heights, Ledger, Relaxed]:
    return after(HEAPS)


def test_a_terrain_slumps_as_its_array_does(straight: tuple[Heights, Ledger, Relaxed]) -> None:
    """Over corners of blocks, at the terrain's edge, beside holes."""
    counts = heaps()
    whole = relax_window(counts, REPOSE, iterations=12)
    before = np.where(counts == HOLE, NO_GROUND, counts.astype(np.int64))
    np.testing.assert_array_equal(straight[0], before + whole.change)
    assert straight[2].moved == whole.moved > 0
    for rect in HEAPS:
        assert whole.change[_inside(rect)].any()


def test_the_ledger_is_what_moved(straight: tuple[Heights, Ledger, Relaxed]) -> None:
    """Removed equals added, and every iteration's changes are in it."""
    counts = heaps().astype(np.int64)
    counts[counts == HOLE] = np.iinfo(np.int64).min
    removed = posts = 0
    for _ in range(12):
        change = relax_window(counts, REPOSE, iterations=1).change
        counts = counts + change
        removed -= int(change[change < 0].sum())
        posts += int(np.count_nonzero(change))
    assert straight[1] == Ledger(removed, removed, posts)
    assert straight[2].ledger == straight[1]


SAME: dict[str, dict[str, int]] = {
    "a call for each iteration": {"calls": 12, "iterations": 1},
    "three calls": {"calls": 3, "iterations": 4},
    "a larger pool and two threads": {"pool_bytes": 64 << 20, "threads": 2},
}


@pytest.mark.parametrize("how", SAME.values(), ids=SAME)
def test_how_it_is_done_changes_nothing(
    how: dict[str, int], straight: tuple[Heights, Ledger, Relaxed]
) -> None:
    heights, ledger, done = after(HEAPS, **how)
    np.testing.assert_array_equal(heights, straight[0])
    assert ledger == straight[1]
    assert done.awake == straight[2].awake


def test_what_does_not_fit_in_memory_goes_square_by_square(
    straight: tuple[Heights, Ledger, Relaxed], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Squares read what those beside them had before the iteration."""
    monkeypatch.setattr(relax_rounds, "MOST_PLOTS", 0)
    monkeypatch.setattr(relax_rounds, "SQUARE", 2)
    heights, ledger, done = after(HEAPS)
    np.testing.assert_array_equal(heights, straight[0])
    assert ledger == straight[1]
    assert (done.awake, done.moved) == (straight[2].awake, straight[2].moved)


def test_ground_is_read_as_the_slide_comes_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Windows too small for what moves are read again before it leaves them."""
    monkeypatch.setattr(relax_rounds, "ROOM", 1)
    counts = np.zeros((GRID.rows, GRID.cols), dtype=np.int32)
    tower = Rect(76, 85, 108, 117)
    counts[_inside(tower)] = 10**9
    whole = relax_window(counts, Repose(1.0, GRID.spacing, float(COUNTS_PER_M)), iterations=50)
    with opened(counts) as terrain:
        done = relax(terrain, [tower], angle_deg=1.0, iterations=50)
        np.testing.assert_array_equal(ground(terrain), counts + whole.change)
    assert done.moved == whole.moved
    # The first window ends a plot beyond the tower's.
    assert np.argwhere(whole.change).min(axis=0)[0] + GRID.row < 32


def pieces(rect: Rect, side: int) -> Iterator[Rect]:
    for row in range(rect.row0, rect.row1, side):
        for col in range(rect.col0, rect.col1, side):
            yield Rect(row, min(row + side, rect.row1), col, min(col + side, rect.col1))


def test_how_the_regions_are_cut_changes_nothing(
    straight: tuple[Heights, Ledger, Relaxed],
) -> None:
    """Nor in which order they come, nor that some come twice."""
    cut = [piece for rect in HEAPS for piece in pieces(rect, 17)]
    heights, ledger, done = after([*reversed(cut), *HEAPS])
    np.testing.assert_array_equal(heights, straight[0])
    assert (ledger, done.awake) == (straight[1], straight[2].awake)


def test_looking_at_more_changes_nothing_where_the_rest_stands(
    straight: tuple[Heights, Ledger, Relaxed],
) -> None:
    heights, ledger, _ = after([ALL])
    np.testing.assert_array_equal(heights, straight[0])
    assert ledger == straight[1]


def test_all_comes_to_rest_and_then_nothing_is_done() -> None:
    with opened(heaps()) as terrain:
        done = relax(terrain, HEAPS, angle_deg=ANGLE, iterations=5000)
        assert done.awake == ()
        assert done.iterations < 5000
        heights = ground(terrain)
        again = relax(terrain, [ALL], angle_deg=ANGLE, iterations=5)
        assert (again.iterations, again.moved, again.ledger) == (1, 0, Ledger())
        assert terrain.cache.dirty <= 20
        np.testing.assert_array_equal(ground(terrain), heights)
        nothing = relax(terrain, (), angle_deg=ANGLE, iterations=5)
        assert (nothing.iterations, nothing.awake) == (0, ())


def test_ground_far_from_the_regions_sleeps() -> None:
    """However steep it is: a cliff that stood stands until something beside it moves."""
    with opened(heaps()) as terrain:
        before = ground(terrain)
        relax(terrain, HEAPS[1:2], angle_deg=ANGLE, iterations=12)
        changed = np.argwhere(ground(terrain) != before) + ORIGIN
    assert len(changed) > 0
    rect = HEAPS[1]
    assert changed.min(axis=0)[0] >= rect.row0 - 40
    assert changed.max(axis=0)[0] <= rect.row1 + 40
    assert changed.min(axis=0)[1] >= rect.col0 - 40
    assert changed.max(axis=0)[1] <= rect.col1 + 40


def test_blocks_in_which_nothing_changes_are_not_written() -> None:
    with opened(heaps(), pool_bytes=64 << 20) as terrain:
        relax(terrain, [ALL], angle_deg=89.0, iterations=3)
        assert terrain.cache.dirty == 0
        relax(terrain, HEAPS[1:2], angle_deg=ANGLE, iterations=3)
        # Its block, and those above it.
        assert terrain.cache.dirty == GRID.levels


def test_an_iteration_reaches_no_further_than_it_says() -> None:
    """Others rely on it to tell which operations may touch the same ground."""
    steep = (np.indices((GRID.rows, GRID.cols)).sum(axis=0) % 2 * 200_000).astype(np.int32)
    region = Rect(64, 65, 100, 101)
    with opened(steep) as terrain:
        before = ground(terrain)
        for iterations in (1, 2):
            relax(terrain, [region], angle_deg=ANGLE, iterations=iterations)
            changed = np.argwhere(ground(terrain) != before) + ORIGIN
            assert np.abs(changed - (region.row0, region.col0)).max() < REACH * 3


def test_every_level_follows() -> None:
    with opened(heaps()) as terrain:
        relax(terrain, HEAPS, angle_deg=ANGLE, iterations=12)
        heights = ground(terrain)
        for level in range(1, GRID.levels):
            step = 1 << level
            first = [-(-start // step) for start in (GRID.row, GRID.col)]
            rows = np.arange(first[0] * step, GRID.row + GRID.rows, step)
            cols = np.arange(first[1] * step, GRID.col + GRID.cols, step)
            span = Span(first[0], first[0] + len(rows), first[1], first[1] + len(cols))
            posts = read_level(terrain, level, span)
            expected = heights[np.ix_(rows - GRID.row, cols - GRID.col)]
            np.testing.assert_array_equal(posts, np.where(expected == NO_GROUND, HOLE, expected))


def test_detail_slumps_as_base_and_detail_together() -> None:
    """The exact totals on the detail's posts slump; the base stays as it is."""
    grid = Grid(40, 44, 0.2, row=-11, col=-9)
    base = np.random.default_rng(9).integers(-300, 301, (40, 44), dtype=np.int32)
    stamp = Gaussian(0.7, 1.1, amplitude=0.5, sigma=0.15, detail=True)
    with Terrain(ArraySource(base, grid), detail_factor=10, pool_bytes=SMALL_POOL) as terrain:
        fine = terrain.detail
        apply_stamps(terrain, [stamp])
        row, col = (grid.row - fine.row0) * 10, (grid.col - fine.col0) * 10
        size = (39 * 10 + 1, 43 * 10 + 1)
        before = read_window(terrain, row, col, *size, detail=True)
        done = relax(
            terrain,
            [Rect(row, row + size[0], col, col + size[1])],
            angle_deg=ANGLE,
            iterations=40,
            detail=True,
        )
        got = read_window(terrain, row, col, *size, detail=True)
        untouched = read_window(terrain, grid.row, grid.col, 40, 44)
    repose = Repose(ANGLE, grid.spacing / 10, COUNTS_PER_M * 10.0)
    alone = relax_window(before, repose, iterations=40)
    np.testing.assert_array_equal(got, before + alone.change)
    assert alone.change.any()
    np.testing.assert_array_equal(untouched, base)
    assert done.ledger.net == 0
    assert done.ledger.unit == 1000
    assert done.moved == alone.moved


BAD: dict[str, tuple[dict[str, object], str]] = {
    "a slope": ({"angle_deg": -0.1}, r"angle_deg must be from 0 to 89 degrees, got -0.1"),
    "a wall": ({"angle_deg": 90.0}, r"angle_deg must be from 0 to 89 degrees, got 90.0"),
    "no angle": ({"angle_deg": float("nan")}, r"angle_deg must be .*, got nan"),
    "no iteration": ({"iterations": 0}, "iterations must be a whole number, at least 1, got 0"),
    "half of one": ({"iterations": 1.5}, "iterations must be a whole number, .* got 1.5"),
    "no row": ({"regions": [Rect(3, 3, 0, 5)]}, "must have row0 < row1 .* got rows 3 to 3"),
    "turned": ({"regions": [Rect(0, 3, 5, 0)]}, "must have .* col0 < col1, got .*columns 5 to 0"),
    "half a post": ({"regions": [(0, 2.5, 0, 5)]}, "is four whole numbers within"),
    "far": ({"regions": [Rect(0, 2**31, 0, 5)]}, "is four whole numbers within"),
    "detail": ({"detail": True}, "this terrain has no detail grid"),
}


@pytest.mark.parametrize(("given", "said"), BAD.values(), ids=BAD)
def test_what_cannot_be_relaxed_is_refused(given: dict[str, object], said: str) -> None:
    asked: dict[str, object] = {"regions": [ALL], "angle_deg": ANGLE, "iterations": 1, **given}
    with opened(heaps()) as terrain:
        before = ground(terrain)
        with pytest.raises(InputError, match=said):
            relax(terrain, **asked)  # type: ignore[arg-type]
        np.testing.assert_array_equal(ground(terrain), before)


def test_too_much_at_once_is_refused_before_anything_is_allocated() -> None:
    with pytest.raises(InputError, match="at most 4194304 can be worked on at once"):
        plots_of([Span(0, 2**20, 0, 2**20)], Span(0, 2**20, 0, 2**20))


def test_regions_beyond_the_terrain_do_not_count() -> None:
    with opened(heaps()) as terrain:
        done = relax(terrain, [Rect(5000, 5100, 0, 9)], angle_deg=ANGLE, iterations=3)
        assert (done.iterations, done.awake, done.ledger) == (0, (), Ledger())


def test_rectangles_hold_exactly_their_plots() -> None:
    everything = Span(-1000, 1000, -1000, 1000)
    rng = np.random.default_rng(1)
    for density in (0.1, 0.5, 0.9):
        among = rng.random((12, 14)) < density
        # A row that looks like the last but one, with none between.
        among[4], among[5] = among[3], False
        among[6] = among[4]
        chosen = np.argwhere(among) - 5
        rects = rects_of(chosen, everything)
        np.testing.assert_array_equal(plots_of(rects, everything), chosen)
        covered = sum((one.row1 - one.row0) * (one.col1 - one.col0) for one in rects)
        assert covered == len(chosen) * 32 * 32


def test_clusters_lie_apart_and_hold_all_plots_with_their_margin() -> None:
    rng = np.random.default_rng(2)
    plots = np.unique(rng.integers(-60, 60, (25, 2)), axis=0)
    spans = clusters(plots, 4)
    assert 1 < len(spans) < 25
    for row, col in plots.tolist():
        assert any(
            one.row0 + 4 <= row < one.row1 - 4 and one.col0 + 4 <= col < one.col1 - 4
            for one in spans
        )
    held = np.zeros((200, 200), dtype=np.int64)
    for one in spans:
        held[one.row0 + 90 : one.row1 + 90, one.col0 + 90 : one.col1 + 90] += 1
    assert held.max() == 1
