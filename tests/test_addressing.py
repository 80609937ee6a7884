"""The paged terrain against a plain array: moves, queries and edits, equal to the bit."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import terrasim as ts
from terrasim.cache.needs import Boxes, Disc
from terrasim.cache.pool import BLOCK_BYTES, BLOCK_POSTS
from terrasim.counts import COUNT_M, Counts
from terrasim.grid import Block, Grid, Indices, Span
from terrasim.kernels.addressing import ABSENT, BLOCK, HEADER, PAGE
from terrasim.kernels.surface import COARSER, OFF_TERRAIN
from terrasim.sources.mirror import Mirrored
from terrasim.sources.source import block_indices

Points = npt.NDArray[np.float64]
Random = np.random.Generator

LAYERS = 13
"""Layers of the pool, against more than eighty blocks of the terrain."""
SPACING = 0.5


class PlainArray:
    """The oracle: level-0 posts in one array, and the formula of the surface in NumPy."""

    def __init__(self, posts: Counts, grid: Grid) -> None:
        self.posts = posts.copy()
        self.grid = grid

    def level_posts(self, level: int | Indices, rows: Indices, cols: Indices) -> Counts:
        """Level-``l`` post (r, c) is level-0 post (r << l, c << l), moved to the edge."""
        row = np.clip(rows << level, self.grid.row, self.grid.row + self.grid.rows - 1)
        col = np.clip(cols << level, self.grid.col, self.grid.col + self.grid.cols - 1)
        counts: Counts = self.posts[row - self.grid.row, col - self.grid.col]
        return counts

    def block(self, key: Block) -> Counts:
        """All posts of a block."""
        rows, cols = block_indices(key.row), block_indices(key.col)
        return self.level_posts(key.level, rows[:, None], cols[None, :])

    def height(self, points: Points, level: npt.NDArray[np.int64]) -> Points:
        """World z at points, each from a level of its own; the kernel's operations in its order."""
        grid, scale = self.grid, (1 << level).astype(np.float64)
        row, v = self._cell(points[:, 1], grid.y, grid.row, grid.rows, level, scale)
        col, u = self._cell(points[:, 0], grid.x, grid.col, grid.cols, level, scale)
        right = u >= v
        near = self.level_posts(level, row, col).astype(np.int64)
        mid = self.level_posts(level, row + ~right, col + right).astype(np.int64)
        far = self.level_posts(level, row + 1, col + 1).astype(np.int64)
        walk = (mid - near) * np.maximum(u, v) + (far - mid) * np.minimum(u, v)
        return np.asarray(grid.datum + (near + walk) * COUNT_M, np.float64)

    def _cell(
        self, place: Points, zero: float, first: int, count: int, level: Indices, scale: Points
    ) -> tuple[Indices, Points]:
        index = np.clip((place - zero) / self.grid.spacing, first, first + count - 1)
        cell = np.minimum(np.floor(index).astype(np.int64), first + count - 2)
        inside = (cell & ((1 << level) - 1)).astype(np.float64)
        return cell >> level, (inside + (index - cell)) / scale


