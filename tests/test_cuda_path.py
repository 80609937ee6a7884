"""The cache's branch for CUDA: on a stand-in whose copies end late, and on a GPU if there is one.

The stand-in runs what a step launches at once and holds copies back until something waits for them
or the test lets them go, each reading its staging buffer only then. It shows that the order of
copies, waits and table changes is right, not that Warp or a driver keeps it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest
import warp as wp

import terrasim as ts
from terrasim.cache import pool as pool_module
from terrasim.cache import table as table_module
from terrasim.cache.cache import Cache
from terrasim.cache.ground import Ground
from terrasim.cache.needs import Disc, region_blocks
from terrasim.cache.pool import BLOCK_POSTS, STAGING_SLOTS
from terrasim.counts import Counts
from terrasim.detail.grid import DetailGrid
from terrasim.grid import Block, Grid, Indices
from terrasim.kernels.addressing import ABSENT, BLOCK, HEADER, PAGE
from terrasim.sources.source import BlockData, read_block

SIDE = 8
GRID = Grid(SIDE * BLOCK - 8, SIDE * BLOCK - 8, 1.0)
TOP = Block(3, 0, 0)
LAYERS = 12


class Numbered:
    """Every post has its own height, every block its own error."""

    synthetic = "numbered"
    grid = GRID

    def __init__(self) -> None:
        self.bad: Block | None = None

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        row, col = self.grid.clamp_rows(rows << level), self.grid.clamp_cols(cols << level)
        return (row[:, None] * 4096 + col[None, :]).astype(np.int32)

    def block(self, key: Block) -> BlockData:
        if key == self.bad:
            self.bad = None
            raise OSError("the disk is gone")
        return read_block(self, key, key.level * 1000 + key.row * 10 + key.col)


@dataclass
class Copies:
    """The copy stream: work that waits its turn."""

    gpu: Gpu
    work: list[Callable[[], None]] = field(default_factory=list)
    done: int = 0
    safe: bool = False
    """Whether it waits for all that the step has launched."""

    def advance(self, until: int) -> None:
        """Do the work up to a place in the queue."""
        while self.done < until:
            self.work[self.done]()
            self.done += 1

    def record_event(self) -> Event:
        return Event(self, len(self.work))

    def wait_event(self, event: Event) -> None:
        assert event.stream is self.gpu.step
        self.safe = True


@dataclass
class Event:
    """A place in a stream's queue."""

    stream: Any
    place: int

    @property
    def is_complete(self) -> bool:
        return bool(self.stream.done >= self.place)


@dataclass
class Step:
    """The step's stream: its work is done as soon as it is launched."""

    done: int = 0

    def record_event(self) -> Event:
        return Event(self, 0)

    def wait_event(self, event: Event) -> None:
        event.stream.advance(event.place)


class Gpu:
    """What the pool and the tables ask of Warp, with memory of the host."""

    is_cuda = True
    int32 = wp.int32
    uint8 = wp.uint8

    def __init__(self) -> None:
        self.step = Step()
        self.copies = Copies(self)
        self.waits_of_the_host = 0

    def empty(self, size: int, dtype: Any, device: Any, **_: bool) -> Any:
        """Memory with something in it."""
        return wp.full(size, -77, dtype=dtype, device="cpu")

    def zeros(self, size: int, dtype: Any, device: Any) -> Any:
        return wp.zeros(size, dtype=dtype, device="cpu")

    def array(self, values: Any, device: Any, **rest: Any) -> Any:
        return wp.array(values, device="cpu", **rest)

    def Stream(self, device: Any) -> Copies:  # noqa: N802 as Warp has it
        return self.copies

    def get_stream(self, device: Any) -> Step:
        return self.step

    def launch(self, kernel: Any, **rest: Any) -> None:
        """A kernel of the step: copies that begin after it have to wait for it anew."""
        self.copies.safe = False
        wp.launch(kernel, **(rest | {"device": "cpu"}))

    def synchronize_event(self, event: Event) -> None:
        self.waits_of_the_host += 1
        event.stream.advance(event.place)

    def copy(self, dest: Any, src: Any, at: int, start: int, count: int, *, stream: Copies) -> None:
        assert stream.safe, "a kernel may still read what this copy overwrites"

        def run() -> None:
            dest.numpy()[at : at + count] = src.numpy()[start : start + count]

        stream.work.append(run)

    def let_copies_end(self, count: int = 1 << 30) -> None:
        self.copies.advance(min(self.copies.done + count, len(self.copies.work)))


