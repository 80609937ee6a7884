"""Changes carried up the levels: posts and ranges exact, bounds held against level 0 by force."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from terrasim.counts import HOLE, MAX_COUNT, Counts
from terrasim.deform.patch import Patch, apply_patch
from terrasim.deform.pieces import groups, pieces_of
from terrasim.deform.propagate import Touched, propagate
from terrasim.deform.regions import first_regions
from terrasim.deform.room import Room
from terrasim.grid import Block, Grid
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

GRIDS = (
    Grid(300, 560, 0.75, row=-20, col=-37),
    Grid(513, 513, 1.0),
    Grid(2, 2, 1.0),
    Grid(600, 40, 2.0),
    Grid(257, 770, 1.0, row=255, col=-513),
    Grid(300, 530, 1.0, row=-1, col=129),
    Grid(1030, 270, 1.0, row=-1025, col=1000),
)
"""Odd and even sizes, edges that are posts of a level and that are not, up to four levels, blocks
with an odd first row, so that half of a block above lies beyond the terrain."""
SMALL_POOL = 8 << 18
"""Bytes of eight blocks, the fewest there may be."""
Described = list[tuple[Block, bytes, tuple[int, int, int]]]


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


def ground(grid: Grid, rng: np.random.Generator) -> Counts:
    """Rough or nearly flat ground, sometimes with holes or a quarter without ground."""
    steep = 10 ** int(rng.integers(1, 7))
    posts = rng.integers(-steep, steep, (grid.rows, grid.cols), dtype=np.int32)
    kind = rng.integers(4)
    if kind == 0:
        posts[rng.random(posts.shape) < 0.02] = HOLE
    elif kind == 1:
        posts[grid.rows // 4 : grid.rows // 2, grid.cols // 3 :] = HOLE
    return posts


def random_patch(grid: Grid, rng: np.random.Generator) -> Patch:
    """A spike, or a rectangle of any size, often at an edge, a count or kilometres high."""
    longest = int(rng.choice([1, 1, 40, 300, 2000]))
    rows, cols = (int(rng.integers(1, min(longest, n) + 1)) for n in (grid.rows, grid.cols))
    row, col = (
        int(rng.choice([0, int(rng.integers(room + 1)), room]))
        for room in (grid.rows - rows, grid.cols - cols)
    )
    high = 10 ** int(rng.integers(1, 9))
    counts = rng.integers(-high, high, (rows, cols), dtype=np.int32)
    return Patch(grid.row + row, grid.col + col, counts)


def patched(posts: Counts, grid: Grid, patches: Sequence[Patch]) -> Counts:
    """What patches leave, from the definition alone."""
    after = posts.astype(np.int64)
    for patch in patches:
        row, col = patch.row - grid.row, patch.col - grid.col
        rows, cols = patch.counts.shape
        part = after[row : row + rows, col : col + cols]
        new = np.clip(part + patch.counts, -MAX_COUNT, MAX_COUNT)
        part[...] = np.where(part == HOLE, HOLE, new)
    return after.astype(np.int32)


def assert_blocks_follow(found: Described, expected: Counts, grid: Grid) -> None:
    """Every block is what a source of the expected heights would give, its bound at least that."""
    source = ArraySource(expected, grid)
    for key, posts, (lowest, highest, error) in found:
        wanted = source.block(key)
        assert posts == wanted.posts.tobytes(), key
        assert (lowest, highest) == (wanted.lowest, wanted.highest), key
        assert error >= wanted.error, key


@pytest.mark.parametrize("seed", range(50))
def test_every_level_follows_random_edits(seed: int) -> None:
    """Posts and ranges are exact, bounds hold; any pool and any threads give the same bits."""
    rng = np.random.default_rng(seed)
    grid = GRIDS[seed % len(GRIDS)]
    before = ground(grid, rng)
    patches = [random_patch(grid, rng) for _ in range(4)]
    found = []
    for pool, threads in ((SMALL_POOL, 1 + seed % 3), (64 << 20, 1)):
        with Terrain(ArraySource(before, grid), pool_bytes=pool, threads=threads) as terrain:
            for patch in patches:
                apply_patch(terrain, patch)
            found.append(described(terrain))
    assert found[0] == found[1]
    assert_blocks_follow(found[0], patched(before, grid, patches), grid)


def test_pools_of_any_size_and_threads_give_the_same_bits() -> None:
    """Four blocks at the top leave room for four: too few for a block and the four below it."""
    grid = Grid(1200, 700, 1.0, row=-600, col=-350)
    rng = np.random.default_rng(11)
    source = ArraySource(rng.integers(-999, 999, (grid.rows, grid.cols), dtype=np.int32), grid)
    patches = [Patch(-600, -350, rng.integers(-99, 99, (1200, 700), dtype=np.int32))]
    patches += [random_patch(grid, rng) for _ in range(3)]
    found = []
    for pool, threads in ((SMALL_POOL, 1), (9 << 18, 2), (13 << 18, 3), (64 << 20, 1)):
        with Terrain(source, pool_bytes=pool, threads=threads) as terrain:
            for patch in patches:
                apply_patch(terrain, patch)
            found.append(described(terrain))
    assert terrain.cache.capacity > 4
    assert found[0] == found[1] == found[2] == found[3]


def test_a_pool_with_room_for_four_blocks_takes_pieces_apart() -> None:
    """Else the test above would prove nothing."""
    grid = Grid(1200, 700, 1.0, row=-600, col=-350)
    touched = [Touched(Block(0, -1, -1), -256, -1, -256, -1, 1, 0)]
    pieces = pieces_of(grid, 1, first_regions(grid, touched))
    parted = [piece for group in groups(pieces, Room(4, grid.top)) for piece in group]
    assert any(not piece.sample for piece in parted)
    assert all(len(piece.needs) <= 4 for piece in parted)
    with Terrain(
        ArraySource(np.zeros((grid.rows, grid.cols), np.int32), grid), pool_bytes=SMALL_POOL
    ) as terrain:
        assert terrain.cache.capacity == 4


@pytest.mark.parametrize("holes", [False, True])
def test_doing_and_undoing_a_hundred_times_does_not_let_bounds_grow(holes: bool) -> None:
    """They end at what a level can be from the level below, summed over the levels below."""
    grid = Grid(700, 900, 1.0, row=-1, col=129)
    rng = np.random.default_rng(4)
    before = rng.integers(-1000, 1000, (grid.rows, grid.cols), dtype=np.int32)
    if holes:
        # A lake: its shore cuts triangles, but none spans it.
        before[100:400, 200:600] = HOLE
    counts = rng.integers(-5000, 5000, (300, 250), dtype=np.int32)
    patch, back = Patch(90, 300, counts), Patch(90, 300, -counts)
    with Terrain(ArraySource(before, grid)) as terrain:
        for _ in range(80):
            apply_patch(terrain, patch)
            apply_patch(terrain, back)
        most = described(terrain)
        for _ in range(20):
            apply_patch(terrain, patch)
            apply_patch(terrain, back)
        assert described(terrain) == most
    assert_blocks_follow(most, before, grid)
    # Posts lie within +-6000 counts, so a middle post within 12,000 of what its ends say.
    assert all(bound <= key.level * 12_000 for key, _, (_, _, bound) in most)


def test_a_spike_halfway_along_a_diagonal_is_missed_by_its_height() -> None:
    """The bounds of a level whose posts do not change, and of the level above, are exact."""
    grid = Grid(1025, 1025, 1.0)
    with Terrain(ArraySource(np.zeros((1025, 1025), np.int32), grid)) as terrain:
        apply_patch(terrain, Patch(101, 101, np.array([[7000]], np.int32)))
        bounds = [error for key, _, (_, _, error) in described(terrain) if key[1:] == (0, 0)]
    assert bounds == [0, 7000, 7000, 7000]


@pytest.mark.parametrize("side", [(0, 0), (0, 1), (1, 0), (1, 1)])
def test_a_block_knows_of_an_edit_to_its_neighbours_first_post(side: tuple[int, int]) -> None:
    """One post between four blocks of level 1: the cells of all of them rise halfway."""
    grid = Grid(1025, 1025, 1.0)
    with Terrain(ArraySource(np.zeros((1025, 1025), np.int32), grid)) as terrain:
        apply_patch(terrain, Patch(512, 512, np.array([[200_000]], np.int32)))
        terrain.cache.hold([Block(1, *side)])
        assert terrain.cache.describe(Block(1, *side))[2] == 100_000


@pytest.mark.parametrize(
    ("row", "col", "neighbour"), [(512, 301, (0, 0)), (301, 512, (0, 0))], ids=["north", "east"]
)
def test_a_block_knows_of_a_spike_on_its_far_edge(
    row: int, col: int, neighbour: tuple[int, int]
) -> None:
    """The post lies on the edge that two blocks share, and in the level's posts it is not."""
    grid = Grid(1025, 1025, 1.0)
    with Terrain(ArraySource(np.zeros((1025, 1025), np.int32), grid)) as terrain:
        apply_patch(terrain, Patch(row, col, np.array([[200_000]], np.int32)))
        terrain.cache.hold([Block(1, *neighbour)])
        assert terrain.cache.describe(Block(1, *neighbour))[2] == 200_000


