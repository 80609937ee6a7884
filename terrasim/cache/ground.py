"""The terrain's heights as they are now: a source, and the blocks that were edited since."""

from __future__ import annotations

import threading
from collections.abc import Mapping

from terrasim.grid import Block
from terrasim.sources.source import BlockData, Source
from terrasim.store.codec import pack, unpack


class Edit:
    """A block that was written, packed or not."""

    def __init__(self, data: BlockData) -> None:
        """Keep it as it is."""
        self._held: BlockData | tuple[bytes, int, int, int] = data

    @property
    def data(self) -> BlockData:
        """The block."""
        held = self._held
        if isinstance(held, BlockData):
            return held
        blob, lowest, highest, error = held
        return BlockData(unpack(blob), lowest, highest, error)

    def pack(self) -> None:
        """Make it small."""
        held = self._held
        if isinstance(held, BlockData):
            self._held = (pack(held.posts), held.lowest, held.highest, held.error)


class Ground:
    """Where blocks come from and where edited ones go when they leave the pool.

    An untouched block costs nothing here; an edited one is kept packed, until a source that is
    written to holds it too.
    """

    def __init__(self, source: Source) -> None:
        """Begin with nothing edited."""
        self.source = source
        self._edits: dict[Block, Edit] = {}
        self._lock = threading.Lock()

    def block(self, key: Block) -> BlockData:
        """The block as last written, else the source's. Safe from several threads."""
        with self._lock:
            edit = self._edits.get(key)
        return self.source.block(key) if edit is None else edit.data

    def write(self, key: Block, data: BlockData) -> None:
        """Keep an edited block; :meth:`compact` packs it later, off the step."""
        with self._lock:
            self._edits[key] = Edit(data)

    def compact(self, key: Block) -> None:
        """Pack an edited block."""
        with self._lock:
            edit = self._edits.get(key)
        if edit is not None:
            edit.pack()

    @property
    def edited(self) -> list[Block]:
        """Keys of the blocks that are kept here, in order."""
        with self._lock:
            return sorted(self._edits)

    def kept(self) -> dict[Block, Edit]:
        """All that is kept here, as it is now."""
        with self._lock:
            return dict(self._edits)

    def forget(self, written: Mapping[Block, Edit]) -> None:
        """Let go of what the source answers for by now; what was written since stays."""
        with self._lock:
            for key, edit in written.items():
                if self._edits.get(key) is edit:
                    del self._edits[key]

    def clear(self) -> None:
        """Let go of all of it."""
        with self._lock:
            self._edits.clear()
