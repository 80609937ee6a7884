"""Stamps of all modes: each post against the formulas, in their order, however they are cut."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.counts import HOLE, MAX_COUNT, Counts
from terrasim.deform.apply import apply_stamps
from terrasim.deform.ledger import Ledger, LedgerByStamp
from terrasim.deform.shapes.stamp import Mode
from terrasim.deform.stamps import ConeStamp, Crater, Gaussian, Stamp
from terrasim.errors import InputError
from terrasim.grid import Block, Grid
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

Metres = npt.NDArray[np.float64]
SMALL_POOL = 10 << 18
"""Bytes of ten blocks."""
GRID = Grid(300, 560, 0.75, row=-20, col=-37, datum=100.0)


def rough(grid: Grid, seed: int = 0) -> Counts:
    """Independent random heights of +-10 m about the datum."""
    shape = (grid.rows, grid.cols)
    return np.random.default_rng(seed).integers(-1_000_000, 1_000_000, shape, dtype=np.int32)


def heights(terrain: Terrain) -> Counts:
    """All posts of level 0 within the terrain."""
    grid = terrain.grid
    span = grid.blocks(0)
    found = np.zeros(((span.row1 - span.row0) * 256, (span.col1 - span.col0) * 256), np.int32)
    for row in range(span.row0, span.row1):
        for col in range(span.col0, span.col1):
            [layer] = terrain.cache.hold([Block(0, row, col)])
            top, left = (row - span.row0) * 256, (col - span.col0) * 256
            found[top : top + 256, left : left + 256] = terrain.cache.pool.read(layer)
    top, left = grid.row - span.row0 * 256, grid.col - span.col0 * 256
    return found[top : top + grid.rows, left : left + grid.cols]


def shape(stamp: Stamp, r: Metres) -> tuple[Metres, Metres]:
    """Height [m] and weight of a round stamp at a distance [m], as its docstring states them."""
    if isinstance(stamp, Gaussian):
        weight = np.where(r < stamp.cut, np.exp(-(r**2) / (2 * stamp.sigma**2)), 0.0)
        return stamp.amplitude * weight, weight
    if isinstance(stamp, ConeStamp):
        weight = np.maximum(0.0, 1.0 - r / stamp.radius)
        return stamp.height * weight, weight
    assert isinstance(stamp, Crater)
    s = r / stamp.radius
    t = np.maximum(0.0, (np.maximum(s, 1.0) ** -3 - 1 / 27) / (26 / 27))
    bowl = (stamp.depth + stamp.rim_height) * s**2 - stamp.depth
    weight = np.where(s <= 1.0, 1.0, t if stamp.rim_height else 0.0)
    return np.where(s <= 1.0, bowl, stamp.rim_height * t), weight


def made_of(before: npt.NDArray[np.int64], stamp: Stamp, grid: Grid) -> npt.NDArray[np.int64]:
    """What a stamp makes of posts, by the formulas of the modes."""
    rows = (grid.row + np.arange(grid.rows)) * grid.spacing - stamp.y
    cols = (grid.col + np.arange(grid.cols)) * grid.spacing - stamp.x
    height, weight = shape(stamp, np.hypot(rows[:, None], cols))
    if stamp.mode == "add":
        return before + np.rint(height * 1e5).astype(np.int64)
    assert stamp.z is not None
    surface = np.rint((stamp.z - grid.datum) * 1e5 + height * 1e5).astype(np.int64)
    after = {
        "dig": np.minimum(before, surface),
        "fill": np.maximum(before, surface),
        "replace": surface,
        "blend": before + np.rint(weight * (surface - before)).astype(np.int64),
    }[stamp.mode]
    return np.where(weight > 0.0, after, before)


def mixed(count: int, grid: Grid, seed: int = 3) -> list[Stamp]:
    """Stamps of three kinds and all modes, some beyond the edges."""
    rng = np.random.default_rng(seed)
    modes: tuple[Mode, ...] = ("add", "dig", "fill", "replace", "blend")
    stamps: list[Stamp] = []
    for i in range(count):
        x = (grid.col + rng.uniform(-0.1, 1.1) * grid.cols) * grid.spacing
        y = (grid.row + rng.uniform(-0.1, 1.1) * grid.rows) * grid.spacing
        size = float(np.exp(rng.uniform(0.5, 3.0)))
        mode = modes[int(rng.integers(5))]
        z = None if mode == "add" else float(grid.datum + rng.uniform(-8.0, 8.0))
        height = rng.uniform(-3.0, 3.0)
        if i % 3 == 0:
            stamps.append(Gaussian(x, y, height, size, mode=mode, z=z))
        elif i % 3 == 1:
            stamps.append(Crater(x, y, size, abs(height), 1.0, mode=mode, z=z))
        else:
            stamps.append(ConeStamp(x, y, 2 * size, height, mode=mode, z=z))
    return stamps


@pytest.mark.parametrize("mode", ["add", "dig", "fill", "replace", "blend"])
def test_each_mode_does_what_its_formula_says(mode: Mode) -> None:
    """But for a count where a height lies on half of one, or a post on the very edge."""
    before = rough(GRID)
    z = None if mode == "add" else 101.5
    for stamp in (
        Gaussian(100.3, 60.2, 2.5, 9.0, mode=mode, z=z),
        Crater(150.7, 90.1, 14.0, 3.0, 1.0, mode=mode, z=z),
        ConeStamp(250.0, 50.0, 30.0, -4.0, mode=mode, z=z),
    ):
        with Terrain(ArraySource(before, GRID)) as terrain:
            ledger = apply_stamps(terrain, [stamp])
            after = heights(terrain)
        wrong = np.abs(after - made_of(before.astype(np.int64), stamp, GRID))
        assert np.count_nonzero(wrong > 1) == 0
        assert np.count_nonzero(wrong) <= 2
        change = after.astype(np.int64) - before
        assert ledger.posts == np.count_nonzero(change) > 100
        assert (ledger.added, -ledger.removed) == (change.clip(0).sum(), change.clip(None, 0).sum())


def test_a_mixed_batch_is_one_stamp_after_another() -> None:
    """In one call and in many, with any pool and threads: the same bits of every block."""
    stamps = mixed(40, GRID)
    found = []
    for size, pool, threads in [(40, 64 << 20, 1), (1, 64 << 20, 1), (7, SMALL_POOL, 3)]:
        with Terrain(ArraySource(rough(GRID), GRID), pool_bytes=pool, threads=threads) as terrain:
            for i in range(0, 40, size):
                apply_stamps(terrain, stamps[i : i + size])
            found.append(heights(terrain))
    np.testing.assert_array_equal(found[1], found[0])
    np.testing.assert_array_equal(found[2], found[0])
    expected = rough(GRID).astype(np.int64)
    for stamp in stamps:
        expected = made_of(expected, stamp, GRID)
    # A count won or lost by rounding stays until something replaces it.
    assert np.abs(found[0] - expected).max() <= 3


def test_the_order_of_modes_matters() -> None:
    """Otherwise the test above proves nothing."""
    stamps = mixed(40, GRID)
    found = []
    for order in (1, -1):
        with Terrain(ArraySource(rough(GRID), GRID)) as terrain:
            apply_stamps(terrain, stamps[::order])
            found.append(heights(terrain))
    assert np.count_nonzero(found[0] != found[1]) > 1000


@pytest.mark.parametrize("shift", [(0, 37), (101, 0), (255, -1)])
def test_where_blocks_end_does_not_matter(shift: tuple[int, int]) -> None:
    """The same ground and stamps with the borders of blocks elsewhere: the same bits."""
    moved = Grid(300, 560, 0.75, row=-20 + shift[0], col=-37 + shift[1], datum=100.0)
    stamps = mixed(30, GRID)
    found = []
    for grid, anchor in ((GRID, (0, 0)), (moved, shift)):
        with Terrain(ArraySource(rough(GRID), grid)) as terrain:
            ledger = apply_stamps(terrain, stamps, anchor=anchor)
            found.append((ledger, heights(terrain).tobytes()))
    assert found[0] == found[1]


def test_each_stamp_has_its_own_account() -> None:
    """What it did to the ground that those before it left; with any number of launches."""
    stamps = [*mixed(24, GRID), Gaussian(-1e5, 0.0, 1.0, 1.0)]
    alone = []
    with Terrain(ArraySource(rough(GRID), GRID)) as terrain:
        alone = [apply_stamps(terrain, [stamp]) for stamp in stamps]
        wanted = heights(terrain)
    with Terrain(ArraySource(rough(GRID), GRID), pool_bytes=SMALL_POOL, threads=3) as terrain:
        ledger = apply_stamps(terrain, stamps, by_stamp=True)
        np.testing.assert_array_equal(heights(terrain), wanted)
    assert isinstance(ledger, LedgerByStamp)
    assert list(ledger.stamps) == [(one.removed, one.added) for one in alone]
    assert sum(added - removed for removed, added in ledger.stamps) == ledger.net
    with Terrain(ArraySource(rough(GRID), GRID)) as terrain:
        plain = apply_stamps(terrain, stamps)
    assert vars(plain) == {k: v for k, v in vars(ledger).items() if k != "stamps"}


def test_what_was_added_is_taken_back_exactly() -> None:
    """In another order, and with something else added meanwhile."""
    before = rough(GRID)
    added = [stamp for stamp in mixed(60, GRID) if stamp.mode == "add"]
    other = Crater(120.0, 70.0, 20.0, 2.0, 1.0)
    with Terrain(ArraySource(before, GRID)) as terrain:
        done = apply_stamps(terrain, added)
        apply_stamps(terrain, [other])
        undone = apply_stamps(terrain, added[::-1], undo=True)
        apply_stamps(terrain, [other], undo=True)
        np.testing.assert_array_equal(heights(terrain), before)
    assert len(added) > 5
    assert (done.added, done.removed) == (undone.removed, undone.added)


def test_only_what_adds_can_be_taken_back() -> None:
    with Terrain(ArraySource(rough(GRID), GRID)) as terrain:
        with pytest.raises(InputError, match=r"mode add can be taken back .* crater of mode dig"):
            apply_stamps(terrain, [Crater(9.0, 9.0, 5.0, 1.0, mode="dig", z=90.0)], undo=True)
        np.testing.assert_array_equal(heights(terrain), rough(GRID))


@pytest.mark.parametrize("mode", ["dig", "fill", "replace", "blend"])
def test_no_mode_fills_a_hole(mode: Mode) -> None:
    before = rough(GRID)
    before[100, 100:105] = HOLE
    x, y = (GRID.col + 102) * GRID.spacing, (GRID.row + 100) * GRID.spacing
    with Terrain(ArraySource(before, GRID)) as terrain:
        ledger = apply_stamps(terrain, [ConeStamp(x, y, 8.0, 1.0, mode=mode, z=50.0)])
        after = heights(terrain)
    np.testing.assert_array_equal(after == HOLE, before == HOLE)
    assert ledger.holes == 5


def test_a_batch_that_meets_the_end_of_the_range_is_still_one_after_another() -> None:
    """Up to the end and back: what was lost there is lost, in one call as in three."""
    grid = Grid(60, 60, 1.0)
    before = np.full((60, 60), MAX_COUNT - 50_000, np.int32)
    stamps: list[Stamp] = [
        Gaussian(30.0, 30.0, 1.0, 6.0),
        Gaussian(30.0, 30.0, -1.0, 6.0),
        ConeStamp(20.0, 20.0, 9.0, 1.0, mode="replace", z=3e4),
    ]
    found = []
    for size in (3, 1):
        with Terrain(ArraySource(before, grid)) as terrain:
            ledger = Ledger()
            for i in range(0, 3, size):
                ledger += apply_stamps(terrain, stamps[i : i + size])
            found.append((ledger.net, heights(terrain)))
    assert found[0][0] == found[1][0]
    np.testing.assert_array_equal(found[0][1], found[1][1])
    assert found[0][1][30, 30] == MAX_COUNT - 100_000
    assert found[0][1][20, 20] == MAX_COUNT
