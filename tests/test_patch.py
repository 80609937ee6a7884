"""Patches: whole numbers added to a rectangle of posts, exactly, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest

from terrasim.counts import HOLE, MAX_COUNT, Counts
from terrasim.deform.patch import Patch, apply_patch, check_patch
from terrasim.deform.window import NO_GROUND, read_window
from terrasim.errors import InputError
from terrasim.grid import Block, Grid
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

ODD = Grid(300, 560, 0.75, row=-20, col=-37)
"""Neither edge is a post of any level but 0, and the origin lies inside."""


def rough(grid: Grid, seed: int = 0) -> Counts:
    """Independent random heights of +-10 m, with a few holes."""
    rng = np.random.default_rng(seed)
    posts = rng.integers(-1_000_000, 1_000_000, (grid.rows, grid.cols), dtype=np.int32)
    posts[rng.random(posts.shape) < 0.01] = HOLE
    return posts


def random_counts(rows: int, cols: int, seed: int = 3) -> Counts:
    rng = np.random.default_rng(seed)
    return rng.integers(-50_000, 50_000, (rows, cols), dtype=np.int32)


@pytest.mark.parametrize("threads", [1, 3])
def test_a_patch_adds_its_counts_and_nothing_else(threads: int) -> None:
    """Over corners of four blocks and both edges; the ledger is the difference of the sums."""
    before = rough(ODD)
    counts = random_counts(280, 300)
    row, col = ODD.row + 20, ODD.col + 260
    expected = before.astype(np.int64)
    part = expected[20:300, 260:560]
    part += np.where(part == HOLE, 0, counts)
    with Terrain(ArraySource(before, ODD), pool_bytes=8 << 18, threads=threads) as terrain:
        ledger = apply_patch(terrain, Patch(row, col, counts))
        after = read_window(terrain, ODD.row, ODD.col, ODD.rows, ODD.cols)
    np.testing.assert_array_equal(after, np.where(expected == HOLE, NO_GROUND, expected))
    change = expected - before
    assert ledger.added == int(change[change > 0].sum()) > 0
    assert ledger.removed == -int(change[change < 0].sum()) > 0
    assert ledger.posts == np.count_nonzero(change)
    assert ledger.holes == np.count_nonzero((before[20:, 260:] == HOLE) & (counts != 0)) > 0
    assert (ledger.clamped, ledger.outside, ledger.unit) == (0, 0, 1)


def test_the_negative_of_a_patch_undoes_it() -> None:
    """Also where the counts came from a file and cannot be written to."""
    before = rough(ODD)
    counts = np.frombuffer(random_counts(100, 200).tobytes(), dtype=np.int32).reshape(100, 200)
    with Terrain(ArraySource(before, ODD)) as terrain:
        done = apply_patch(terrain, Patch(3, 100, counts))
        undone = apply_patch(terrain, Patch(3, 100, -counts))
        after = read_window(terrain, ODD.row, ODD.col, ODD.rows, ODD.cols)
    wide = before.astype(np.int64)
    np.testing.assert_array_equal(after, np.where(before == HOLE, NO_GROUND, wide))
    assert (done.added, done.removed, done.posts) == (undone.removed, undone.added, undone.posts)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_height_stops_at_the_end_of_the_range_and_is_counted(sign: int) -> None:
    grid = Grid(20, 20, 1.0)
    before = np.full((20, 20), sign * (MAX_COUNT - 10), np.int32)
    counts = np.full((2, 3), sign * MAX_COUNT, np.int32)
    counts[0, 0] = sign * 10
    with Terrain(ArraySource(before, grid)) as terrain:
        ledger = apply_patch(terrain, Patch(4, 5, counts))
        after = read_window(terrain, 0, 0, 20, 20)
        lowest, highest, _ = terrain.cache.describe(Block(0, 0, 0))
    assert (after[4:6, 5:8] == sign * MAX_COUNT).all()
    assert (ledger.clamped, ledger.posts, abs(ledger.net)) == (5, 6, 60)
    assert sorted((sign * lowest, sign * highest)) == [MAX_COUNT - 10, MAX_COUNT]


@pytest.mark.parametrize(
    ("row", "col", "rows", "said"),
    [
        (-1, 0, 3, r"rows 0 to 19, got -1 to 1"),
        (18, 0, 3, r"rows 0 to 19, got 18 to 20"),
        (0, -5, 3, r"columns 0 to 29, got -5 to -2"),
        (0, 27, 3, r"columns 0 to 29, got 27 to 30"),
    ],
)
def test_a_patch_beyond_the_terrain_is_refused_and_nothing_changes(
    row: int, col: int, rows: int, said: str
) -> None:
    grid = Grid(20, 30, 1.0)
    patch = Patch(row, col, np.ones((rows, 4), np.int32))
    with Terrain(ArraySource(np.zeros((20, 30), np.int32), grid)) as terrain:
        with pytest.raises(InputError, match=f"a patch must lie on the terrain, {said}"):
            check_patch(terrain, patch)
        with pytest.raises(InputError, match=said):
            apply_patch(terrain, patch)
        assert not read_window(terrain, 0, 0, 20, 30).any()


@pytest.mark.parametrize(
    ("counts", "said"),
    [
        (np.zeros((2, 2)), "must be int32, got float64"),
        (np.zeros(4, np.int32), r"must be 2-D and not empty, got shape \(4,\)"),
        (np.zeros((0, 4), np.int32), r"not empty, got shape \(0, 4\)"),
        (np.full((1, 1), HOLE, np.int32), "has no negative"),
    ],
)
def test_what_is_no_rectangle_of_counts_is_refused(counts: Counts, said: str) -> None:
    with pytest.raises(InputError, match=said):
        Patch(0, 0, counts)


def test_a_window_beyond_the_terrain_repeats_its_edge() -> None:
    """As exact int64 counts, whatever the pool; a hole is the smallest int64."""
    before = rough(ODD)
    wide = np.where(before == HOLE, NO_GROUND, before.astype(np.int64))
    with Terrain(ArraySource(before, ODD), pool_bytes=8 << 18) as terrain:
        found = read_window(terrain, ODD.row - 7, ODD.col - 300, ODD.rows + 9, ODD.cols + 310)
        inside = read_window(terrain, 0, 0, 2, 3)
    assert found.dtype == np.int64
    np.testing.assert_array_equal(found, np.pad(wide, ((7, 2), (300, 10)), mode="edge"))
    np.testing.assert_array_equal(inside, wide[20:22, 37:40])
