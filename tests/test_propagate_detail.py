"""Changes of the detail carried up: level 1 and all above are base and detail, rounded."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.counts import HOLE, MAX_COUNT, Counts
from terrasim.deform.patch import Patch, apply_patch
from terrasim.deform.window import NO_GROUND, read_window
from terrasim.errors import InputError, RunError
from terrasim.grid import Block, Grid
from terrasim.sources.array_source import ArraySource
from terrasim.sources.source import describe
from terrasim.terrain import Terrain

GRIDS = (
    Grid(270, 300, 0.75, row=-20, col=-37),
    Grid(257, 290, 1.0, row=255, col=-289),
    Grid(40, 30, 1.0, row=-7, col=250),
)
"""Edges that are posts of a level and that are not, half a block beyond the terrain, one level."""
SMALL_POOL = 8 << 18
"""Bytes of eight blocks."""
Heights = npt.NDArray[np.int64]
Described = list[tuple[Block, bytes, tuple[int, int, int]]]


def ground(grid: Grid, rng: np.random.Generator) -> Counts:
    """Rough or nearly flat ground, sometimes with holes."""
    steep = 10 ** int(rng.integers(1, 6))
    posts = rng.integers(-steep, steep, (grid.rows, grid.cols), dtype=np.int32)
    if rng.random() < 0.4:
        posts[rng.random(posts.shape) < 0.01] = HOLE
    return posts


def random_patch(grid: Grid, factor: int, rng: np.random.Generator) -> Patch:
    """A rectangle of posts of the base or of the detail, often at an edge."""
    detail = bool(rng.random() < 0.7)
    scale = factor if detail else 1
    high, wide = (grid.rows - 1) * scale + 1, (grid.cols - 1) * scale + 1
    longest = int(rng.choice([1, 30, 400]))
    rows, cols = (int(rng.integers(1, min(longest, n) + 1)) for n in (high, wide))
    row, col = (
        int(rng.choice([0, int(rng.integers(room + 1)), room]))
        for room in (high - rows, wide - cols)
    )
    most = 10 ** int(rng.integers(1, 7))
    counts = rng.integers(-most, most, (rows, cols), dtype=np.int32)
    first = first_post(grid, scale) if detail else (grid.row, grid.col)
    return Patch(first[0] + row, first[1] + col, counts, detail)


def first_post(grid: Grid, factor: int) -> tuple[int, int]:
    """Number of the terrain's first detail post."""
    span = grid.blocks(0)
    return (grid.row - span.row0 * 256) * factor, (grid.col - span.col0 * 256) * factor


def interpolated(base: Heights, factor: int) -> Heights:
    """The base's triangles at detail posts [counts / factor]; ``NO_GROUND`` in holes."""
    rows, cols = ((n - 1) * factor + 1 for n in base.shape)
    (r, i), (c, j) = np.divmod(np.arange(rows), factor), np.divmod(np.arange(cols), factor)
    up, on = np.minimum(r + 1, base.shape[0] - 1), np.minimum(c + 1, base.shape[1] - 1)
    i, j = i[:, None], j[None, :]
    near, far = base[np.ix_(r, c)], base[np.ix_(up, on)]
    mid = np.where(j >= i, base[np.ix_(r, on)], base[np.ix_(up, c)])
    larger, smaller = np.maximum(i, j), np.minimum(i, j)
    total = factor * near + (mid - near) * larger + (far - mid) * smaller
    hole = (near == HOLE) & (larger < factor)
    hole |= (mid == HOLE) & (larger > smaller)
    hole |= (far == HOLE) & (smaller > 0)
    return np.where(hole, NO_GROUND, total)


