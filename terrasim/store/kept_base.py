"""Imported blocks that were needed last, because those that change now change again soon."""

from __future__ import annotations

import threading
from collections import OrderedDict

from terrasim.grid import Block
from terrasim.sources.source import BlockData
from terrasim.store.edited import Base

_KEPT = 128


class KeptBase:
    """Keeps up to 128 blocks, 32 MiB; nobody may write into them."""

    def __init__(self, base: Base) -> None:
        """Take the blocks."""
        self._base = base
        self._kept: OrderedDict[Block, BlockData] = OrderedDict()
        self._lock = threading.Lock()

    def block(self, key: Block) -> BlockData:
        """One block. Safe from several threads, which may read the same one twice."""
        with self._lock:
            kept = self._kept.get(key)
            if kept is not None:
                self._kept.move_to_end(key)
                return kept
        data = self._base.block(key)
        data.posts.flags.writeable = False
        with self._lock:
            self._kept[key] = data
            while len(self._kept) > _KEPT:
                self._kept.popitem(last=False)
        return data