@pytest.mark.parametrize("north", [True, False])
def test_an_edge_that_ends_a_block_is_repeated_beyond_it(*, north: bool) -> None:
    """The last cells of level 1 rise from 0 to 5000 halfway and stay: they are missed by 2500."""
    grid = Grid(512, 512, 1.0)
    wall = np.full((1, 512), 5000, np.int32)
    with Terrain(ArraySource(np.zeros((512, 512), np.int32), grid)) as terrain:
        apply_patch(terrain, Patch(511, 0, wall) if north else Patch(0, 511, wall.T))
        [found] = [rest for key, _, rest in described(terrain) if key == Block(1, 0, 0)]
    assert found == (0, 0, 2500)


def test_a_spike_that_is_taken_away_lets_the_range_shrink_again() -> None:
    """Lowest and highest counts are looked for anew when the post that held them changes."""
    grid = Grid(1025, 1025, 1.0)
    rng = np.random.default_rng(8)
    before = rng.integers(-1000, 1000, (1025, 1025), dtype=np.int32)
    spike = np.array([[9_000_000, -9_000_000]], np.int32).repeat(8, axis=1)
    with Terrain(ArraySource(before, grid)) as terrain:
        unchanged = [(key, posts, rest[:2]) for key, posts, rest in described(terrain)]
        apply_patch(terrain, Patch(512, 512, spike))
        ranges = [rest[:2] for key, _, rest in described(terrain) if key.level == grid.top]
        high, low = 9_000_000 + int(before[512, 512]), int(before[512, 520]) - 9_000_000
        assert ranges == [(low, high)]
        apply_patch(terrain, Patch(512, 512, -spike))
        assert [(key, posts, rest[:2]) for key, posts, rest in described(terrain)] == unchanged


def test_a_bound_under_a_hole_grows_by_no_more_than_the_edit() -> None:
    """The level below cannot speak for what lies under its hole: what moved is added."""
    grid = Grid(513, 513, 1.0)
    before = np.zeros((513, 513), np.int32)
    before[100, 101] = HOLE
    source = ArraySource(before, grid)
    with Terrain(source) as terrain:
        apply_patch(terrain, Patch(90, 90, np.full((20, 20), 50, np.int32)))
        terrain.cache.hold([Block(1, 0, 0)])
        assert terrain.cache.describe(Block(1, 0, 0))[2] == source.bound(Block(1, 0, 0)) + 50


def test_nothing_touched_changes_nothing() -> None:
    grid = Grid(513, 513, 1.0)
    with Terrain(ArraySource(np.zeros((513, 513), np.int32), grid)) as terrain:
        before = described(terrain)
        propagate(terrain, [])
        assert described(terrain) == before
        assert not terrain.ground.edited
