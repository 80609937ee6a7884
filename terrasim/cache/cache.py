"""Residency: which blocks are in the pool, and the jobs that follow the needs.

Required blocks are resident before a step runs; when they exceed the pool, needs are coarsened by
rule. Wanted blocks come through a queue in the order of need, inside a time budget. Moving sideways
and changing level are the same act: needs change, jobs follow.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np

from terrasim.cache.coarsen import coarsen
from terrasim.cache.counters import Counters
from terrasim.cache.ground import Ground
from terrasim.cache.loader import Loader
from terrasim.cache.needs import Need, region_blocks
from terrasim.cache.pool import BLOCK_BYTES, Pool
from terrasim.cache.table import Table
from terrasim.counts import Counts
from terrasim.errors import RunError
from terrasim.grid import Block, Grid, Indices
from terrasim.sources.source import BlockData


class Cache:
    """The resident blocks of one terrain."""

    def __init__(
        self,
        grid: Grid,
        ground: Ground,
        layers: int,
        device: Any,
        loaders: int,
        *,
        waits: bool = True,
    ) -> None:
        """Allocate the pool and bring in the coarsest level, which stays.

        Args:
            grid: The terrain's grid.
            ground: Where blocks come from and edited ones go.
            layers: Layers of the pool.
            device: Warp device.
            loaders: Threads that read blocks.
            waits: Whether a step waits for blocks it requires. If not, they are asked for before
                all that is wanted, and the step does without.
        """
        self.before_reading: Callable[[], object] = _nothing
        """Called before the ground is read: what waits to change it is done then."""
        self._waits = waits
        self._late: list[Block] = []
        self.grid = grid
        self.ground = ground
        self.counters = Counters()
        self.pool = Pool(layers, device)
        self.resident = Table(grid, layers, device)
        self.required = Table(grid, layers, device)
        self._loader = Loader(ground.block, loaders)
        self._layer: dict[Block, int] = {}
        self._key: list[Block | None] = [None] * layers
        self._bounds: list[tuple[int, int, int]] = [(0, 0, 0)] * layers
        self._free = list(range(layers - 1, -1, -1))
        self._dirty: set[Block] = set()
        self._tick = 0
        self._last_used = np.zeros(layers, dtype=np.int64)
        self._needed: set[Block] = set()
        self._requirement: list[Block] = []
        self._wanted: list[Block] = []
        self._arriving: dict[Block, tuple[int, Any]] = {}
        self._worst_place_ms = 0.0
        top = region_blocks(grid, grid.posts(grid.top), grid.top)
        self._top = frozenset(top)
        self.capacity = layers - len(top)
        """Blocks the pool can hold beside the coarsest level."""
        try:
            self._bring(top, set(top))
        except BaseException:
            self._loader.close()
            raise
        for key in top:
            self.required.set(key, self._layer[key])
        self._publish()

    def require(self, needs: Sequence[Need]) -> None:
        """Make all that a step reads resident, and the ``required`` table exactly that.

        Waiting is a stall. Needs that together exceed the pool are coarsened, the finest and
        largest first, so that what a step reads never depends on how fast a disk was.
        """
        self.before_reading()
        fitting = coarsen(needs, self.grid, self.capacity, self._top)
        self.counters.coarsened += fitting.steps
        needed = set(fitting.blocks)
        self._tick += 1
        for key in self._needed - needed - self._top:
            self.required.clear(key)
        # Only what the table holds, in case reading the rest fails.
        self._needed &= needed
        missing = [key for key in fitting.blocks if key not in self._layer]
        self.counters.hits += len(needed) - len(missing)
        self._late = []
        if missing and not self._waits:
            self.counters.misses += len(missing)
            self.counters.late += len(missing)
            self._late = missing
            needed.difference_update(missing)
        elif missing:
            start = time.perf_counter()
            self.counters.misses += len(missing)
            self.counters.stalls += 1
            self._bring(missing, needed)
            self.counters.stall_ms += (time.perf_counter() - start) * 1e3
        self._last_used[[self._layer[key] for key in needed]] = self._tick
        for key in needed - self._needed:
            self.required.set(key, self._layer[key])
        self._needed = needed
        self._requirement = [key for key in fitting.blocks if key in needed]
        for key in fitting.raised & self._layer.keys():
            error = self._bounds[self._layer[key]][2]
            self.counters.coarsened_error = max(self.counters.coarsened_error, error)
        self._publish()

    def restore(self) -> None:
        """Bring back what the last ``require`` made resident and a query or stamp displaced since.

        Without it a step would read what happened to be left, and that depends on the disk.
        """
        displaced = [key for key in self._requirement if key not in self._needed]
        if not displaced:
            return
        start = time.perf_counter()
        missing = [key for key in displaced if key not in self._layer]
        self.counters.misses += len(missing)
        self.counters.stalls += bool(missing)
        self._bring(missing, set(self._requirement))
        for key in displaced:
            self.required.set(key, self._layer[key])
        self._needed.update(displaced)
        self._last_used[[self._layer[key] for key in displaced]] = self._tick
        self._publish()
        self.counters.stall_ms += (time.perf_counter() - start) * 1e3

    def want(self, needs: Sequence[Need]) -> None:
        """Say what will be needed soon, in the order of need; replaces what was said before.

        What the pool cannot hold beside the required blocks is left out, the last first.
        """
        wanted: dict[Block, None] = {}
        for need in needs:
            level = min(need.level, self.grid.top)
            wanted.update(dict.fromkeys(need.blocks(self.grid, level)))
        asked = dict.fromkeys([*self._late, *wanted])
        beside = [key for key in asked if key not in self._needed and key not in self._top]
        self._wanted = beside[: max(0, self.capacity - len(self._needed - self._top))]
        held = [self._layer[key] for key in self._wanted if key in self._layer]
        self._last_used[held] = np.maximum(self._last_used[held], self._tick)

    def work(self, budget_ms: float) -> None:
        """Run jobs of the queue: place what has been read, ask for what is wanted next.

        A block is placed only while the worst placement seen still fits into the budget; at least
        one is placed if any is ready, so that the queue always moves.
        """
        start = time.perf_counter()
        self._tick += 1
        keep = self._needed.union(self._wanted)
        self._loader.drop(keep)
        self._admit_arrived()
        try:
            self._place_ready(keep, start, budget_ms)
        finally:
            self._publish()
        self._ask_wanted()
        spent = (time.perf_counter() - start) * 1e3
        self.counters.queue_ms += spent
        self.counters.queue_over += spent > budget_ms
        self.counters.read_ms = self._loader.read_ms

    def hold(self, blocks: Iterable[Block]) -> list[int]:
        """Make blocks resident now, outside any step; later calls may evict them.

        Returns:
            Their layers, in the order given.

        Raises:
            RunError: If there are more than the pool holds.
        """
        self.before_reading()
        keys = list(blocks)
        held = dict.fromkeys(keys)
        beside = len(held.keys() - self._top)
        if beside > self.capacity:
            raise RunError(
                f"{beside} blocks are needed at once but the pool holds {self.capacity}; "
                "raise pool_bytes"
            )
        self._tick += 1
        self._bring([key for key in held if key not in self._layer], set(held))
        layers = [self._layer[key] for key in keys]
        self._last_used[layers] = self._tick
        self._publish()
        return layers

    def edited(self, key: Block, lowest: int, highest: int, error: int) -> None:
        """Take note that a resident block's posts were changed in the pool."""
        layer = self._layer[key]
        self._bounds[layer] = (lowest, highest, error)
        self.pool.set_error(layer, error)
        self._dirty.add(key)

    def describe(self, key: Block) -> tuple[int, int, int]:
        """Lowest and highest count and error bound of a resident block."""
        return self._bounds[self._layer[key]]

    @property
    def highest(self) -> Counts:
        """Highest count of each layer's block, int32, shape ``(layers,)``; 0 in an empty layer."""
        return np.array([highest for _, highest, _ in self._bounds], dtype=np.int32)

    def is_resident(self, key: Block) -> bool:
        """Whether a block is in the pool."""
        return key in self._layer

    @property
    def pending(self) -> int:
        """Wanted blocks that are not there yet."""
        return len(self._missing_wanted())

    @property
    def residents(self) -> list[Block]:
        """Keys of all resident blocks, in order."""
        return sorted(self._layer)

    def note_used(self) -> Indices:
        """Let the layers that queries read count as recently used; returns them."""
        layers = self.pool.take_used()
        self._last_used[layers] = self._tick
        return layers

    def note_fallback(self, layers: Indices, level: int) -> None:
        """Keep the largest error bound among layers that answered for a finer level."""
        for layer in layers:
            key = self._key[layer]
            if key is not None and key.level > level:
                error = self._bounds[layer][2]
                self.counters.fallback_error = max(self.counters.fallback_error, error)

    def flush(self) -> None:
        """Write every edited block back to the ground; they stay resident."""
        for key in sorted(self._dirty):
            self._write_back(key)
        self.counters.read_ms = self._loader.read_ms

    @property
    def dirty(self) -> int:
        """Number of resident blocks that the ground does not know yet."""
        return len(self._dirty)

    def discard(self) -> None:
        """Forget every resident block, edits too, and bring in the coarsest level anew."""
        self._loader.forget()
        self._dirty.clear()
        self._arriving.clear()
        for key, layer in list(self._layer.items()):
            self.resident.clear(key)
            self.required.clear(key)
            self._key[layer] = None
        self._layer.clear()
        self._needed.clear()
        self._requirement.clear()
        self._late.clear()
        self._wanted.clear()
        self._free = list(range(self.pool.layers - 1, -1, -1))
        self._bounds = [(0, 0, 0)] * self.pool.layers
        self._bring(sorted(self._top), set(self._top))
        for key in sorted(self._top):
            self.required.set(key, self._layer[key])
        self._publish()

    def close(self) -> None:
        """End the loader's threads."""
        self._loader.close()
        self.counters.read_ms = self._loader.read_ms

    def _bring(self, missing: list[Block], keep: set[Block]) -> None:
        """Wait for blocks and place them, each as soon as it has been read."""
        self._admit_awaited([key for key in missing if key in self._arriving])
        left = [key for key in missing if key not in self._layer]
        if left:
            # Copies end in the order they began, so that the rest is there before what is left.
            self._admit_awaited(list(self._arriving))
        try:
            self._load(left, keep)
        finally:
            self._publish()

    def _load(self, left: list[Block], keep: set[Block]) -> None:
        """Read blocks, as many at a time as the loader has slots, and place them in their order."""
        for first in range(0, len(left), self._loader.slots):
            part = left[first : first + self._loader.slots]
            for key in part:
                self._loader.ask(key)
            for key in part:
                place = self._free_layer(keep)
                if place is None:
                    raise RunError("the pool is full of required blocks; raise pool_bytes")
                self._place(key, place, urgent=True)

    def _place_ready(self, keep: set[Block], start: float, budget_ms: float) -> None:
        """Place what has been read while the budget lasts, what is still wanted first.

        What is wanted no longer is placed too: it would hold a place among those asked for.
        """
        ready = sorted(self._loader.ready(), key=lambda key: key not in keep)
        for placed, key in enumerate(ready):
            spent = (time.perf_counter() - start) * 1e3
            if placed and spent + self._worst_place_ms > budget_ms:
                return
            layer = self._free_layer(keep)
            if layer is None:
                return
            self._place(key, layer, urgent=False)
            took = (time.perf_counter() - start) * 1e3 - spent
            self._worst_place_ms = max(took, 0.9 * self._worst_place_ms)

    def _place(self, key: Block, layer: int, *, urgent: bool) -> None:
        """Write a block, read by now or waited for, into a layer."""
        try:
            data = self._loader.take(key)
        except BaseException:
            self._free.append(layer)
            raise
        event = self.pool.write(layer, data.posts, data.error)
        self._bounds[layer] = (data.lowest, data.highest, data.error)
        self._last_used[layer] = self._tick
        self.counters.loads += 1
        self.counters.load_bytes += BLOCK_BYTES
        if urgent:
            self.pool.await_on_stream(event)
        elif not self.pool.arrived(event):
            self._arriving[key] = (layer, event)
            return
        self._admit(key, layer)

    def _admit(self, key: Block, layer: int) -> None:
        self._layer[key] = layer
        self._key[layer] = key
        self.resident.set(key, layer)

    def _admit_arrived(self) -> None:
        for key, (layer, event) in list(self._arriving.items()):
            if self.pool.arrived(event):
                del self._arriving[key]
                self._admit(key, layer)

    def _admit_awaited(self, keys: list[Block]) -> None:
        """Let the step's stream wait for blocks whose copies are under way."""
        for key in keys:
            layer, event = self._arriving.pop(key)
            self.pool.await_on_stream(event)
            self._admit(key, layer)

    def _free_layer(self, keep: set[Block]) -> int | None:
        """A layer to write to, its block evicted; None if every block is to be kept."""
        if self._free:
            return self._free.pop()
        for layer in np.argsort(self._last_used, kind="stable"):
            key = self._key[layer]
            if key is None or key in self._top or key in keep or key in self._needed:
                continue
            self._evict(key, int(layer))
            return int(layer)
        # What the last step required goes last, in an order that no disk's speed can change.
        key = max(self._needed - keep - self._top, default=None)
        if key is None:
            return None
        layer = self._layer[key]
        self._evict(key, layer)
        return layer

    def _evict(self, key: Block, layer: int) -> None:
        if key in self._dirty:
            self._write_back(key)
        if key in self._needed:
            self._needed.discard(key)
            self.required.clear(key)
        self.resident.clear(key)
        del self._layer[key]
        self._key[layer] = None
        self.counters.evictions += 1

    def _write_back(self, key: Block) -> None:
        layer = self._layer[key]
        self.ground.write(key, BlockData(self.pool.read(layer), *self._bounds[layer]))
        self._loader.run(self.ground.compact, key)
        self._dirty.discard(key)
        self.counters.written_back += 1

    def _missing_wanted(self) -> list[Block]:
        return [key for key in self._wanted if key not in self._layer and key not in self._arriving]

    def _ask_wanted(self) -> None:
        for key in self._missing_wanted()[: self._loader.slots]:
            if self._loader.waiting >= self._loader.slots:
                break
            self._loader.ask(key)

    def _publish(self) -> None:
        self.resident.publish()
        self.required.publish()


def _nothing() -> None:
    """Nothing waits."""