class Script:
    """A terrain under random use beside its oracle."""

    def __init__(self, terrain: ts.Terrain, plain: PlainArray, seed: int) -> None:
        self.terrain = terrain
        self.plain = plain
        self.random: Random = np.random.default_rng(seed)
        self.moves = self.queries = self.edits = 0
        self.bounds: dict[Block, tuple[int, int, int]] = {}

    def place(self) -> tuple[float, float]:
        """Row and column of somewhere, now and then off the terrain."""
        grid = self.plain.grid
        row = grid.row + self.random.uniform(-0.05, 1.05) * (grid.rows - 1)
        col = grid.col + self.random.uniform(-0.05, 1.05) * (grid.cols - 1)
        return float(row), float(col)

    def points(self, count: int) -> Points:
        """Points on posts, seams, edges, diagonals, in cells' middles and anywhere."""
        grid, random = self.plain.grid, self.random
        row, col = self.place()
        spread = random.choice([3.0, 40.0, 300.0])
        posts = random.normal((col, row), spread, (count, 2))
        kind = random.integers(0, 6, count)
        whole = np.floor(posts)
        seam = np.rint(posts / BLOCK) * BLOCK + random.integers(-1, 2, (count, 2))
        edge = np.array([[grid.col, grid.row], [grid.col + grid.cols, grid.row + grid.rows]]) - [
            [0, 0],
            [1, 1],
        ]
        diagonal = whole + random.random((count, 1))
        choices = [posts, whole, whole + 0.5, diagonal, seam + random.random((count, 2)), posts]
        found = np.choose(kind[:, None], choices)
        on_edge = kind == 5
        found[on_edge, 0] = edge[random.integers(0, 2, int(on_edge.sum())), 0]
        found[on_edge, 1] = np.where(
            random.random(int(on_edge.sum())) < 0.2, edge[1, 1], found[on_edge, 1]
        )
        return np.column_stack(
            [grid.x + found[:, 0] * grid.spacing, grid.y + found[:, 1] * grid.spacing]
        )

    def move(self) -> None:
        """Require some ground, want some more, and check what the step would read."""
        cache, random = self.terrain.cache, self.random
        row, col = self.place()
        level = int(random.integers(0, self.plain.grid.levels))
        disc = Disc(row, col, float(random.uniform(0.0, 200.0)), level)
        some = random.normal((row, col), 30.0, (int(random.integers(0, 5)), 2)).astype(np.int64)
        boxes = Boxes(some[:, 0], some[:, 0] + 2, some[:, 1], some[:, 1] + 3)
        cache.require([disc, boxes])
        cache.want([Disc(row + 150.0, col, 300.0, level)])
        cache.work(1.0)
        self.moves += 1
        present = entries_of(self.terrain.required.numpy(), self.plain.grid)
        key = list(present)[int(random.integers(len(present)))]
        assert np.array_equal(self.posts_in_pool(present[key]), self.plain.block(key))

    def query(self, count: int, wait: bool) -> None:
        """Ask for heights; all must be the formula's at the level that answered."""
        level = int(self.random.integers(0, self.plain.grid.levels))
        points = self.points(count)
        answer = ts.sample_all(self.terrain, points, level=level, wait=wait)
        answered = answer.level.astype(np.int64)
        assert np.array_equal((answer.state & COARSER) != 0, answered > level)
        assert not wait or (answered == level).all()
        assert np.array_equal((answer.state & OFF_TERRAIN) != 0, off(self.plain.grid, points))
        assert np.array_equal(answer.height, self.plain.height(points, answered))
        if wait:
            again = ts.sample(self.terrain, points, level=level)
            assert np.array_equal(again.height, answer.height)
            assert np.array_equal(again.state, answer.state)
            self.queries += count
        self.queries += count

    def edit(self) -> None:
        """Change a rectangle of posts in the array, and every block of every level that has one."""
        grid, random = self.plain.grid, self.random
        row, col = (int(x) for x in self.place())
        high, wide = random.integers(1, [40, 300])
        row0, col0 = max(row - grid.row, 0), max(col - grid.col, 0)
        part = self.plain.posts[row0 : row0 + high, col0 : col0 + wide]
        part += random.integers(-50_000, 50_000, part.shape, dtype=np.int32)
        if part.size:
            for level in range(grid.levels):
                self.send(level, Span(row0, row0 + high, col0, col0 + wide))
        self.edits += 1

    def send(self, level: int, changed: Span) -> None:
        """Write a level's changed blocks into the pool, as many at a time as it holds."""
        grid, cache = self.plain.grid, self.terrain.cache
        keys = touched(grid, level, changed)
        for first in range(0, len(keys), cache.capacity):
            group = keys[first : first + cache.capacity]
            for key, layer in zip(group, cache.hold(group), strict=True):
                posts = self.plain.block(key)
                start = layer * BLOCK_POSTS
                self.terrain.pool.numpy()[start : start + BLOCK_POSTS] = posts.reshape(-1)
                bounds = (int(posts.min()), int(posts.max()), int(self.random.integers(1, 999)))
                cache.edited(key, *bounds)
                self.bounds[key] = bounds

    def posts_in_pool(self, layer: int) -> Counts:
        """A layer's posts as kernels see them."""
        start = layer * BLOCK_POSTS
        posts: Counts = self.terrain.pool.numpy()[start : start + BLOCK_POSTS]
        return posts.reshape(BLOCK, BLOCK)


def off(grid: Grid, points: Points) -> npt.NDArray[np.bool_]:
    """Whether points lie beyond the edge."""
    x, y = (points[:, 0] - grid.x) / grid.spacing, (points[:, 1] - grid.y) / grid.spacing
    beyond_x = (x < grid.col) | (x > grid.col + grid.cols - 1)
    return beyond_x | (y < grid.row) | (y > grid.row + grid.rows - 1)


def touched(grid: Grid, level: int, changed: Span) -> list[Block]:
    """Blocks of a level that hold a post taken from a rectangle of the array."""
    span = grid.blocks(level)
    rows = [
        index
        for index in range(span.row0, span.row1)
        if hit(block_indices(index) << level, grid.row, grid.rows, changed.row0, changed.row1)
    ]
    cols = [
        index
        for index in range(span.col0, span.col1)
        if hit(block_indices(index) << level, grid.col, grid.cols, changed.col0, changed.col1)
    ]
    return [Block(level, row, col) for row in rows for col in cols]


