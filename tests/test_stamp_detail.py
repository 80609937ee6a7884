"""Stamps on the detail grid: each post against the formulas, volumes, base and detail mixed."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.counts import HOLE, Counts
from terrasim.deform.apply import apply_stamps
from terrasim.deform.ledger import LedgerByStamp
from terrasim.deform.shapes.stamp import Mode
from terrasim.deform.stamps import ConeStamp, Crater, Gaussian, Stamp
from terrasim.errors import InputError, RunError
from terrasim.grid import Block, Grid
from terrasim.sources.analytic import Flat
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

Whole = npt.NDArray[np.int64]
GRID = Grid(270, 280, 0.75, row=-20, col=-37, datum=100.0)
"""Blocks of level 0 meet inside, and neither edge is one of theirs."""
FACTOR = 3
WIDE = Grid(600, 560, 0.75, row=-20, col=-37, datum=100.0)
"""Nine blocks of level 0."""
LAYER = 1 << 18
"""Bytes of a block."""


def rough(grid: Grid = GRID, holes: bool = False) -> Counts:
    """Independent random heights of +-10 m, a few of them holes if asked for."""
    rng = np.random.default_rng(0)
    posts = rng.integers(-1_000_000, 1_000_000, (grid.rows, grid.cols), dtype=np.int32)
    if holes:
        posts[[0, 100, 101, 200, 269], [0, 120, 121, 13, 279]] = HOLE
    return posts


def opened(
    posts: Counts,
    grid: Grid = GRID,
    *,
    factor: int = FACTOR,
    threads: int = 1,
    layers: int = 256,
    detail_layers: int = 256,
) -> Terrain:
    """A terrain with detail."""
    return Terrain(
        ArraySource(posts, grid),
        detail_factor=factor,
        threads=threads,
        pool_bytes=layers * LAYER,
        detail_pool_bytes=detail_layers * LAYER,
    )


def base_of(terrain: Terrain) -> Counts:
    """All posts of level 0 within the terrain."""
    grid = terrain.grid
    span = grid.blocks(0)
    rows, cols = (span.row1 - span.row0) * 256, (span.col1 - span.col0) * 256
    found = np.zeros((rows, cols), np.int32)
    for row in range(span.row0, span.row1):
        for col in range(span.col0, span.col1):
            [layer] = terrain.cache.hold([Block(0, row, col)])
            top, left = (row - span.row0) * 256, (col - span.col0) * 256
            found[top : top + 256, left : left + 256] = terrain.cache.pool.read(layer)
    top, left = grid.row - span.row0 * 256, grid.col - span.col0 * 256
    return found[top : top + grid.rows, left : left + grid.cols]


def detail_of(terrain: Terrain) -> Whole:
    """All differences at detail posts within the terrain, and nothing beyond."""
    inside = terrain.detail.posts
    blocks = terrain.detail.blocks
    found = np.zeros((blocks.row1 * 256, blocks.col1 * 256), np.int64)
    span = terrain.grid.blocks(0)
    for row in range(span.row0, span.row1):
        for col in range(span.col0, span.col1):
            base = Block(0, row, col)
            terrain.cache.hold([base])
            for key in terrain.cache.details(base):
                posts = terrain.cache.pool.read(terrain.cache.layer_of(key))
                found[key.row * 256 :, key.col * 256 :][:256, :256] = posts
                assert terrain.cache.describe(key)[0] <= posts.min()
                assert terrain.cache.describe(key)[1] >= posts.max()
    part = found[inside.row0 : inside.row1, inside.col0 : inside.col1].copy()
    found[inside.row0 : inside.row1, inside.col0 : inside.col1] = 0
    assert not found.any()
    return part


def under(base: Counts, factor: int) -> tuple[Whole, npt.NDArray[np.bool_]]:
    """The base's own surface at detail posts [counts / factor], and where there is none."""
    rows, cols = np.arange((GRID.rows - 1) * factor + 1), np.arange((GRID.cols - 1) * factor + 1)
    i, j = (rows % factor)[:, None], (cols % factor)[None, :]
    low, left = rows // factor, cols // factor
    high, right = np.minimum(low + 1, GRID.rows - 1), np.minimum(left + 1, GRID.cols - 1)
    posts = base.astype(np.int64)
    mid = np.where(j >= i, posts[np.ix_(low, right)], posts[np.ix_(high, left)])
    larger, smaller = np.maximum(i, j), np.minimum(i, j)
    total = np.zeros(mid.shape, np.int64)
    hole = np.zeros(mid.shape, np.bool_)
    for weight, height in (
        (factor - larger, posts[np.ix_(low, left)]),
        (larger - smaller, mid),
        (smaller, posts[np.ix_(high, right)]),
    ):
        total += weight * height
        hole |= (weight > 0) & (height == HOLE)
    return total, hole