@pytest.fixture
def gpu(monkeypatch: pytest.MonkeyPatch) -> Gpu:
    gpu = Gpu()
    monkeypatch.setattr(pool_module, "wp", gpu)
    monkeypatch.setattr(table_module, "wp", gpu)
    return gpu


@pytest.fixture
def source() -> Numbered:
    return Numbered()


@pytest.fixture
def cache(gpu: Gpu, source: Numbered) -> Iterator[Cache]:
    cache = Cache(GRID, Ground(source), LAYERS, gpu, loaders=1)
    yield cache
    cache.close()


def on_device(table: Any) -> dict[Block, int]:
    """Blocks and layers in a table as the device has it."""
    entries = table.entries.numpy()
    found = {}
    for level in range(GRID.levels):
        start, _, row0, col0 = entries[HEADER * level : HEADER * (level + 1)].tolist()
        assert (row0, col0) == (0, 0)
        for key in region_blocks(GRID, GRID.posts(level), level):
            layer = int(entries[entries[start] + key.row * PAGE + key.col])
            if layer != ABSENT:
                found[key] = layer
    return found


def check_device(cache: Cache, edited: dict[Block, Counts]) -> set[Block]:
    """What a kernel launched now would find is what the source or the last edit says."""
    there = on_device(cache.resident)
    assert len(set(there.values())) == len(there)
    for key, layer in there.items():
        posts = cache.pool.posts.numpy()[layer * BLOCK_POSTS : (layer + 1) * BLOCK_POSTS]
        expected = cache.ground.source.block(key)
        assert np.array_equal(posts.reshape(BLOCK, BLOCK), edited.get(key, expected.posts)), key
        assert key in edited or cache.pool.error.numpy()[layer] == expected.error
    required = on_device(cache.required)
    assert required.items() <= there.items()
    return set(required)


def need(row: int, col: int, level: int = 0) -> Disc:
    scale = BLOCK << level
    return Disc((row + 0.5) * scale, (col + 0.5) * scale, 10.0, level)


def wait_for_reads(cache: Cache, number: int) -> None:
    """Work, one block a step, until so many were sent; copies stay under way."""
    while cache.counters.loads < number:
        cache.work(0.0)


def test_what_a_step_requires_has_arrived_when_its_kernels_run(cache: Cache, gpu: Gpu) -> None:
    for row in range(SIDE):
        cache.require([need(row, col) for col in range(5)])
        required = check_device(cache, {})
        assert required == {TOP, *(Block(0, row, col) for col in range(5))}


def test_a_wanted_block_is_seen_only_when_its_copy_has_ended(cache: Cache, gpu: Gpu) -> None:
    cache.want([need(0, col) for col in range(4)])
    wait_for_reads(cache, 5)
    assert cache.residents == [TOP]
    assert set(on_device(cache.resident)) == {TOP}
    gpu.let_copies_end(2)  # one block: its posts and its error
    cache.work(1.0)
    check_device(cache, {})
    assert len(cache.residents) == 2
    gpu.let_copies_end()
    cache.work(1.0)
    check_device(cache, {})
    assert len(cache.residents) == 5
    assert gpu.waits_of_the_host == 0


