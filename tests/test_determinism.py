"""The same script, the same bits: threads, disks and pools change only how long it takes."""

from __future__ import annotations

import hashlib
import time
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

import terrasim as ts
from terrasim.cache.needs import Boxes, Disc
from terrasim.cache.pool import BLOCK_BYTES
from terrasim.counts import Counts
from terrasim.grid import Block, Grid, Indices
from terrasim.kernels.sample import sample_surface
from terrasim.launch import launch
from terrasim.sources.source import BlockData, read_block

GRID = Grid(8161, 8161, 1.0, x=0.25, row=-8192)
"""1,365 blocks, one of them the top."""
LEAST = 8
"""Layers of the smallest pool."""
STEPS = 100

Metres = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Waves:
    """Ground from a formula in whole numbers, read as slowly as told."""

    longest_read_s: float = 0.0
    grid: Grid = GRID
    synthetic: str = "waves"

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        row, col = self.grid.clamp_rows(rows << level), self.grid.clamp_cols(cols << level)
        waves = (row[:, None] ** 2 * 3 + col[None, :] ** 2 * 5 + row[:, None] * col[None, :]) >> 4
        return (waves % 2_000_003).astype(np.int32)

    def block(self, key: Block) -> BlockData:
        if self.longest_read_s:
            time.sleep(np.random.default_rng().uniform(0.0, self.longest_read_s))
        return read_block(self, key, key.level * 1000 + key.row)


@dataclass(frozen=True)
class Way:
    """What must make no difference."""

    threads: int = 1
    loaders: int = 1
    layers: int = 800
    slow: float = 0.0
    busy: bool = False
    """Whether queries and edits come between ``require`` and the step."""


class Script:
    """Random steps, each with needs, wishes, queries, edits and a read of what is required."""

    def __init__(self, terrain: ts.Terrain, way: Way) -> None:
        self.terrain = terrain
        self.way = way
        self.random = np.random.default_rng(42)
        self.seen = hashlib.sha256()

    def step(self, number: int) -> None:
        """One step; the random numbers it takes are the same in every way."""
        cache, random = self.terrain.cache, self.random
        row, col = random.uniform(-8500.0, 300.0), random.uniform(-300.0, 8500.0)
        places = np.rint(random.normal((row, col), 10.0, (2, 2))).astype(np.int64)
        boxes = Boxes(places[:, 0], places[:, 0] + 1, places[:, 1], places[:, 1] + 1)
        if not self.way.busy:
            self.disturb(number)
        cache.require([Disc(row, col, 60.0, number % 3), boxes])
        cache.want([Disc(row + 300.0, col, 500.0), Disc(row, col, 300.0, 1)])
        for _ in range(int(np.random.default_rng().integers(0, 4))):
            cache.work(float(np.random.default_rng().uniform(0.0, 2.0)))
        if self.way.busy:
            self.disturb(number)
        self.note(self.contact(random.normal((col, row), 50.0, (1500, 2))))

    def disturb(self, number: int) -> None:
        """Ask about ground far and near, change a block."""
        points = self.random.uniform((-500.0, -8500.0), (8500.0, 500.0), (1200, 2))
        points[5:] = points[:1] + points[5:] / 30.0
        level = int(self.random.integers(0, 4))
        found = ts.sample_all(self.terrain, points, level=level)
        for values in vars(found).values():
            self.note(values)
        span = GRID.blocks(level)
        key = Block(level, int(self.random.integers(span.row0, span.row1)), number % 3)
        (layer,) = self.terrain.cache.hold([key])
        posts = self.terrain.cache.pool.read(layer) + np.int32(number * 100)
        self.terrain.cache.pool.write(layer, posts, 5)
        self.terrain.cache.edited(key, int(posts.min()), int(posts.max()), number)

    def contact(self, points: Metres) -> Metres:
        """Heights as a step would read them: from the table of what is required."""
        terrain = self.terrain
        asked: Any = wp.array(points, dtype=wp.vec2d, device="cpu")
        types = (wp.float64, wp.vec3d, wp.float64, wp.uint8, wp.float64, wp.uint8)
        outputs: list[Any] = [wp.empty(len(points), dtype=t, device="cpu") for t in types]
        tables = [terrain.pool, terrain.required, terrain.error]
        launch(
            sample_surface,
            len(points),
            shared=[*tables, terrain.lattice, 0, terrain.used],
            items=[asked, *outputs],
            device=terrain.device,
            threads=terrain.threads,
        )
        return np.column_stack([array.numpy() for array in outputs])

    def note(self, values: npt.NDArray[Any]) -> None:
        self.seen.update(np.ascontiguousarray(values).tobytes())

    def result(self) -> str:
        """Hash of all that was seen, and of the ground as it is now."""
        self.terrain.cache.flush()
        for key in self.terrain.ground.edited:
            data = self.terrain.ground.block(key)
            self.note(data.posts)
            self.seen.update(repr((key, data.lowest, data.highest, data.error)).encode())
        return self.seen.hexdigest()


def run(way: Way) -> str:
    """Hash of the script run in one way."""
    with ts.Terrain(
        Waves(way.slow),
        pool_bytes=way.layers * BLOCK_BYTES,
        threads=way.threads,
        loaders=way.loaders,
    ) as terrain:
        assert terrain.cache.pool.layers == way.layers
        script = Script(terrain, way)
        for number in range(STEPS):
            script.step(number)
        counters = terrain.cache.counters
        assert counters.coarsened == 0
        assert counters.loads > 100
        assert way.layers == 800 or counters.written_back > 50
        return script.result()


@pytest.fixture(scope="module")
def calm() -> str:
    """The result with a large pool and a fast disk."""
    return run(Way())


@pytest.mark.parametrize(
    "way",
    [
        Way(),
        Way(threads=2),
        Way(threads=3, loaders=3),
        Way(slow=0.004, loaders=2),
        Way(layers=LEAST),
        Way(layers=LEAST, slow=0.002, loaders=4, threads=2),
        Way(layers=40, loaders=2),
    ],
    ids=str,
)
def test_what_is_required_and_asked_is_the_same_in_every_way(way: Way, calm: str) -> None:
    assert run(way) == calm


@pytest.fixture(scope="module")
def busy() -> str:
    """The result of queries and edits inside the step, with the least pool."""
    return run(Way(layers=LEAST, busy=True))


@pytest.mark.parametrize("change", [{"slow": 0.003, "loaders": 3}, {"threads": 3}, {"loaders": 2}])
def test_queries_inside_a_step_displace_what_it_requires_by_rule(
    change: dict[str, Any], busy: str
) -> None:
    """They should not be there, but even so the disk's speed decides nothing."""
    assert run(replace(Way(layers=LEAST, busy=True), **change)) == busy


def test_another_script_has_another_hash(calm: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """So that the hash does see the heights: one count in one block is enough."""
    plain = Script.disturb

    def disturb(self: Script, number: int) -> None:
        plain(self, number)
        if number == STEPS - 1:
            (layer,) = self.terrain.cache.hold([Block(0, 0, 0)])
            posts = self.terrain.cache.pool.read(layer)
            posts[0, 0] += 1
            self.terrain.cache.pool.write(layer, posts, 0)
            self.terrain.cache.edited(Block(0, 0, 0), 0, 0, 0)

    monkeypatch.setattr(Script, "disturb", disturb)
    assert run(Way()) != calm