def hit(posts: Indices, first: int, count: int, low: int, end: int) -> bool:
    """Whether any of the posts, moved into the terrain, is one of the changed."""
    place = np.clip(posts, first, first + count - 1) - first
    return bool(((place >= low) & (place < end)).any())


def entries_of(table: npt.NDArray[np.int32], grid: Grid) -> dict[Block, int]:
    """All blocks present in a table and their layers, by the formula of kernels/addressing.py."""
    found = {}
    for level in range(grid.levels):
        start, width, page_row, page_col = table[HEADER * level : HEADER * (level + 1)].tolist()
        span = grid.blocks(level)
        for row in range(span.row0, span.row1):
            for col in range(span.col0, span.col1):
                at = start + (row // PAGE - page_row) * width + (col // PAGE - page_col)
                layer = int(table[int(table[at]) + row % PAGE * PAGE + col % PAGE])
                if layer != ABSENT:
                    found[Block(level, row, col)] = layer
    return found


def smooth_and_rough(rows: int, cols: int, seed: int) -> Counts:
    """Heights that differ from post to post, so that a wrong place is a wrong height."""
    random = np.random.default_rng(seed)
    y, x = np.mgrid[0:rows, 0:cols] / 90.0
    posts: Counts = (2e7 * np.sin(x) * np.cos(y) + random.normal(0, 4e4, x.shape)).astype(np.int32)
    return posts


def plain_terrain() -> tuple[Any, PlainArray]:
    """1,500 x 2,300 posts around the origin of indices, far from the world's."""
    grid = Grid(1500, 2300, SPACING, x=1e5, y=-2e6, row=-700, col=-1111, datum=321.0)
    posts = smooth_and_rough(grid.rows, grid.cols, 1)
    return ts.ArraySource(posts.copy(), grid), PlainArray(posts, grid)


def mirrored_terrain() -> tuple[Any, PlainArray]:
    """65 x 129 posts reflected to 1,400 x 1,900, oracle by NumPy's own reflection."""
    base = smooth_and_rough(65, 129, 2)
    source = ts.ArraySource(base, Grid(65, 129, SPACING, x=7.0, y=-3.0))
    mirrored = Mirrored(source, rows=1400, cols=1900, row=-650, col=-900)
    south, north = 650, 1400 - 650 - 65
    west, east = 900, 1900 - 900 - 129
    posts = np.pad(base, ((south, north), (west, east)), mode="reflect")
    return mirrored, PlainArray(posts, mirrored.grid)


@pytest.fixture(params=[plain_terrain, mirrored_terrain], ids=["plain", "mirrored"])
def script(request: pytest.FixtureRequest) -> Iterator[Script]:
    """A terrain whose pool holds a seventh of its blocks, beside its oracle."""
    source, plain = request.param()
    with ts.Terrain(source, pool_bytes=LAYERS * BLOCK_BYTES, loaders=2) as terrain:
        yield Script(terrain, plain, 3)


def test_moves_queries_and_edits_equal_a_plain_array_to_the_bit(script: Script) -> None:
    """50,000 of them on either terrain, blocks coming and going all the time."""
    grid, cache = script.plain.grid, script.terrain.cache
    assert min(grid.row, grid.col) < 0
    assert grid.levels >= 4
    while script.moves + script.queries + script.edits < 50_000:
        for _ in range(6):
            script.move()
            script.query(40, wait=True)
            script.query(20, wait=False)
        script.edit()
    script.query(2000, wait=True)
    assert script.moves > 400
    assert script.edits > 80
    assert cache.counters.evictions > 10 * LAYERS
    assert cache.counters.written_back > 100
    assert cache.counters.loads > 1000


def test_edits_of_all_levels_survive_leaving_the_pool(script: Script) -> None:
    for _ in range(30):
        script.edit()
    cache = script.terrain.cache
    assert set(script.bounds) - set(cache.residents)
    assert {key.level for key in script.bounds} == set(range(script.plain.grid.levels))
    for key, bounds in script.bounds.items():
        (layer,) = cache.hold([key])
        assert np.array_equal(script.posts_in_pool(layer), script.plain.block(key)), key
        assert cache.describe(key) == bounds
        assert script.terrain.error.numpy()[layer] == bounds[2]


def test_flushed_edits_are_in_the_ground_and_untouched_blocks_are_not(script: Script) -> None:
    for _ in range(5):
        script.edit()
    script.terrain.cache.flush()
    ground = script.terrain.ground
    assert ground.edited == sorted(script.bounds)
    for key in ground.edited:
        data = ground.block(key)
        assert np.array_equal(data.posts, script.plain.block(key))
        assert (data.lowest, data.highest, data.error) == script.bounds[key]