def made_of(detail: Whole, base: Counts, stamp: Stamp, factor: int) -> Whole:
    """What a round stamp makes of the detail, by the formulas of the modes."""
    rows = GRID.row + np.arange(detail.shape[0]) / factor
    cols = GRID.col + np.arange(detail.shape[1]) / factor
    r = np.hypot(rows[:, None] * GRID.spacing - stamp.y, cols * GRID.spacing - stamp.x)
    if isinstance(stamp, Gaussian):
        weight = np.where(r < stamp.cut, np.exp(-(r**2) / (2 * stamp.sigma**2)), 0.0)
        height = stamp.amplitude * weight
    else:
        assert isinstance(stamp, ConeStamp)
        weight = np.maximum(0.0, 1.0 - r / stamp.radius)
        height = stamp.height * weight
    unit = 1e5 * factor
    ground, hole = under(base, factor)
    after = detail + np.rint(height * unit).astype(np.int64)
    if stamp.z is not None:
        surface = np.rint((stamp.z - GRID.datum) * unit + height * unit).astype(np.int64) - ground
        after = {
            "dig": np.minimum(detail, surface),
            "fill": np.maximum(detail, surface),
            "replace": surface,
            "blend": detail + np.rint(weight * (surface - detail)).astype(np.int64),
        }[stamp.mode]
    return np.where((weight > 0.0) & ~hole, after, detail)


def mixed(count: int, grid: Grid = GRID) -> list[Stamp]:
    """Stamps of all modes on base and detail, some beyond the edges."""
    rng = np.random.default_rng(3)
    modes: tuple[Mode, ...] = ("add", "dig", "fill", "replace", "blend")
    stamps: list[Stamp] = []
    for i in range(count):
        x = (grid.col + rng.uniform(-0.1, 1.1) * grid.cols) * grid.spacing
        y = (grid.row + rng.uniform(-0.1, 1.1) * grid.rows) * grid.spacing
        size, height = float(np.exp(rng.uniform(0.0, 2.5))), rng.uniform(-3.0, 3.0)
        mode = modes[int(rng.integers(5))]
        z = None if mode == "add" else float(grid.datum + rng.uniform(-8.0, 8.0))
        detail = bool(rng.integers(2))
        if i % 2:
            stamps.append(Gaussian(x, y, height, size, mode=mode, z=z, detail=detail))
        else:
            stamps.append(ConeStamp(x, y, 2 * size, height, mode=mode, z=z, detail=detail))
    return stamps


@pytest.mark.parametrize("factor", [2, 5])
@pytest.mark.parametrize("mode", ["add", "dig", "fill", "replace", "blend"])
def test_each_mode_does_what_its_formula_says(mode: Mode, factor: int) -> None:
    """To the exact total of base and detail, around holes too; the base keeps its bits.

    No post lies on the very edge of a stamp.
    """
    z = None if mode == "add" else 101.5
    stamps: list[Stamp] = [
        ConeStamp(60.0, 60.0, 40.0, -1.0, detail=True),
        Gaussian(55.3, 60.2, 2.5, 2.0, mode=mode, z=z, detail=True),
        ConeStamp(90.017, 50.03, 30.01, -4.0, mode=mode, z=z, detail=True),
        ConeStamp(-24.017, -12.03, 9.01, 1.0, mode=mode, z=z, detail=True),
        ConeStamp(181.017, 186.03, 5.01, 1.0, mode=mode, z=z, detail=True),
    ]
    before = rough(holes=True)
    with opened(before, factor=factor) as terrain:
        ledger = apply_stamps(terrain, stamps)
        after = detail_of(terrain)
        np.testing.assert_array_equal(base_of(terrain), before)
    expected = np.zeros_like(after)
    for stamp in stamps:
        expected = made_of(expected, before, stamp, factor)
    wrong = np.abs(after - expected)
    assert wrong.max() <= 2
    assert np.count_nonzero(wrong) <= 1e-5 * wrong.size
    assert (ledger.net, ledger.unit) == (int(after.sum()), factor**3)
    assert ledger.posts == np.count_nonzero(after)
    assert ledger.holes > 0


