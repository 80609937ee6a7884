"""Applying stamps: exact sums of rounded shapes at every level, a ledger and block bounds."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.counts import COUNT_M, HOLE, MAX_COUNT, Counts
from terrasim.deform import placing
from terrasim.deform.apply import apply_stamps as apply
from terrasim.deform.apply import check_stamps
from terrasim.deform.stamps import ConeStamp, Crater, Gaussian, Stamp
from terrasim.deform.target import target_of
from terrasim.errors import InputError, RunError
from terrasim.grid import Block, Grid
from terrasim.sources.analytic import Flat
from terrasim.sources.array_source import ArraySource
from terrasim.sources.source import BlockData
from terrasim.terrain import Terrain

SMALL_POOL = 10 << 18
"""Bytes of ten blocks."""
ODD = Grid(300, 560, 0.75, row=-20, col=-37)
"""Neither edge is a post of any level but 0, and the origin lies inside."""
Heights = npt.NDArray[np.int64]


def rough(grid: Grid, seed: int = 0) -> Counts:
    """Independent random heights of +-10 m."""
    shape = (grid.rows, grid.cols)
    return np.random.default_rng(seed).integers(-1_000_000, 1_000_000, shape, dtype=np.int32)


def field(stamps: Sequence[Stamp], grid: Grid, anchor: tuple[int, int] = (0, 0)) -> Heights:
    """What stamps add to each post, from the formulas alone [counts]."""
    rows = (grid.row - anchor[0] + np.arange(grid.rows)) * grid.spacing
    cols = (grid.col - anchor[1] + np.arange(grid.cols)) * grid.spacing
    total = np.zeros((grid.rows, grid.cols), dtype=np.int64)
    for stamp in stamps:
        r = np.hypot(rows[:, None] - stamp.y, cols[None, :] - stamp.x)
        total += np.rint(profile(stamp, r) / COUNT_M).astype(np.int64)
    return total


def profile(stamp: Stamp, r: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Height of a stamp at a distance [m], as its docstring states it."""
    if isinstance(stamp, Gaussian):
        return stamp.amplitude * np.exp(-(r**2) / (2 * stamp.sigma**2))
    assert isinstance(stamp, Crater)
    s = r / stamp.radius
    q = 3.0**-3
    t = (np.maximum(s, 1.0) ** -3 - q) / (1.0 - q)
    bowl = (stamp.depth + stamp.rim_height) * s**2 - stamp.depth
    rim = np.where(s < 3.0, stamp.rim_height * t, 0.0)
    return np.where(s <= 1.0, bowl, rim)


def scattered(count: int, grid: Grid, seed: int = 1) -> list[Stamp]:
    """Stamps of both kinds, some beyond the edges; on a tiny terrain tiny ones."""
    rng = np.random.default_rng(seed)
    wide, high = grid.cols * grid.spacing, grid.rows * grid.spacing
    stamps: list[Stamp] = []
    for i in range(count):
        x = grid.col * grid.spacing + rng.uniform(-0.1, 1.1) * wide
        y = grid.row * grid.spacing + rng.uniform(-0.1, 1.1) * high
        size = min(float(np.exp(rng.uniform(0.0, 3.5))), max(wide, high) / 20.0)
        if i % 2:
            stamps.append(Gaussian(x, y, rng.uniform(-3.0, 3.0), size))
        else:
            stamps.append(Crater(x, y, size, rng.uniform(0.0, 3.0), rng.uniform(0.0, 1.0)))
    return stamps


def every_block(terrain: Terrain) -> list[Block]:
    return [
        Block(level, row, col)
        for level in range(terrain.grid.levels)
        for span in [terrain.grid.blocks(level)]
        for row in range(span.row0, span.row1)
        for col in range(span.col0, span.col1)
    ]


def error_of(terrain: Terrain, key: Block) -> int:
    """Error bound the cache states of a block."""
    terrain.cache.hold([key])
    return terrain.cache.describe(key)[2]


