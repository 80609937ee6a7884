"""Threads that read and decode blocks beside the step."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor

import numpy as np

from terrasim.cache.ground import Loaded
from terrasim.grid import Block


class Loader:
    """A few threads, and the blocks they are reading."""

    def __init__(self, read: Callable[[Block], Loaded], workers: int) -> None:
        """Start no thread until something is asked for.

        Args:
            read: Reads one block; called from the threads.
            workers: Number of threads.
        """
        # NumPy's first arithmetic with large temporaries loads a library. In a loader thread that
        # can wait for ever for an import in another thread that wants Python's lock, as USD's does.
        _ = (np.zeros(1 << 16) + 1.0) - 1.0
        self._read = read
        self._threads = ThreadPoolExecutor(workers, thread_name_prefix="terrasim-load")
        self._loading: dict[Block, Future[Loaded]] = {}
        self._lock = threading.Lock()
        self._read_ms = 0.0
        self.slots = 2 * workers
        """How many blocks are asked for ahead: enough that no thread waits for the next step."""

    def ask(self, key: Block) -> None:
        """Begin to read a block unless that has begun."""
        if key not in self._loading:
            self._loading[key] = self._threads.submit(self._timed_read, key)

    def run(self, job: Callable[[Block], None], key: Block) -> None:
        """Do something else with a block off the step."""
        self._threads.submit(job, key)

    @property
    def waiting(self) -> int:
        """Number of blocks asked for and not taken."""
        return len(self._loading)

    @property
    def read_ms(self) -> float:
        """Time the threads have spent reading [ms]."""
        with self._lock:
            return self._read_ms

    def ready(self) -> list[Block]:
        """Blocks that have been read and wait to be taken, in the order they were asked for."""
        return [key for key, future in self._loading.items() if future.done()]

    def take(self, key: Block) -> Loaded:
        """A block's data; waits for it.

        Raises:
            Exception: Whatever reading it raised.
        """
        self.ask(key)
        return self._loading.pop(key).result()

    def drop(self, keep: set[Block]) -> None:
        """Forget what was asked for and is no longer wanted, unless it has begun.

        What was read is placed all the same: a need that passed by often comes back.
        """
        for key in [key for key in self._loading if key not in keep]:
            if self._loading[key].cancel():
                del self._loading[key]

    def forget(self) -> None:
        """Forget all that was asked for, read or not: it is out of date."""
        for future in self._loading.values():
            future.cancel()
        self._loading.clear()

    def close(self) -> None:
        """End the threads; what has not begun is dropped, edits being packed are finished."""
        self._threads.shutdown(wait=True, cancel_futures=True)

    def _timed_read(self, key: Block) -> Loaded:
        start = time.perf_counter()
        data = self._read(key)
        with self._lock:
            self._read_ms += (time.perf_counter() - start) * 1e3
        return data
