"""Waiting for blocks: they are there when this returns."""

from __future__ import annotations

from terrasim.cache.loader import Loader
from terrasim.cache.residency import Residency
from terrasim.errors import RunError
from terrasim.grid import Block


def bring(held: Residency, loader: Loader, missing: list[Block], keep: set[Block]) -> None:
    """Wait for blocks and place them, each as soon as it has been read.

    Args:
        held: Where to place them.
        loader: What reads them.
        missing: Blocks that are not there, or whose copies are under way.
        keep: Blocks that must not make room for them.

    Raises:
        RunError: If they find no room.
    """
    held.admit_awaited([key for key in missing if key in held.arriving])
    left = [key for key in missing if key not in held.layer]
    if left:
        # Copies end in the order they began, so that the rest is there before what is left.
        held.admit_awaited(list(held.arriving))
    try:
        _load(held, loader, left, keep)
    finally:
        held.publish()


def _load(held: Residency, loader: Loader, left: list[Block], keep: set[Block]) -> None:
    """Read blocks, as many at a time as the loader has slots, and place them in their order."""
    for first in range(0, len(left), loader.slots):
        part = left[first : first + loader.slots]
        for key in part:
            loader.ask(key)
        for key in part:
            layer = held.free_layer(keep)
            if layer is None:
                raise RunError("the pool is full of required blocks; raise pool_bytes")
            held.place(key, layer, keep, urgent=True)
