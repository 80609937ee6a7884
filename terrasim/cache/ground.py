"""The terrain's heights as they are now: a source, and the blocks that were edited since."""

from __future__ import annotations

import threading

from terrasim.grid import Block
from terrasim.sources.source import BlockData, Source
from terrasim.store.codec import pack, unpack


class Ground:
    """Where blocks come from and where edited ones go when they leave the pool.

    An untouched block costs nothing here; an edited one is kept packed.
    """

    def __init__(self, source: Source) -> None:
        """Begin with nothing edited."""
        self.source = source
        self._edits: dict[Block, BlockData | tuple[bytes, int, int, int]] = {}
        self._lock = threading.Lock()

    def block(self, key: Block) -> BlockData:
        """The block as last written, else the source's. Safe from several threads."""
        with self._lock:
            edit = self._edits.get(key)
        if edit is None:
            return self.source.block(key)
        if isinstance(edit, BlockData):
            return edit
        blob, lowest, highest, error = edit
        return BlockData(unpack(blob), lowest, highest, error)

    def write(self, key: Block, data: BlockData) -> None:
        """Keep an edited block; :meth:`compact` packs it later, off the step."""
        with self._lock:
            self._edits[key] = data

    def compact(self, key: Block) -> None:
        """Pack an edited block."""
        with self._lock:
            data = self._edits.get(key)
        if not isinstance(data, BlockData):
            return
        packed = (pack(data.posts), data.lowest, data.highest, data.error)
        with self._lock:
            # It may have been written again meanwhile.
            if self._edits.get(key) is data:
                self._edits[key] = packed

    @property
    def edited(self) -> list[Block]:
        """Keys of the blocks that differ from the source, in order."""
        with self._lock:
            return sorted(self._edits)
