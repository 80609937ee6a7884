"""Residency: which blocks are in the pool, and the jobs that follow the needs.

Required blocks are resident before a step runs; when they exceed the pool, needs are coarsened by
rule. Wanted blocks come through a queue in the order of need, inside a time budget. Moving sideways
and changing level are the same act: needs change, jobs follow.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from typing import Any
from weakref import WeakSet

import numpy as np

from terrasim.cache.bring import bring
from terrasim.cache.coarsen import coarsen
from terrasim.cache.counters import Counters
from terrasim.cache.detail_table import DetailTable
from terrasim.cache.ground import Ground
from terrasim.cache.loader import Loader
from terrasim.cache.needs import Need, region_blocks
from terrasim.cache.queue import Queue
from terrasim.cache.residency import Bounds, Residency
from terrasim.cache.watch import Watch
from terrasim.counts import Counts
from terrasim.detail.grid import DETAIL_LEVEL
from terrasim.errors import RunError
from terrasim.grid import Block, Grid, Indices


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
        detail_layers: int = 0,
        waits: bool = True,
    ) -> None:
        """Allocate the pool and bring in the coarsest level, which stays.

        Args:
            grid: The terrain's grid.
            ground: Where blocks come from and edited ones go.
            layers: Layers of the pool for blocks of levels.
            device: Warp device.
            loaders: Threads that read blocks.
            detail_layers: Layers for detail blocks, behind those; none if the ground has no detail.
            waits: Whether a step waits for blocks it requires. If not, they are asked for before
                all that is wanted, and the step does without.
        """
        self.before_reading: Callable[[], object] = _nothing
        """Called before the ground is read: what waits to change it is done then."""
        self.watches: WeakSet[Watch] = WeakSet()
        """Those who want to know where the ground changes."""
        self._waits = waits
        self._late: list[Block] = []
        self.grid = grid
        self.ground = ground
        self.counters = Counters()
        self._loader = Loader(ground.load, loaders)
        self._held = Residency(
            grid, ground, layers, detail_layers, device, self._loader, self.counters
        )
        self.pool = self._held.pool
        self.resident = self._held.resident
        self.required = self._held.required
        self._requirement: list[Block] = []
        self._queue = Queue(self._held, self._loader, self.counters)
        top = region_blocks(grid, grid.posts(grid.top), grid.top)
        self._top = self._held.top = frozenset(top)
        self.capacity = layers - len(top)
        """Blocks the pool can hold beside the coarsest level."""
        self.detail_capacity = detail_layers
        """Detail blocks it can hold."""
        try:
            bring(self._held, self._loader, top, set(top))
        except BaseException:
            self._loader.close()
            raise
        self._show_top()

    @property
    def detail_table(self) -> DetailTable | None:
        """The detail's section of the pointer tables; None without detail."""
        return None if self._held.details is None else self._held.details.table

    def require(self, needs: Sequence[Need]) -> None:
        """Make all that a step reads resident, and the ``required`` table exactly that.

        Waiting is a stall. Needs that together exceed the pool are coarsened, the finest and
        largest first, so that what a step reads never depends on how fast a disk was.
        """
        self.before_reading()
        held = self._held
        held.drop_blank()
        details = held.detail_count if held.details is not None else None
        fitting = coarsen(needs, self.grid, self.capacity, self._top, details, self.detail_room)
        self.counters.coarsened += fitting.steps
        needed = set(fitting.blocks)
        held.tick += 1
        for key in held.needed - needed - self._top:
            self.required.clear(key)
        # Only what the table holds, in case reading the rest fails.
        held.needed &= needed
        missing = [key for key in fitting.blocks if key not in held.layer]
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
            bring(self._held, self._loader, missing, needed)
            self.counters.stall_ms += (time.perf_counter() - start) * 1e3
        held.last_used[[held.layer[key] for key in needed]] = held.tick
        for key in needed - held.needed:
            self.required.set(key, held.layer[key])
        held.needed = needed
        self._requirement = [key for key in fitting.blocks if key in needed]
        errors = [held.bounds[held.layer[key]][2] for key in fitting.raised & held.layer.keys()]
        self.counters.coarsened_error = max([self.counters.coarsened_error, *errors])
        held.publish()

    def restore(self) -> None:
        """Bring back what the last ``require`` made resident and a query or stamp displaced since.

        Without it a step would read what happened to be left, and that depends on the disk. What
        has more detail by now than fits is left to the levels above, the most detailed first.
        """
        held = self._held
        held.drop_blank()
        displaced = [key for key in self._requirement if key not in held.needed]
        if not displaced:
            return
        start = time.perf_counter()
        self._leave_excess()
        displaced = [key for key in self._requirement if key not in held.needed]
        missing = [key for key in displaced if key not in held.layer]
        self.counters.misses += len(missing)
        self.counters.stalls += bool(missing)
        bring(self._held, self._loader, missing, set(self._requirement))
        for key in displaced:
            self.required.set(key, held.layer[key])
        held.needed.update(displaced)
        held.last_used[[held.layer[key] for key in displaced]] = held.tick
        held.publish()
        self.counters.stall_ms += (time.perf_counter() - start) * 1e3

    def want(self, needs: Sequence[Need]) -> None:
        """Say what will be needed soon, in the order of need; replaces what was said before.

        What the pool cannot hold beside the required blocks is left out, the last first.
        """
        held = self._held
        wanted: dict[Block, None] = {}
        for need in needs:
            level = min(need.level, self.grid.top)
            wanted.update(dict.fromkeys(need.blocks(self.grid, level)))
        asked = dict.fromkeys([*self._late, *wanted])
        beside = [key for key in asked if key not in held.needed and key not in self._top]
        beside = beside[: max(0, self.capacity - len(held.needed - self._top))]
        if held.details is not None:
            room = self.detail_capacity - self._details_of(self._top | held.needed)
            sums = np.cumsum([held.detail_count(key) for key in beside], dtype=np.int64)
            beside = beside[: int(np.searchsorted(sums, room, side="right"))]
        self._queue.want(beside)

    def work(self, budget_ms: float) -> None:
        """Run jobs of the queue: place what has been read, ask for what is wanted next.

        A block is placed only while the worst placement seen still fits into the budget; at least
        one is placed if any is ready, so that the queue always moves.
        """
        self._queue.work(budget_ms)

    def hold(self, blocks: Iterable[Block]) -> list[int]:
        """Make blocks of levels resident now, outside any step; later calls may evict them.

        A block of level 0 comes with its detail.

        Returns:
            Their layers, in the order given.

        Raises:
            RunError: If there are more, or there is more detail on them, than the pool holds.
        """
        self.before_reading()
        keys = list(blocks)
        self._held.drop_blank()
        self._hold(keys, 0)
        return [self._held.layer[key] for key in keys]

    def hold_details(self, details: Iterable[Block], beside: Iterable[Block] = ()) -> list[int]:
        """Make detail blocks resident that are about to be edited, and the level-0 blocks of them.

        One that is not there yet begins all zero, and goes again if it stays so. Tell
        :meth:`edited` of every one that was changed before the next call.

        Args:
            details: Keys of detail blocks, level -1.
            beside: Level-0 blocks that must be there at the same time, such as neighbours whose
                posts are interpolated between.

        Returns:
            The detail blocks' layers, in the order given.

        Raises:
            RunError: If there are more than the pool holds; ``detail_pool_bytes`` is to be raised.
        """
        self.before_reading()
        keys = list(details)
        held = self._held
        held.drop_blank()
        if held.details is None:
            raise RunError("this terrain has no detail; open it with a detail_factor above 1")
        bases = dict.fromkeys(held.details.grid.base_of(key) for key in keys)
        known = {key for base in bases for key in self.details(base)}
        new = [key for key in dict.fromkeys(keys) if key not in known]
        bases.update(dict.fromkeys(beside))
        self._hold(list(bases), len(new))
        # There is room: no more is kept than was counted.
        held.make_room(len(new), set(bases))
        for key in new:
            if key not in held.details.layer:
                held.add_blank(key)
        held.publish()
        return [held.details.layer[key] for key in keys]

    def hold_detail(self, base: Block, details: Iterable[Block]) -> list[int]:
        """:meth:`hold_details` for detail blocks that lie in one level-0 block."""
        return self.hold_details(details, [base])

    @property
    def detail_room(self) -> int:
        """Detail blocks the pool can hold beside those on the coarsest level."""
        return max(0, self.detail_capacity - self._details_of(self._top))

    def details(self, base: Block) -> list[Block]:
        """Detail blocks on a level-0 block that are not all zero, resident or not, in order."""
        details = self._held.details
        if details is not None and self.is_resident(base):
            return [key for key in details.on(base) if key not in details.blank]
        return self.ground.details(base)

    def detail_count(self, base: Block) -> int:
        """How many they are."""
        return self._held.detail_count(base)

    def layer_of(self, key: Block) -> int:
        """Layer of a resident block, of a level or of detail."""
        details = self._held.details
        if details is not None and key.level == DETAIL_LEVEL:
            return details.layer[key]
        return self._held.layer[key]

    def edited(self, key: Block, lowest: int, highest: int, error: int) -> None:
        """Take note that a resident block's posts were changed in the pool.

        Args:
            key: The block. Of a detail block ``lowest`` and ``highest`` are of its differences.
            lowest: Lowest count of its own posts, without detail; ``HOLE`` if all are holes.
            highest: Highest likewise.
            error: Error bound [counts]; 0 of a detail block.
        """
        self._held.edited(key, lowest, highest, error)
        for one in self.watches:
            one.blocks.add(key)

    def describe(self, key: Block) -> Bounds:
        """Lowest and highest count and error bound of a resident block.

        Those of a level-0 block include its detail: a bound, over the cells whose four posts it
        has. Those of a detail block are its differences' [counts / factor].
        """
        return self._held.bounds[self.layer_of(key)]

    @property
    def highest(self) -> Counts:
        """Highest count of each layer's block, int32, shape ``(layers,)``; 0 in an empty layer."""
        return np.array([highest for _, highest, _ in self._held.bounds], dtype=np.int32)

    def is_resident(self, key: Block) -> bool:
        """Whether a block is in the pool."""
        details = self._held.details
        return key in self._held.layer or (details is not None and key in details.layer)

    @property
    def pending(self) -> int:
        """Wanted blocks that are not there yet."""
        return self._queue.pending

    @property
    def residents(self) -> list[Block]:
        """Keys of all resident blocks of levels, in order."""
        return sorted(self._held.layer)

    def note_used(self) -> Indices:
        """Let the layers that queries read count as recently used; returns them."""
        layers = self.pool.take_used()
        self._held.last_used[layers] = self._held.tick
        return layers

    def note_fallback(self, layers: Indices, level: int) -> None:
        """Keep the largest error bound among layers that answered for a finer level."""
        for layer in layers:
            key = self._held.key[layer]
            if key is not None and key.level > level:
                error = self._held.bounds[layer][2]
                self.counters.fallback_error = max(self.counters.fallback_error, error)

    def flush(self) -> None:
        """Write every edited block back to the ground; they stay resident."""
        for key in sorted(self._held.dirty):
            self._held.write_back(key)
        self.counters.read_ms = self._loader.read_ms

    @property
    def dirty(self) -> int:
        """Number of resident blocks that the ground does not know yet."""
        return len(self._held.dirty)

    def discard(self) -> None:
        """Forget every resident block, edits too, and bring in the coarsest level anew."""
        self._loader.forget()
        self._held.clear()
        for one in self.watches:
            one.everything = True
        self._requirement.clear()
        self._late.clear()
        self._queue.want([])
        bring(self._held, self._loader, sorted(self._top), set(self._top))
        self._show_top()

    def close(self) -> None:
        """End the loader's threads."""
        self._loader.close()
        self.counters.read_ms = self._loader.read_ms

    def _show_top(self) -> None:
        for key in sorted(self._top):
            self.required.set(key, self._held.layer[key])
        self._held.publish()

    def _hold(self, keys: list[Block], new: int) -> None:
        """Make blocks resident, with room beside them for so many new detail blocks."""
        held = dict.fromkeys(keys)
        beside = len(held.keys() - self._top)
        if beside > self.capacity:
            raise RunError(
                f"{beside} blocks are needed at once but the pool holds {self.capacity}; "
                "raise pool_bytes"
            )
        fine = new + self._details_of(self._top | held.keys())
        if fine > self.detail_capacity:
            raise RunError(
                f"{fine} detail blocks are needed at once but the pool holds "
                f"{self.detail_capacity}; raise detail_pool_bytes"
            )
        self._held.tick += 1
        bring(
            self._held,
            self._loader,
            [key for key in held if key not in self._held.layer],
            set(held),
        )
        self._held.last_used[[self._held.layer[key] for key in keys]] = self._held.tick
        self._held.publish()

    def _details_of(self, keys: Iterable[Block]) -> int:
        """Detail blocks on blocks that are not all zero."""
        if self._held.details is None:
            return 0
        return sum(self._held.detail_count(key) for key in keys)

    def _leave_excess(self) -> None:
        """Take blocks out of what is required until the rest's detail fits."""
        held = self._held
        excess = self._details_of(self._top.union(self._requirement)) - self.detail_capacity
        if excess <= 0:
            return
        beside = [key for key in self._requirement if key not in self._top]
        for key in sorted(beside, key=held.detail_count, reverse=True):
            if excess <= 0:
                return
            excess -= held.detail_count(key)
            self._requirement.remove(key)
            if key in held.needed:
                held.needed.discard(key)
                self.required.clear(key)
            self.counters.coarsened += 1


def _nothing() -> None:
    """Nothing waits."""