def posts_of(terrain: Terrain, key: Block) -> Counts:
    [layer] = terrain.cache.hold([key])
    return terrain.cache.pool.read(layer)


def heights(terrain: Terrain) -> Counts:
    """All posts of level 0 within the terrain."""
    grid = terrain.grid
    found = np.zeros((grid.rows, grid.cols), dtype=np.int32)
    for key in every_block(terrain):
        if key.level == 0:
            row, col = key.row * 256 - grid.row, key.col * 256 - grid.col
            top, left = max(row, 0), max(col, 0)
            part = posts_of(terrain, key)[top - row :, left - col :]
            part = part[: max(0, grid.rows - top), : max(0, grid.cols - left)]
            found[top : top + part.shape[0], left : left + part.shape[1]] = part
    return found


def assert_blocks_follow(terrain: Terrain, expected: Counts) -> None:
    """Every block of every level is what a source of the expected heights would give."""
    source = ArraySource(expected, terrain.grid)
    for key in every_block(terrain):
        wanted = source.block(key)
        np.testing.assert_array_equal(posts_of(terrain, key), wanted.posts, str(key))
        lowest, highest, error = terrain.cache.describe(key)
        assert (lowest, highest) == (wanted.lowest, wanted.highest), key
        assert error >= wanted.error, key


@pytest.mark.parametrize("grid", [ODD, Grid(513, 513, 1.0), Grid(2, 2, 1.0), Grid(600, 40, 2.0)])
def test_an_edit_reaches_every_level_with_exact_bounds(grid: Grid) -> None:
    """Posts within the last bit of the formula, edges repeated, minima and maxima exact."""
    before = rough(grid)
    stamps = scattered(30, grid)
    with Terrain(ArraySource(before, grid), pool_bytes=SMALL_POOL) as terrain:
        ledger = apply(terrain, stamps)
        after = heights(terrain)
        # A rise that lies on half a count may round either way: one count for each stamp.
        wrong = np.abs(after.astype(np.int64) - before - field(stamps, grid))
        assert wrong.max() <= 1
        assert np.count_nonzero(wrong) <= 1e-6 * wrong.size * len(stamps)
        assert_blocks_follow(terrain, after)
    assert ledger.net == int(after.sum(dtype=np.int64)) - int(before.sum(dtype=np.int64))
    assert ledger.clamped == ledger.holes == 0


def test_the_ledger_is_the_difference_of_the_height_sums() -> None:
    grid = Grid(300, 300, 1.0)
    before = rough(grid)
    stamps: list[Stamp] = [Crater(150.0, 150.0, 20.0, 3.0, 1.0)]
    stamps.append(Gaussian(40.0, 40.0, -2.0, 9.0))
    with Terrain(ArraySource(before, grid)) as terrain:
        ledger = apply(terrain, stamps)
        change = heights(terrain).astype(np.int64) - before
    assert ledger.added == int(change[change > 0].sum()) > 0
    assert ledger.removed == -int(change[change < 0].sum()) > 0
    assert ledger.net == int(change.sum())
    assert ledger.posts == int(np.count_nonzero(change))
    assert ledger.volume(2.0) == pytest.approx(ledger.net * 4e-5)


def test_everything_outside_the_reach_keeps_its_bits() -> None:
    """Also at a corner of four blocks."""
    grid = Grid(513, 513, 1.0)
    before = rough(grid)
    stamps: list[Stamp] = [Gaussian(256.2, 255.7, 2.0, 3.0), Crater(100.0, 255.9, 5.0, 1.0, 0.5)]
    with Terrain(ArraySource(before, grid)) as terrain:
        apply(terrain, stamps)
        changed = heights(terrain) != before
    rows, cols = np.mgrid[0:513, 0:513]
    near = np.zeros_like(changed)
    for stamp in stamps:
        near |= np.hypot(rows - stamp.y, cols - stamp.x) <= stamp.reach
    assert changed.any()
    assert not changed[~near].any()


