"""Which blocks are in the pool: placing and evicting them, and what is known of each.

A level-0 block is there with all its detail or not at all.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from terrasim.cache.counters import Counters
from terrasim.cache.detail_table import section_entries
from terrasim.cache.details import Details
from terrasim.cache.ground import ZERO, Ground, Loaded
from terrasim.cache.loader import Loader
from terrasim.cache.pool import BLOCK_BYTES, Pool
from terrasim.cache.table import Table
from terrasim.detail.grid import DETAIL_LEVEL
from terrasim.errors import RunError
from terrasim.grid import Block, Grid
from terrasim.sources.source import BlockData, describe

Bounds = tuple[int, int, int]
"""Lowest and highest count and error bound of a block."""


class Residency:
    """The pool's blocks, and the tables that point to them."""

    def __init__(
        self,
        grid: Grid,
        ground: Ground,
        layers: int,
        detail_layers: int,
        device: Any,
        loader: Loader,
        counters: Counters,
    ) -> None:
        """Allocate the pool with nothing in it.

        Args:
            grid: The terrain's grid.
            ground: Where blocks come from and edited ones go.
            layers: Layers of the pool for blocks of levels.
            detail_layers: Layers behind them for detail.
            device: Warp device.
            loader: Reads blocks.
            counters: Where to count.
        """
        self.pool = Pool(layers + detail_layers, device)
        section = section_entries(layers, detail_layers)
        self.resident = Table(grid, layers, device, section)
        self.required = Table(grid, layers, device, section)
        self.details: Details | None = None
        if ground.detail is not None:
            tables = (self.resident, self.required)
            self.details = Details(ground.detail, tables, layers, detail_layers)
        self.layer: dict[Block, int] = {}
        """Layer of each block of a level that is there."""
        self.key: list[Block | None] = [None] * layers
        """Block of each layer."""
        self.bounds: list[Bounds] = [(0, 0, 0)] * (layers + detail_layers)
        """What is known of each layer's block."""
        self.dirty: set[Block] = set()
        """Blocks that the ground does not know yet."""
        self.needed: set[Block] = set()
        """What ``required`` holds beside the top; it goes last."""
        self.top: frozenset[Block] = frozenset()
        """Blocks that stay."""
        self.arriving: dict[Block, tuple[int, Any]] = {}
        """Blocks whose copies are under way: layer and event."""
        self.tick = 0
        self.last_used = np.zeros(layers, dtype=np.int64)
        """Tick at which each layer was last used, int64, shape ``(layers,)``."""
        self._own: dict[Block, tuple[int, int]] = {}
        self._layers = layers
        self._free = list(range(layers - 1, -1, -1))
        self._ground = ground
        self._loader = loader
        self._counters = counters

    def free_layer(self, keep: set[Block]) -> int | None:
        """A layer to write to, its block evicted; None if every block is to be kept."""
        if not self._free:
            victim = self._victim(keep)
            if victim is None:
                return None
            self.evict(victim)
        return self._free.pop()

    def place(self, key: Block, layer: int, keep: set[Block], *, urgent: bool) -> None:
        """Write a block, read by now or waited for, into a layer.

        Raises:
            RunError: If it is urgent and its detail finds no room.
        """
        try:
            loaded: Loaded = self._loader.take(key)
            if not self.make_room(len(loaded.details), keep):
                if urgent:
                    raise RunError("the pool is full of required detail; raise detail_pool_bytes")
                self._free.append(layer)
                return
        except BaseException:
            self._free.append(layer)
            raise
        data = loaded.data
        for one, fine in loaded.details:
            self._reserve(one, fine)
        event = self.pool.write(layer, data.posts, data.error)
        self.bounds[layer] = (data.lowest, data.highest, data.error)
        if loaded.details:
            # What was stored includes the detail as it was then.
            own = describe(data.posts, data.error)
            self._own[key] = (own.lowest, own.highest)
            self._bound(key, layer, data.error)
        self.last_used[layer] = self.tick
        self._counters.loads += 1
        self._counters.load_bytes += BLOCK_BYTES * (1 + len(loaded.details))
        if urgent:
            self.pool.await_on_stream(event)
        elif not self.pool.arrived(event):
            self.arriving[key] = (layer, event)
            return
        self._admit(key, layer)

    def admit_arrived(self) -> None:
        """Let kernels find blocks whose copies have ended."""
        for key, (layer, event) in list(self.arriving.items()):
            if self.pool.arrived(event):
                del self.arriving[key]
                self._admit(key, layer)

    def admit_awaited(self, keys: list[Block]) -> None:
        """Let the step's stream wait for blocks whose copies are under way."""
        for key in keys:
            layer, event = self.arriving.pop(key)
            self.pool.await_on_stream(event)
            self._admit(key, layer)

    def make_room(self, count: int, keep: set[Block]) -> bool:
        """Free so many layers for detail by evicting blocks that have any; whether that went."""
        if count == 0 or self.details is None:
            return True
        while self.details.free < count:
            victim = self._victim(keep, detailed=True)
            if victim is None:
                return False
            self.evict(victim)
        return True

    def add_blank(self, key: Block) -> None:
        """Put a detail block that is all zero on its level-0 block; there must be room."""
        details = self._require_details()
        self.pool.await_on_stream(self._reserve(key, ZERO))
        base = details.grid.base_of(key)
        details.show(base, self.layer[base])

    def drop_blank(self) -> None:
        """Take the detail blocks that are all zero out of the pool."""
        if self.details is not None:
            for key in sorted(self.details.blank):
                base = self.details.grid.base_of(key)
                if base in self.layer:
                    self._remove_detail(key, self.layer[base])

    def evict(self, key: Block) -> None:
        """Take a block of a level out, its detail with it; what was edited is written back."""
        layer = self.layer[key]
        if key in self.dirty:
            self.write_back(key)
        if self.details is not None:
            for one in self.details.on(key):
                self._remove_detail(one, layer)
            self._own.pop(key, None)
        if key in self.needed:
            self.needed.discard(key)
            self.required.clear(key)
        self.resident.clear(key)
        del self.layer[key]
        self.key[layer] = None
        self._free.append(layer)
        self._counters.evictions += 1

    def edited(self, key: Block, lowest: int, highest: int, error: int) -> None:
        """Take note of what a block holds now that its posts were changed in the pool."""
        self.dirty.add(key)
        if key.level != DETAIL_LEVEL:
            layer = self.layer[key]
            self.pool.set_error(layer, error)
            self.bounds[layer] = (lowest, highest, error)
            if self.details is not None and key.level == 0:
                self._own[key] = (lowest, highest)
                self._bound(key, layer, error)
            return
        details = self._require_details()
        details.set_range(key, lowest, highest)
        self.bounds[details.layer[key]] = (lowest, highest, 0)
        base = details.grid.base_of(key)
        layer = self.layer[base]
        before = self.bounds[layer]
        self._bound(base, layer, before[2])
        if self.bounds[layer] != before:
            self.dirty.add(base)

    def write_back(self, key: Block) -> None:
        """Hand an edited block to the ground; it stays."""
        fine = self.details is not None and key.level == DETAIL_LEVEL
        layer = self._require_details().layer[key] if fine else self.layer[key]
        self._ground.write(key, BlockData(self.pool.read(layer), *self.bounds[layer]))
        self._loader.run(self._ground.compact, key)
        self.dirty.discard(key)
        self._counters.written_back += 1

    def detail_count(self, key: Block) -> int:
        """Detail blocks on a block that are not all zero, resident or not."""
        if self.details is None or key.level != 0:
            return 0
        if key in self.layer or key in self.arriving:
            return self.details.count(key)
        return self._ground.detail_count(key)

    def clear(self) -> None:
        """Forget every block, edits too."""
        for key, layer in self.layer.items():
            self.resident.clear(key)
            self.required.clear(key)
            self.key[layer] = None
        self.dirty.clear()
        self.needed.clear()
        if self.details is not None:
            for key in list(self.details.layer):
                base = self.details.grid.base_of(key)
                held = self.arriving[base][0] if base in self.arriving else self.layer[base]
                self.details.remove(key, held)
        self.arriving.clear()
        self.layer.clear()
        self._own.clear()
        self._free = list(range(self._layers - 1, -1, -1))
        self.bounds = [(0, 0, 0)] * len(self.bounds)

    def publish(self) -> None:
        """Send the tables' changes to the device."""
        self.resident.publish()
        self.required.publish()

    def _victim(self, keep: set[Block], *, detailed: bool = False) -> Block | None:
        """The block to go next, if ``detailed`` one that has detail; None if all are to be kept."""
        bases = self.details.bases if self.details is not None and detailed else None
        for layer in np.argsort(self.last_used, kind="stable"):
            key = self.key[int(layer)]
            if key is None or key in self.top or key in keep or key in self.needed:
                continue
            if bases is None or key in bases:
                return key
        # What the last step required goes last, in an order that no disk's speed can change.
        spare = self.needed - keep - self.top
        last: Block | None = max(spare if bases is None else spare & bases, default=None)
        return last

    def _reserve(self, key: Block, data: BlockData) -> Any:
        """Write a detail block into a layer of its own; returns the copy's event."""
        layer = self._require_details().reserve(key, data.lowest, data.highest)
        self.bounds[layer] = (data.lowest, data.highest, 0)
        return self.pool.write(layer, data.posts, 0)

    def _remove_detail(self, key: Block, base_layer: int) -> None:
        if key in self.dirty:
            self.write_back(key)
        self._require_details().remove(key, base_layer)

    def _bound(self, base: Block, layer: int, error: int) -> None:
        """Describe a level-0 block together with its detail."""
        own = self._own.setdefault(base, self.bounds[layer][:2])
        self.bounds[layer] = (*self._require_details().raised(base, own), error)

    def _admit(self, key: Block, layer: int) -> None:
        self.layer[key] = layer
        self.key[layer] = key
        self.resident.set(key, layer)
        if self.details is not None and self.details.on(key):
            self.details.show(key, layer)

    def _require_details(self) -> Details:
        if self.details is None:
            raise RunError("this terrain has no detail; open it with a detail_factor above 1")
        return self.details
