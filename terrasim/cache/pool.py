"""The pool: a fixed number of layers on the device, each holding one resident block."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from terrasim.counts import Counts
from terrasim.detail.grid import DetailGrid
from terrasim.errors import InputError
from terrasim.grid import Grid, Indices
from terrasim.kernels.addressing import BLOCK

BLOCK_POSTS = BLOCK * BLOCK
BLOCK_BYTES = 4 * BLOCK_POSTS
"""Bytes of one layer's posts."""
MAX_LAYERS = 2**31 // BLOCK_POSTS - 1
"""Places in the pool are int32, so it holds less than 8 GiB."""
LEAST_DETAIL = 4
"""Fewest detail blocks a pool may hold: those that meet at a corner."""
STAGING_SLOTS = 8
"""Pinned buffers through which blocks travel to a CUDA device."""


def layers_for(grid: Grid, pool_bytes: int) -> int:
    """Number of layers a pool of this size holds, never more than the terrain has blocks.

    Raises:
        InputError: If the pool cannot hold the coarsest level and the four blocks that meet at a
            corner, or passes what an int32 can address.
    """
    counts = [
        (span.row1 - span.row0) * (span.col1 - span.col0)
        for span in (grid.blocks(level) for level in range(grid.levels))
    ]
    total = sum(counts)
    layers = min(pool_bytes // BLOCK_BYTES, total)
    if layers > MAX_LAYERS:
        raise InputError(
            f"pool of {pool_bytes} bytes is too large: at most {MAX_LAYERS * BLOCK_BYTES} bytes "
            "can be addressed; ask for less"
        )
    least = min(total, max(8, counts[grid.top] + 4))
    if layers < least:
        raise InputError(
            f"pool of {pool_bytes} bytes is too small: it must hold {least} blocks, "
            f"{least * BLOCK_BYTES} bytes"
        )
    return layers


def detail_layers_for(detail: DetailGrid, detail_pool_bytes: int, layers: int) -> int:
    """Number of layers for detail blocks, never more than there can be; none for a factor of 1.

    Args:
        detail: Numbering of the detail.
        detail_pool_bytes: Bytes of the detail's posts.
        layers: Layers of the pool for blocks of levels.

    Raises:
        InputError: If the bytes are none, hold too few blocks, or pass what an int32 can address.
    """
    if detail.factor == 1:
        return 0
    span = detail.blocks
    total = (span.row1 - span.row0) * (span.col1 - span.col0)
    found = min(detail_pool_bytes // BLOCK_BYTES, total)
    if found > MAX_LAYERS - layers:
        raise InputError(
            f"detail_pool_bytes must be at most {(MAX_LAYERS - layers) * BLOCK_BYTES}, what can "
            f"be addressed beside pool_bytes, got {detail_pool_bytes}"
        )
    least = min(total, LEAST_DETAIL)
    if found < least:
        raise InputError(
            f"detail_pool_bytes must be at least {least * BLOCK_BYTES}, the bytes of {least} "
            f"blocks, got {detail_pool_bytes}"
        )
    return int(found)


class Pool:
    """Device arrays of the resident blocks and the copies that fill them."""

    def __init__(self, layers: int, device: Any) -> None:
        """Allocate the layers; their posts are undefined until written."""
        self.layers = layers
        self.device = device
        self.posts = wp.empty(layers * BLOCK_POSTS, dtype=wp.int32, device=device)
        """Counts, int32, shape ``(layers * BLOCK * BLOCK,)``: row-major within a layer."""
        self.error = wp.zeros(layers, dtype=wp.int32, device=device)
        """Error bound of each layer's block [counts], int32, shape ``(layers,)``."""
        self.used = wp.zeros(layers, dtype=wp.uint8, device=device)
        """1 where a query read the layer, uint8, shape ``(layers,)``."""
        self._cuda = bool(device.is_cuda)
        self._view = None if self._cuda else self.posts.numpy()
        self._error_host = np.zeros(layers, np.int32) if self._cuda else self.error.numpy()
        if self._cuda:
            self._copies = wp.Stream(device)
            self._staging = [
                wp.empty(BLOCK_POSTS + 1, dtype=wp.int32, device="cpu", pinned=True)
                for _ in range(STAGING_SLOTS)
            ]
            self._staged: list[Any] = [None] * STAGING_SLOTS
            self._slot = 0

    def write(self, layer: int, posts: Counts, error: int) -> Any:
        """Fill a layer.

        On CUDA the copy goes through pinned memory on a stream of its own, which waits for the
        kernels that may still read the layer's last block.

        Returns:
            None when the layer is ready; else an event of the copy stream.
        """
        self._error_host[layer] = error
        if self._view is not None:
            start = layer * BLOCK_POSTS
            self._view[start : start + BLOCK_POSTS] = posts.reshape(-1)
            return None
        return self._send(layer, posts, error)

    def arrived(self, event: Any) -> bool:
        """Whether a copy has ended."""
        return event is None or bool(event.is_complete)

    def await_on_stream(self, event: Any) -> None:
        """Make the device's current stream wait for a copy; the host does not."""
        if event is not None:
            wp.get_stream(self.device).wait_event(event)

    def read(self, layer: int) -> Counts:
        """A copy of a layer's posts, shape ``(BLOCK, BLOCK)``."""
        start, end = layer * BLOCK_POSTS, (layer + 1) * BLOCK_POSTS
        posts = self.posts[start:end].numpy() if self._view is None else self._view[start:end]
        return np.array(posts, dtype=np.int32).reshape(BLOCK, BLOCK)

    def set_error(self, layer: int, error: int) -> None:
        """Change the bound of a layer whose posts were edited in place."""
        self._error_host[layer] = error
        if self._cuda:
            self.error[layer : layer + 1].fill_(error)

    def take_used(self) -> Indices:
        """Layers that queries read since the last call, as an index array."""
        used: Indices = np.flatnonzero(self.used.numpy())
        if used.size:
            self.used.zero_()
        return used

    def _send(self, layer: int, posts: Counts, error: int) -> Any:
        slot = self._slot
        self._slot = (slot + 1) % STAGING_SLOTS
        if self._staged[slot] is not None:
            wp.synchronize_event(self._staged[slot])
        staging = self._staging[slot]
        view = staging.numpy()
        view[:BLOCK_POSTS] = posts.reshape(-1)
        view[BLOCK_POSTS] = error
        self._copies.wait_event(wp.get_stream(self.device).record_event())
        wp.copy(self.posts, staging, layer * BLOCK_POSTS, 0, BLOCK_POSTS, stream=self._copies)
        wp.copy(self.error, staging, layer, BLOCK_POSTS, 1, stream=self._copies)
        self._staged[slot] = self._copies.record_event()
        return self._staged[slot]