def test_a_step_that_requires_what_is_on_its_way_waits_on_the_device(
    cache: Cache, gpu: Gpu
) -> None:
    cache.want([need(0, col) for col in range(4)])
    wait_for_reads(cache, 5)
    cache.require([need(0, 1)])
    assert check_device(cache, {}) == {TOP, Block(0, 0, 1)}
    assert cache.counters.loads == 5
    assert gpu.waits_of_the_host == 0


def test_blocks_on_their_way_make_room_for_what_is_required(cache: Cache, gpu: Gpu) -> None:
    """They hold layers that no table names yet."""
    cache.want([need(0, col) for col in range(7)])
    wait_for_reads(cache, 8)
    keys = [(row, col) for row in (5, 6) for col in range(5)] + [(7, 7)]
    cache.require([need(row, col) for row, col in keys])
    assert check_device(cache, {}) == {TOP, *(Block(0, row, col) for row, col in keys)}
    assert cache.counters.coarsened == 0


def test_staging_buffers_are_not_refilled_before_they_were_copied(cache: Cache, gpu: Gpu) -> None:
    """More copies under way than there are buffers: only then the host waits."""
    cache.want([need(row, col) for row in (0, 1) for col in range(5)])
    wait_for_reads(cache, STAGING_SLOTS)
    assert gpu.waits_of_the_host == 0
    wait_for_reads(cache, 11)
    assert gpu.waits_of_the_host == 3
    gpu.let_copies_end()
    cache.work(1.0)
    check_device(cache, {})
    assert len(cache.residents) == 11


def test_a_failed_read_leaves_the_devices_tables_true(
    cache: Cache, gpu: Gpu, source: Numbered
) -> None:
    cache.require([need(0, col) for col in range(8)])
    source.bad = Block(0, 4, 7)  # by then others have given their layers away
    with pytest.raises(OSError, match="the disk is gone"):
        cache.require([need(4, col) for col in range(8)])
    check_device(cache, {})
    cache.require([need(4, col) for col in range(8)])
    assert check_device(cache, {}) == {TOP, *(Block(0, 4, col) for col in range(8))}


def test_a_random_script_leaves_the_device_true_at_every_step(cache: Cache, gpu: Gpu) -> None:
    random = np.random.default_rng(0)
    edited: dict[Block, Counts] = {}
    for _ in range(250):
        row, col = (float(x) for x in random.uniform(0.0, GRID.rows, 2))
        level = int(random.integers(0, 3))
        cache.want([Disc(row, col, 500.0, level), need(int(random.integers(0, 8)), 3)])
        for _ in range(int(random.integers(0, 4))):
            cache.work(float(random.uniform(0.0, 2.0)))
            check_device(cache, edited)
            gpu.let_copies_end(int(random.integers(0, 8)))
        if random.random() < 0.5:
            cache.require([Disc(row, col, 100.0, level)])
            check_device(cache, edited)
        if random.random() < 0.4:
            (key,) = Disc(row, col, 0.0, level).blocks(GRID, level)[:1]
            (layer,) = cache.hold([key])
            posts = cache.pool.read(layer) + np.int32(random.integers(1, 1000))
            cache.pool.posts.numpy()[layer * BLOCK_POSTS : (layer + 1) * BLOCK_POSTS] = (
                posts.ravel()
            )
            cache.edited(key, 0, 0, 9)
            assert cache.pool.error.numpy()[layer] == 9
            edited[key] = posts
        check_device(cache, edited)
    assert cache.counters.written_back > 20
    assert cache.counters.evictions > 200


def detail_on_device(cache: Cache, table: Any) -> tuple[set[int], dict[Block, int]]:
    """Layers flagged as having detail, and detail blocks and their layers, as the device has it."""
    detail = cache.detail_table
    assert detail is not None
    entries = table.entries.numpy()[detail.start :]
    slots = entries[LAYERS:].reshape(-1, 3).tolist()
    found = {Block(-1, row, col): layer for row, col, layer in slots if layer != ABSENT}
    return set(np.flatnonzero(entries[:LAYERS] == 1).tolist()), found