def test_base_and_detail_in_one_batch_are_one_stamp_after_another() -> None:
    """In one call and in many, with any pools and threads: the same bits of both."""
    stamps = mixed(30, WIDE)
    assert {stamp.detail for stamp in stamps} == {False, True}
    found = []
    # The small pools hold a block of level 0, its three neighbours and the detail on them.
    for size, threads, layers, detail_layers in [
        (30, 1, 256, 256),
        (1, 1, 256, 256),
        (7, 3, 8, 36),
    ]:
        terrain = opened(
            rough(WIDE), WIDE, threads=threads, layers=layers, detail_layers=detail_layers
        )
        with terrain:
            for i in range(0, 30, size):
                apply_stamps(terrain, stamps[i : i + size])
            found.append((base_of(terrain), detail_of(terrain)))
            evicted = terrain.cache.counters.evictions
    for base, detail in found[1:]:
        np.testing.assert_array_equal(base, found[0][0])
        np.testing.assert_array_equal(detail, found[0][1])
    assert np.count_nonzero(found[0][1]) > 10_000
    assert evicted > 50


def test_what_is_added_to_base_and_detail_is_free_of_order() -> None:
    stamps = [stamp for stamp in mixed(120) if stamp.mode == "add"]
    found = []
    for order in (1, -1):
        with opened(rough()) as terrain:
            ledger = apply_stamps(terrain, stamps[::order])
            found.append((ledger, base_of(terrain).tobytes(), detail_of(terrain).tobytes()))
    assert found[0] == found[1]
    assert len(stamps) > 10


def test_an_edit_of_the_base_leaves_the_detail_on_it() -> None:
    """The sum moves by exactly what the base's surface moves by."""
    with opened(rough()) as terrain:
        apply_stamps(terrain, [ConeStamp(60.0, 60.0, 30.0, 1.0, detail=True)])
        before = detail_of(terrain)
        apply_stamps(terrain, [Crater(62.0, 60.0, 12.0, 2.0, 1.0)])
        np.testing.assert_array_equal(detail_of(terrain), before)
        assert (base_of(terrain) != rough()).any()


def test_each_stamp_of_base_and_detail_has_its_own_account() -> None:
    """In the units of the whole ledger, those of the detail."""
    stamps = mixed(16)
    with opened(rough()) as terrain:
        alone = [apply_stamps(terrain, [stamp]) for stamp in stamps]
    with opened(rough(), threads=3) as terrain:
        ledger = apply_stamps(terrain, stamps, by_stamp=True)
    assert isinstance(ledger, LedgerByStamp)
    assert ledger.unit == FACTOR**3
    for share, one in zip(ledger.stamps, alone, strict=True):
        scale = ledger.unit // one.unit
        assert share == (one.removed * scale, one.added * scale)


def test_detail_that_is_taken_back_is_gone() -> None:
    """No block is left of it, also after it was written back."""
    stamps: list[Stamp] = [Gaussian(60.0 + i, 60.0, 1.0, 3.0, detail=True) for i in range(5)]
    with opened(rough()) as terrain:
        done = apply_stamps(terrain, stamps)
        terrain.cache.flush()
        undone = apply_stamps(terrain, stamps, undo=True)
        terrain.cache.flush()
        assert not detail_of(terrain).any()
        assert not terrain.ground.details(Block(0, 0, 0))
    assert (done.added, done.removed, done.unit) == (undone.removed, undone.added, FACTOR**3)