def test_order_and_batches_do_not_matter() -> None:
    """Stamps in any order, in one call or many, with any pool and threads: the same bits."""
    grid = ODD
    stamps = scattered(24, grid)
    found = []
    for order, size, pool, threads in [
        (slice(None), 24, 64 << 20, 1),
        (slice(None, None, -1), 24, SMALL_POOL, 2),
        (slice(None, None, 2), 5, SMALL_POOL, 3),
    ]:
        chosen = stamps[order] if order.step != 2 else stamps[::2] + stamps[1::2]
        with Terrain(ArraySource(rough(grid), grid), pool_bytes=pool, threads=threads) as terrain:
            for i in range(0, 24, size):
                apply(terrain, chosen[i : i + size])
            blocks = [posts_of(terrain, key) for key in every_block(terrain)]
            found.append(np.stack(blocks))
    np.testing.assert_array_equal(found[1], found[0])
    np.testing.assert_array_equal(found[2], found[0])


def test_a_stamp_is_undone_by_its_negative() -> None:
    grid = Grid(300, 300, 1.0)
    before = rough(grid)
    with Terrain(ArraySource(before, grid)) as terrain:
        done = apply(terrain, [Gaussian(77.7, 88.8, 1.2345, 12.0)])
        undone = apply(terrain, [Gaussian(77.7, 88.8, -1.2345, 12.0)])
        np.testing.assert_array_equal(heights(terrain), before)
    assert (done.added, done.posts) == (undone.removed, undone.posts)


def test_threads_change_nothing_even_in_the_ledger() -> None:
    """A batch of 16 blocks is split over 3 threads."""
    grid = Grid(1100, 1100, 1.0)
    ledgers = []
    for threads in (1, 3):
        with Terrain(ArraySource(rough(grid), grid), threads=threads) as terrain:
            ledgers.append((apply(terrain, scattered(60, grid)), heights(terrain).tobytes()))
    assert ledgers[0] == ledgers[1]


def test_holes_stay_holes() -> None:
    grid = Grid(40, 40, 1.0)
    before = np.zeros((40, 40), np.int32)
    before[20, 18:23] = HOLE
    with Terrain(ArraySource(before, grid)) as terrain:
        ledger = apply(terrain, [Gaussian(20.0, 20.0, 1.0, 3.0)])
        after = heights(terrain)
        assert_blocks_follow(terrain, after)
    np.testing.assert_array_equal(after == HOLE, before == HOLE)
    assert (ledger.holes, ledger.clamped) == (5, 0)
    assert ledger.added == int(after[before != HOLE].sum(dtype=np.int64))


@pytest.mark.parametrize("sign", [1, -1])
def test_a_height_stops_at_the_end_of_the_range_and_is_counted(sign: int) -> None:
    """The lowest height is not mistaken for a hole, and error bounds hold all the same."""
    grid = Grid(300, 300, 1.0)
    before = np.full((300, 300), sign * (MAX_COUNT - 10_000), np.int32)
    with Terrain(ArraySource(before, grid)) as terrain:
        ledger = apply(terrain, [Gaussian(150.0, 150.0, sign * 1.0, 20.0)])
        after = heights(terrain)
        assert_blocks_follow(terrain, after)
    assert after[150, 150] == sign * MAX_COUNT
    assert ledger.clamped == int(np.count_nonzero(after == sign * MAX_COUNT)) > 0
    assert abs(ledger.net) == int(np.abs(after.astype(np.int64) - before).sum())


def test_a_stamp_beyond_the_terrain_is_counted() -> None:
    grid = Grid(10, 10, 1.0)
    with Terrain(ArraySource(np.zeros((10, 10), np.int32), grid)) as terrain:
        ledger = apply(terrain, [Gaussian(500.0, 0.0, 1.0, 1.5), Gaussian(5.0, 5.0, 1.0, 1.0)])
        nothing = apply(terrain, [])
    assert ledger.outside == 1
    assert ledger.posts > 0
    assert nothing.posts == nothing.outside == 0