def check_detail(cache: Cache, there: dict[Block, int], edited: dict[Block, Counts]) -> None:
    """Blocks a kernel finds now come with all their detail, and none is flagged that has none."""
    detail = DetailGrid(GRID, 4)
    flagged, found = detail_on_device(cache, cache.resident)
    assert detail_on_device(cache, cache.required) == (flagged, found)
    assert {detail.base_of(key) for key in found} <= set(there)
    assert flagged == {there[detail.base_of(key)] for key in found}
    for key, posts in edited.items():
        if detail.base_of(key) in there and posts.any():
            start = found[key] * BLOCK_POSTS
            read = cache.pool.posts.numpy()[start : start + BLOCK_POSTS]
            assert np.array_equal(read.reshape(BLOCK, BLOCK), posts), key


def test_detail_is_on_the_device_whenever_its_block_is(gpu: Gpu, source: Numbered) -> None:
    """Copies of detail under way are waited for, or not seen yet, as those of its block."""
    random = np.random.default_rng(3)
    ground = Ground(source, DetailGrid(GRID, 4))
    cache = Cache(GRID, ground, LAYERS, gpu, loaders=1, detail_layers=6)
    edited: dict[Block, Counts] = {}
    for _ in range(150):
        at = [int(x) for x in random.integers(0, SIDE, 2)]
        cache.want([need(at[0], col) for col in range(4)])
        for _ in range(int(random.integers(0, 4))):
            cache.work(float(random.uniform(0.0, 2.0)))
            check_detail(cache, on_device(cache.resident), edited)
            gpu.let_copies_end(int(random.integers(0, 8)))
        if random.random() < 0.5:
            cache.require([need(*at)])
            check_detail(cache, on_device(cache.resident), edited)
        if random.random() < 0.6:
            key = Block(-1, at[0] * 4 + int(random.integers(2)), at[1] * 4)
            (layer,) = cache.hold_details([key])
            posts = cache.pool.read(layer)
            assert np.array_equal(posts, edited.get(key, np.zeros_like(posts)))
            posts = posts + np.int32(random.integers(-1, 2))
            cache.pool.posts.numpy()[layer * BLOCK_POSTS : (layer + 1) * BLOCK_POSTS] = (
                posts.ravel()
            )
            cache.edited(key, int(posts.min()), int(posts.max()), 0)
            edited[key] = posts
            cache.hold([Block(0, *at)])
            check_detail(cache, on_device(cache.resident), edited)
    assert cache.counters.evictions > 100
    assert any(posts.any() for posts in edited.values())
    cache.close()


@pytest.mark.skipif(not wp.is_cuda_available(), reason="no CUDA device")
@pytest.mark.parametrize("layers", [LAYERS, 80])
def test_a_gpu_answers_as_the_cpu_does(layers: int) -> None:
    """To a count's millionth: a GPU may round a product and a sum once instead of twice."""
    random = np.random.default_rng(1)
    size = layers * 4 * BLOCK_POSTS
    with (
        ts.Terrain(Numbered(), pool_bytes=size) as here,
        ts.Terrain(Numbered(), pool_bytes=size, device="cuda:0") as there,
    ):
        for _ in range(20):
            points = random.uniform(-50.0, GRID.rows + 50.0, (5000, 2))
            level = int(random.integers(0, GRID.levels))
            for terrain in (here, there):
                terrain.cache.require([Disc(points[0, 1], points[0, 0], 200.0)])
                terrain.cache.want([Disc(points[1, 1], points[1, 0], 600.0)])
                terrain.cache.work(2.0)
            one, other = (ts.sample_all(t, points, level=level) for t in (here, there))
            np.testing.assert_allclose(other.height, one.height, rtol=0, atol=1e-11)
            np.testing.assert_allclose(other.normal, one.normal, rtol=0, atol=1e-12)
            for name in ("level", "error", "state"):
                assert np.array_equal(getattr(other, name), getattr(one, name)), name
            assert np.array_equal(ts.sample(there, points, level=level).state, one.state)