def patched(
    posts: Counts, grid: Grid, factor: int, patches: Sequence[Patch]
) -> tuple[Heights, Heights]:
    """Base and detail that patches leave, from the definitions alone."""
    base = posts.astype(np.int64)
    detail = np.zeros([(n - 1) * factor + 1 for n in base.shape], dtype=np.int64)
    for patch in patches:
        first = first_post(grid, factor) if patch.detail else (grid.row, grid.col)
        rows, cols = (
            slice(at - start, at - start + count)
            for at, start, count in zip(
                (patch.row, patch.col), first, patch.counts.shape, strict=True
            )
        )
        if patch.detail:
            hole = interpolated(base, factor)[rows, cols] == NO_GROUND
            detail[rows, cols] += np.where(hole, 0, patch.counts)
        else:
            part = base[rows, cols]
            new = np.clip(part + patch.counts, -MAX_COUNT, MAX_COUNT)
            part[...] = np.where(part == HOLE, HOLE, new)
    return base, detail


def level_posts(base: Heights, detail: Heights, factor: int) -> Counts:
    """Base and detail at the posts of level 0, rounded, halves to even."""
    there = detail[::factor, ::factor]
    quotient, rest = np.divmod(there, factor)
    up = (2 * rest > factor) | ((2 * rest == factor) & (quotient % 2 == 1))
    total = base + quotient + up
    return np.where(base == HOLE, HOLE, np.clip(total, -MAX_COUNT, MAX_COUNT)).astype(np.int32)


def every_block(grid: Grid) -> list[Block]:
    return [
        Block(level, row, col)
        for level in range(grid.levels)
        for span in [grid.blocks(level)]
        for row in range(span.row0, span.row1)
        for col in range(span.col0, span.col1)
    ]


def described(terrain: Terrain) -> Described:
    """Posts, lowest, highest and bound of every block."""
    found = []
    for key in every_block(terrain.grid):
        [layer] = terrain.cache.hold([key])
        posts = terrain.cache.pool.read(layer)
        found.append((key, posts.tobytes(), terrain.cache.describe(key)))
    return found


