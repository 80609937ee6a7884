"""What Warp's own allocator counts, to hold a plan's bytes against."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import warp as wp


class DeviceMemory:
    """Bytes allocated through Warp since counting began, over all devices."""

    def __init__(self, core: Any) -> None:
        """Wrap Warp's native library."""
        self._core = core

    @property
    def held(self) -> int:
        """Bytes that are allocated now."""
        return int(self._core.wp_alloc_tracker_get_current_bytes())

    @property
    def peak(self) -> int:
        """The most that ever were."""
        return int(self._core.wp_alloc_tracker_get_peak_bytes())


@contextmanager
def counted_memory() -> Iterator[DeviceMemory]:
    """Count allocations; what was allocated before is not seen."""
    with wp.ScopedMemoryTracker("run", print=False) as tracker:
        # What was freed since somebody counted last would still be in the sum.
        tracker.clear()
        # Warp prints these figures but has no public function that returns them.
        from warp._src import context

        runtime: Any = context.runtime
        yield DeviceMemory(runtime.core)
