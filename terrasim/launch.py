"""Launching a gather kernel, on the CPU split over threads.

A launch releases Python's lock, and a gather kernel writes each item from one thread, so the
halves of a launch may run side by side with the same bits as one.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import warp as wp

SMALLEST_PART = 1024
"""A part of fewer items costs more to launch than it saves."""


def launch(
    kernel: Any,
    count: int,
    *,
    shared: Sequence[Any],
    items: Sequence[Any],
    device: Any,
    threads: int = 1,
) -> None:
    """Launch a one-dimensional gather kernel.

    Args:
        kernel: Kernel whose first parameters are ``shared`` and whose last are ``items``.
        count: Number of items.
        shared: Arguments that every item may read. A flag array that all items write the same
            value to counts as shared.
        items: Arrays with one entry an item along their first axis.
        device: Warp device of all arrays.
        threads: CPU threads to split over; on CUDA there is one launch.
    """
    if count == 0:
        return
    parts = min(threads, -(-count // SMALLEST_PART)) if not device.is_cuda else 1
    if parts <= 1:
        wp.launch(kernel, dim=count, inputs=[*shared, *items], device=device)
        return
    # Loading a module is not safe from several threads.
    wp.load_module(kernel.module, device=device)
    bounds = [count * i // parts for i in range(parts + 1)]

    def part(i: int) -> None:
        start, end = bounds[i], bounds[i + 1]
        wp.launch(
            kernel,
            dim=end - start,
            inputs=[*shared, *(array[start:end] for array in items)],
            device=device,
        )

    with ThreadPoolExecutor(parts) as pool:
        list(pool.map(part, range(parts)))