def distance(grid: Grid, key: Block, source: ArraySource, total: Heights, factor: int) -> int:
    """Largest distance [counts, rounded up] of a block's triangles from the detail posts."""
    step = factor << key.level
    span = grid.posts(key.level)
    rows, cols = (
        np.arange(max(at * 256, first - 1), min(at * 256 + 256, end))
        for at, first, end in ((key.row, span.row0, span.row1), (key.col, span.col0, span.col1))
    )
    fine = total[
        np.ix_(
            np.clip(
                ((rows << key.level)[:, None] - grid.row) * factor + np.arange(step + 1),
                0,
                total.shape[0] - 1,
            ).ravel(),
            np.clip(
                ((cols << key.level)[:, None] - grid.col) * factor + np.arange(step + 1),
                0,
                total.shape[1] - 1,
            ).ravel(),
        )
    ].reshape(len(rows), step + 1, len(cols), step + 1)
    posts = source.posts(
        key.level, np.append(rows, rows[-1] + 1), np.append(cols, cols[-1] + 1)
    ).astype(np.int64)
    corner = posts[:, None, :, None]
    near, far = corner[:-1, :, :-1], corner[1:, :, 1:]
    east, north = corner[:-1, :, 1:], corner[1:, :, :-1]
    v, u = np.arange(step + 1)[None, :, None, None], np.arange(step + 1)[None, None, None, :]
    worst = 0
    for mid, inside in ((east, u >= v), (north, u <= v)):
        larger, smaller = np.maximum(u, v), np.minimum(u, v)
        line = near * step + (mid - near) * larger + (far - mid) * smaller
        apart = np.abs(fine * step - factor * line)
        known = inside & (near != HOLE) & (mid != HOLE) & (far != HOLE) & (fine != NO_GROUND)
        worst = max(worst, int(np.where(known, apart, 0).max()))
    return -(-worst // (step * factor))


def assert_blocks_follow(
    found: Described, base: Heights, detail: Heights, grid: Grid, factor: int
) -> None:
    """Posts and ranges are exact, bounds hold at every detail post."""
    source = ArraySource(level_posts(base, detail, factor), grid)
    ground_at = interpolated(base, factor)
    total = np.where(ground_at == NO_GROUND, NO_GROUND, ground_at + detail)
    for key, posts, (lowest, highest, error) in found:
        if key.level == 0:
            continue
        rows, cols = (np.arange(at * 256, at * 256 + 256) for at in (key.row, key.col))
        wanted = describe(source.posts(key.level, rows, cols), 0)
        assert posts == wanted.posts.tobytes(), key
        assert (lowest, highest) == (wanted.lowest, wanted.highest), key
        assert error >= distance(grid, key, source, total, factor), key


@pytest.mark.parametrize("seed", range(12))
def test_levels_are_base_and_detail_after_random_edits(seed: int) -> None:
    """Windows too; any pool and any threads give the same bits."""
    rng = np.random.default_rng(seed)
    grid, factor = GRIDS[seed % 3], (2, 3, 4, 5)[seed % 4]
    before = ground(grid, rng)
    patches = [random_patch(grid, factor, rng) for _ in range(4)]
    base, detail = patched(before, grid, factor, patches)
    found = []
    for pool, threads in ((SMALL_POOL, 1 + seed % 3), (64 << 20, 1)):
        with Terrain(
            ArraySource(before, grid), pool_bytes=pool, threads=threads, detail_factor=factor
        ) as terrain:
            for patch in patches:
                apply_patch(terrain, patch)
            found.append(described(terrain))
            first = first_post(grid, factor)
            shape = (detail.shape[0], detail.shape[1])
            window = read_window(terrain, first[0], first[1], shape[0], shape[1], detail=True)
    assert found[0] == found[1]
    ground_at = interpolated(base, factor)
    np.testing.assert_array_equal(
        window, np.where(ground_at == NO_GROUND, NO_GROUND, ground_at + detail)
    )
    assert_blocks_follow(found[0], base, detail, grid, factor)


def test_the_ledger_of_the_detail_counts_in_its_own_unit() -> None:
    """Undone, the ground is what it was; what lies in a hole is counted and not changed."""
    grid, factor = GRIDS[2], 4
    before = np.zeros((grid.rows, grid.cols), np.int32)
    before[10, 10] = HOLE
    counts = np.arange(1, 26, dtype=np.int32).reshape(5, 5) - 9
    row, col = first_post(grid, factor)
    patch = Patch(row + 4 * 9 + 2, col + 4 * 9 + 2, counts, detail=True)
    back = Patch(patch.row, patch.col, -counts, detail=True)
    base, detail = patched(before, grid, factor, [patch])
    with Terrain(ArraySource(before, grid), detail_factor=factor) as terrain:
        done = apply_patch(terrain, patch)
        bases = [key for key in every_block(grid) if key.level == 0]
        held = sum(terrain.cache.detail_count(key) for key in bases)
        undone = apply_patch(terrain, back)
        rows, cols = detail.shape
        after = read_window(terrain, row, col, rows, cols, detail=True)
        assert not any(terrain.cache.detail_count(key) for key in bases)
    assert held > 0
    assert done.net == int(detail.sum())
    assert done.posts == int(np.count_nonzero(detail))
    assert done.unit == factor**3
    assert done.holes == np.count_nonzero(counts) - np.count_nonzero(detail) > 0
    assert (undone.net, undone.holes) == (-done.net, done.holes)
    np.testing.assert_array_equal(after, interpolated(base, factor))


def test_more_detail_than_fits_at_once_is_carried_up_a_block_at_a_time() -> None:
    """Two blocks side by side have eight detail blocks each; the pool holds twelve."""
    grid, factor = Grid(600, 600, 1.0), 4
    rng = np.random.default_rng(2)
    before = rng.integers(-99, 99, (600, 600), dtype=np.int32)
    tall = rng.integers(-999, 999, (1024, 300), dtype=np.int32)
    patches = [
        Patch(0, 700, tall, True),
        Patch(0, 1024, tall, True),
        Patch(250, 200, tall[:300, :99]),
    ]
    base, detail = patched(before, grid, factor, patches)
    found = []
    for blocks in (12, 64):
        with Terrain(
            ArraySource(before, grid), detail_factor=factor, detail_pool_bytes=blocks << 18
        ) as terrain:
            for patch in patches:
                apply_patch(terrain, patch)
            counts = [terrain.cache.detail_count(Block(0, 0, col)) for col in (0, 1)]
            assert blocks == 64 or max(counts) <= blocks < sum(counts)
            found.append(described(terrain))
    assert found[0] == found[1]
    assert_blocks_follow(found[0], base, detail, grid, factor)


def test_a_patch_of_more_detail_than_fits_is_refused_and_nothing_changes() -> None:
    grid = Grid(300, 300, 1.0)
    patch = Patch(0, 0, np.ones((700, 700), np.int32), detail=True)
    with Terrain(
        ArraySource(np.zeros((300, 300), np.int32), grid),
        detail_factor=4,
        detail_pool_bytes=8 << 18,
    ) as terrain:
        with pytest.raises(RunError, match=r"9 detail blocks .* holds 8; raise detail_pool"):
            apply_patch(terrain, patch)
        assert not read_window(terrain, 0, 0, 1000, 1000, detail=True).any()


def test_a_terrain_without_detail_refuses_a_patch_of_it() -> None:
    with Terrain(ArraySource(np.zeros((9, 9), np.int32), Grid(9, 9, 1.0))) as terrain:
        with pytest.raises(InputError, match="no detail grid"):
            apply_patch(terrain, Patch(0, 0, np.ones((2, 2), np.int32), detail=True))
        with pytest.raises(InputError, match="no detail grid"):
            read_window(terrain, 0, 0, 2, 2, detail=True)


def test_doing_and_undoing_detail_a_hundred_times_does_not_let_bounds_grow() -> None:
    grid, factor = GRIDS[0], 3
    rng = np.random.default_rng(4)
    before = rng.integers(-1000, 1000, (grid.rows, grid.cols), dtype=np.int32)
    counts = rng.integers(-9000, 9000, (100, 120), dtype=np.int32)
    row, col = first_post(grid, factor)
    patch, back = (Patch(row + 20, col + 30, sign * counts, detail=True) for sign in (1, -1))
    with Terrain(ArraySource(before, grid), detail_factor=factor) as terrain:
        for _ in range(90):
            apply_patch(terrain, patch)
            apply_patch(terrain, back)
        most = described(terrain)
        for _ in range(10):
            apply_patch(terrain, patch)
            apply_patch(terrain, back)
        assert described(terrain) == most
    assert_blocks_follow(most, *patched(before, grid, factor, []), grid, factor)


@pytest.mark.parametrize("north", [True, False])
def test_a_block_knows_of_detail_on_its_far_edge(*, north: bool) -> None:
    """The detail lies on a block of level 0 that is below the next block of level 1."""
    grid, factor = Grid(700, 700, 1.0), 4
    along, across = 100 * factor + 1, 512 * factor
    place = (across, along) if north else (along, across)
    with Terrain(
        ArraySource(np.zeros((700, 700), np.int32), grid), detail_factor=factor
    ) as terrain:
        spike = np.array([[1000 * factor]], np.int32)
        apply_patch(terrain, Patch(*place, spike, detail=True))
        terrain.cache.hold([Block(1, 0, 0)])
        # What rose, and one count more for the rounding of level 1.
        assert terrain.cache.describe(Block(1, 0, 0))[2] == 1001


@pytest.mark.parametrize("north", [True, False])
def test_a_block_over_detail_knows_of_a_spike_on_its_far_edge(*, north: bool) -> None:
    """The next block has detail, so that it is measured post by post."""
    grid, factor = Grid(700, 700, 1.0), 4
    with Terrain(
        ArraySource(np.zeros((700, 700), np.int32), grid), detail_factor=factor
    ) as terrain:
        place = (520 * factor, 0) if north else (0, 520 * factor)
        apply_patch(terrain, Patch(*place, np.array([[factor]], np.int32), detail=True))
        spike = np.array([[7000]], np.int32)
        apply_patch(terrain, Patch(*((512, 101) if north else (101, 512)), spike))
        terrain.cache.hold([Block(1, 0, 0)])
        assert terrain.cache.describe(Block(1, 0, 0))[2] == 7000
