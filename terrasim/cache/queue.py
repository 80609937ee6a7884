"""The queue of blocks that will be needed soon: read beside the step, placed within a budget."""

from __future__ import annotations

import time
from collections.abc import Sequence

import numpy as np

from terrasim.cache.counters import Counters
from terrasim.cache.loader import Loader
from terrasim.cache.residency import Residency
from terrasim.grid import Block


class Queue:
    """What is wanted, and the jobs that bring it."""

    def __init__(self, held: Residency, loader: Loader, counters: Counters) -> None:
        """Begin with nothing wanted."""
        self._held = held
        self._loader = loader
        self._counters = counters
        self._wanted: list[Block] = []
        self._worst_place_ms = 0.0

    def want(self, keys: Sequence[Block]) -> None:
        """Replace what is wanted, in the order of need; the pool holds it beside what is needed."""
        held = self._held
        self._wanted = list(keys)
        there = [held.layer[key] for key in keys if key in held.layer]
        held.last_used[there] = np.maximum(held.last_used[there], held.tick)

    @property
    def pending(self) -> int:
        """Wanted blocks that are not there yet."""
        return len(self._missing())

    def work(self, budget_ms: float) -> None:
        """Run jobs of the queue: place what has been read, ask for what is wanted next.

        A block is placed only while the worst placement seen still fits into the budget; at least
        one is placed if any is ready, so that the queue always moves.
        """
        start = time.perf_counter()
        self._held.tick += 1
        keep = self._held.needed.union(self._wanted)
        self._loader.drop(keep)
        self._held.admit_arrived()
        try:
            self._place_ready(keep, start, budget_ms)
        finally:
            self._held.publish()
        self._ask_wanted()
        spent = (time.perf_counter() - start) * 1e3
        self._counters.queue_ms += spent
        self._counters.queue_over += spent > budget_ms
        self._counters.read_ms = self._loader.read_ms

    def _place_ready(self, keep: set[Block], start: float, budget_ms: float) -> None:
        """Place what has been read while the budget lasts, what is still wanted first.

        What is wanted no longer is placed too: it would hold a place among those asked for.
        """
        ready = sorted(self._loader.ready(), key=lambda key: key not in keep)
        for placed, key in enumerate(ready):
            spent = (time.perf_counter() - start) * 1e3
            if placed and spent + self._worst_place_ms > budget_ms:
                return
            layer = self._held.free_layer(keep)
            if layer is None:
                return
            self._held.place(key, layer, keep, urgent=False)
            took = (time.perf_counter() - start) * 1e3 - spent
            self._worst_place_ms = max(took, 0.9 * self._worst_place_ms)

    def _missing(self) -> list[Block]:
        held = self._held
        return [key for key in self._wanted if key not in held.layer and key not in held.arriving]

    def _ask_wanted(self) -> None:
        for key in self._missing()[: self._loader.slots]:
            if self._loader.waiting >= self._loader.slots:
                break
            self._loader.ask(key)