def test_the_levels_follow_the_detail() -> None:
    """Each post of level 1 is base plus detail rounded to a count."""
    with opened(rough()) as terrain:
        apply_stamps(terrain, mixed(30))
        total = base_of(terrain) + np.rint(detail_of(terrain)[::FACTOR, ::FACTOR] / FACTOR)
        for row, col in ((-1, -1), (-1, 0), (0, -1), (0, 0)):
            key = Block(1, row, col)
            [layer] = terrain.cache.hold([key])
            at = [
                np.clip(2 * (256 * block + np.arange(256)), first, first + count - 1) - first
                for block, first, count in ((row, GRID.row, GRID.rows), (col, GRID.col, GRID.cols))
            ]
            np.testing.assert_array_equal(terrain.cache.pool.read(layer), total[np.ix_(*at)])


@pytest.mark.parametrize("post", [(0, 0), (128, 60), (249, 242), (-20, -37)])
def test_one_post_of_detail_reaches_the_level_above(post: tuple[int, int]) -> None:
    """Where the level has that post; its bound knows of it where it has not."""
    y, x = post[0] * GRID.spacing, post[1] * GRID.spacing
    with opened(np.zeros((GRID.rows, GRID.cols), np.int32)) as terrain:
        ledger = apply_stamps(terrain, [ConeStamp(x, y, 0.1, 1.0, detail=True)])
        assert (ledger.posts, ledger.net) == (1, 100_000 * FACTOR)
        key = Block(1, post[0] >> 9, post[1] >> 9)
        [layer] = terrain.cache.hold([key])
        posts = terrain.cache.pool.read(layer)
        if post[0] % 2 == post[1] % 2 == 0:
            assert posts[(post[0] >> 1) & 255, (post[1] >> 1) & 255] == 100_000
            assert terrain.cache.describe(key)[1] == 100_000
        assert terrain.cache.describe(key)[2] >= 100_000 * (1 - 1 / FACTOR)


def test_the_volume_of_detail_is_the_closed_form() -> None:
    """A cone over a third of a metre of posts: within the squared spacing of its detail."""
    with opened(np.zeros((GRID.rows, GRID.cols), np.int32)) as terrain:
        stamp = ConeStamp(60.1, 60.2, 10.0, 2.0, detail=True)
        ledger = apply_stamps(terrain, [stamp])
    assert abs(ledger.volume(GRID.spacing) - stamp.volume) <= (GRID.spacing / FACTOR) ** 2


def test_a_terrain_without_detail_refuses_stamps_on_it() -> None:
    with Terrain(ArraySource(rough(), GRID)) as terrain:
        with pytest.raises(InputError, match="no detail grid; open it with a detail_factor"):
            apply_stamps(terrain, [Gaussian(0.0, 0.0, 1.0, 5.0, detail=True)])
        np.testing.assert_array_equal(base_of(terrain), rough())


def test_more_detail_than_the_pool_holds_is_refused_before_anything_changes() -> None:
    """Sixteen blocks of detail lie in one of level 0, the pool holds eight."""
    with opened(rough(), factor=4, detail_layers=8) as terrain:
        with pytest.raises(RunError, match=r"what belongs to .* raise pool_bytes and detail_pool"):
            apply_stamps(
                terrain,
                [Gaussian(60.0, 60.0, 1.0, 5.0), ConeStamp(60.0, 60.0, 80.0, 1.0, detail=True)],
            )
        np.testing.assert_array_equal(base_of(terrain), rough())
        assert not detail_of(terrain).any()


def test_a_detail_of_a_thousand_to_a_post_is_as_exact() -> None:
    """Two metres across, on the finest detail: 2,048 posts along a side."""
    grid = Grid(5, 5, 1.0)
    with Terrain(Flat(grid), detail_factor=1024, detail_pool_bytes=100 << 18) as terrain:
        ledger = apply_stamps(terrain, [ConeStamp(2.0, 2.0, 1.0, 0.5, detail=True)])
    assert ledger.volume(1.0) == pytest.approx(np.pi * 0.5 / 3.0, rel=2e-7)