def test_far_away_is_as_here() -> None:
    """10,000 km away the same stamps on the same ground leave the same bits."""
    far = (256 * 40_000, -256 * 40_000)
    here = Grid(300, 300, 0.7)
    there = Grid(300, 300, 0.7, row=far[0], col=far[1])
    stamps = scattered(20, here)
    found = []
    for grid, anchor in ((here, (0, 0)), (there, far)):
        with Terrain(ArraySource(rough(grid), grid)) as terrain:
            found.append((apply(terrain, stamps, anchor=anchor), heights(terrain).tobytes()))
    assert found[0] == found[1]


def test_the_bound_of_a_smooth_stamp_is_nearly_reached() -> None:
    """A gaussian whose top lies halfway along a diagonal is missed by its curvature's bound."""
    grid = Grid(257, 257, 1.0)
    with Terrain(ArraySource(np.zeros((257, 257), np.int32), grid)) as terrain:
        apply(terrain, [Gaussian(101.0, 101.0, 4.0, 30.0)])
        exact = ArraySource(heights(terrain), grid).block(Block(1, 0, 0)).error
        assert exact <= error_of(terrain, Block(1, 0, 0)) <= 1.05 * exact + 2


@pytest.mark.parametrize("side", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_a_block_knows_of_an_edit_to_its_neighbours_first_post(side: tuple[int, int]) -> None:
    """One post between four blocks of level 1: the cells of all of them rise halfway."""
    grid = Grid(1025, 1025, 1.0)
    with Terrain(ArraySource(np.zeros((1025, 1025), np.int32), grid)) as terrain:
        ledger = apply(terrain, [Gaussian(512.0, 512.0, 2.0, 0.1)])
        assert (ledger.posts, ledger.added) == (1, 200_000)
        key = Block(1, *side)
        exact = ArraySource(heights(terrain), grid).block(key).error
        assert exact == 100_000
        assert error_of(terrain, key) >= exact


def test_a_block_of_holes_has_no_range() -> None:
    grid = Grid(300, 600, 1.0)
    before = np.zeros((300, 600), np.int32)
    before[:, :256] = HOLE
    with Terrain(ArraySource(before, grid)) as terrain:
        apply(terrain, [Gaussian(250.0, 100.0, 2.0, 20.0)])
        assert_blocks_follow(terrain, heights(terrain))


def test_a_stamp_too_far_to_be_numbered_is_refused_and_nothing_changes() -> None:
    grid = Grid(10, 10, 1.0)
    with Terrain(ArraySource(np.zeros((10, 10), np.int32), grid)) as terrain:
        with pytest.raises(InputError, match="choose a nearer anchor"):
            apply(terrain, [Gaussian(5.0, 5.0, 1.0, 1.0), Gaussian(1e12, 0.0, 1.0, 1.0)])
        assert not heights(terrain).any()


@pytest.mark.parametrize(
    ("limit", "said"),
    [
        ("MAX_COLUMNS", r"the stamps span 11 columns of posts, .* apply fewer"),
        ("MAX_BLOCKS", r"the stamps touch 1 blocks, at most 0 can be applied at once"),
    ],
)
def test_more_than_fits_is_refused(monkeypatch: pytest.MonkeyPatch, limit: str, said: str) -> None:
    monkeypatch.setattr(placing, limit, 10 if limit == "MAX_COLUMNS" else 0)
    grid = Grid(20, 20, 1.0)
    with Terrain(ArraySource(np.zeros((20, 20), np.int32), grid)) as terrain:
        with pytest.raises(InputError, match=said):
            check_stamps(terrain, [Crater(10.0, 10.0, 5.0, 1.0)])
        with pytest.raises(InputError, match=said):
            apply(terrain, [Crater(10.0, 10.0, 5.0, 1.0)])
        assert not heights(terrain).any()


def test_a_stamp_over_a_whole_planet_is_refused_before_its_blocks_are_listed() -> None:
    """A quarter of a thousand million blocks are counted, not enumerated."""
    grid = Grid(2**22, 2**22, 1.0)
    with (
        Terrain(Flat(grid)) as terrain,
        pytest.raises(InputError, match="touch 268435456 block"),
    ):
        apply(terrain, [ConeStamp(2.0**21, 2.0**21, 2.0**21, 1.0)])


@pytest.mark.parametrize("detail", [False, True])
def test_a_stamp_wider_than_twice_the_terrain_is_refused_by_name(detail: bool) -> None:
    """The longest of its sides counts, of however many stamps; at twice exactly it is made."""
    grid = Grid(11, 21, 1.0)
    good = ConeStamp(10.0, 5.0, 20.0, 1.0, detail=detail)
    wide = ConeStamp(10.0, 5.0, 20.0 + 1e-9, 1.0, detail=detail)
    with Terrain(ArraySource(np.zeros((11, 21), np.int32), grid), detail_factor=4) as terrain:
        for stamps in ([wide], [good] * 40 + [wide]):
            for refused in (check_stamps, apply):
                with pytest.raises(
                    InputError, match=r"^cone: extent must be at most 40 m wide, .* got 40 m$"
                ):
                    refused(terrain, stamps)
        assert not heights(terrain).any()
        check_stamps(terrain, [good])
        assert apply(terrain, [good]).posts > 0


def test_few_stamps_are_checked_as_many_are() -> None:
    """What is let through without placing is never refused when placed."""
    grid = Grid(300, 300, 1.0, row=-(2**28), col=5)
    rng = np.random.default_rng(4)
    with Terrain(Flat(grid)) as terrain:
        target = target_of(terrain, detail=False)
        passed = 0
        for _ in range(300):
            x, y = (rng.choice([1.0, -1.0], 2) * 10.0 ** rng.uniform(0.0, 12.0, 2)).tolist()
            stamps = [ConeStamp(x, y, float(10.0 ** rng.uniform(0.0, 3.5)), 1.0)]
            anchor = (int(rng.integers(-(2**30), 2**30)), int(rng.integers(-(2**30), 2**30)))
            if placing.surely_fit(stamps, [0], target, anchor):
                passed += 1
                placing.place(stamps, [0], target, anchor)
    assert passed > 15


class Failing(ArraySource):
    """A source with a block that cannot be read."""

    broken = Block(0, 4, 4)

    def block(self, key: Block) -> BlockData:
        if key == self.broken:
            raise RunError("a block is damaged")
        return super().block(key)


@pytest.mark.parametrize("broken", [Block(0, 4, 4), Block(1, 2, 2)])
def test_a_block_that_cannot_be_read_leaves_the_ground_as_it_was(
    broken: Block, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The pool holds all that is touched, so everything is read before anything changes."""
    monkeypatch.setattr(Failing, "broken", broken)
    grid = Grid(1100, 1100, 1.0)
    with Terrain(Failing(rough(grid), grid)) as terrain:
        with pytest.raises(RunError, match=r"^a block is damaged"):
            apply(terrain, [Gaussian(550.0, 550.0, 1.0, 200.0)])
        for key in every_block(terrain):
            if key != broken:
                wanted = ArraySource(rough(grid), grid).block(key)
                np.testing.assert_array_equal(posts_of(terrain, key), wanted.posts)
                assert terrain.cache.describe(key) == (wanted.lowest, wanted.highest, wanted.error)


def test_ground_left_half_changed_is_said_to_be_so() -> None:
    """The pool holds ten of the twenty-five blocks."""
    grid = Grid(1100, 1100, 1.0)
    with (
        Terrain(Failing(rough(grid), grid), pool_bytes=SMALL_POOL) as terrain,
        pytest.raises(RunError, match=r"half-changed .* damaged\); open the terrain again"),
    ):
        apply(terrain, [Gaussian(550.0, 550.0, 1.0, 200.0)])
