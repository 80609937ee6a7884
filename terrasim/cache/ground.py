"""The terrain's heights as they are now: a source, and the blocks that were edited since."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np

from terrasim.detail.grid import DETAIL_LEVEL, DetailGrid
from terrasim.grid import Block
from terrasim.kernels.addressing import BLOCK
from terrasim.sources.source import BlockData, Source
from terrasim.store.codec import pack, unpack


@runtime_checkable
class Detailed(Protocol):
    """A source that holds detail, too: its ``block`` answers for detail blocks that it lists."""

    @property
    def detail_factor(self) -> int:
        """Detail cells along the side of a level-0 cell; 1 if it holds none."""
        ...

    def details(self, key: Block) -> list[Block]:
        """Detail blocks within a level-0 block that are not all zero."""
        ...


@dataclass(frozen=True)
class Loaded:
    """A block, and the detail that lies on it."""

    data: BlockData
    """The block."""
    details: list[tuple[Block, BlockData]]
    """Its detail blocks that are not all zero; only a level-0 block has any."""


class Edit:
    """A block as it was once written: whoever writes it again makes another."""

    def __init__(self, data: BlockData | None) -> None:
        """Hold a block; None for a detail block that is zero again."""
        self._form: BlockData | tuple[bytes, int, int, int] | None = data

    @property
    def data(self) -> BlockData | None:
        """The block; None for a detail block that is zero again."""
        form = self._form
        return BlockData(unpack(form[0]), *form[1:]) if isinstance(form, tuple) else form

    def pack(self) -> None:
        """Take less room."""
        form = self._form
        if isinstance(form, BlockData):
            self._form = (pack(form.posts), form.lowest, form.highest, form.error)


class Ground:
    """Where blocks come from and where edited ones go when they leave the pool.

    An untouched block costs nothing here; an edited one is kept packed. Detail blocks that are all
    zero are not kept: of one that the source still has, it is kept that it is zero.
    """

    def __init__(self, source: Source, detail: DetailGrid | None = None) -> None:
        """Begin with nothing edited.

        Args:
            source: The heights before.
            detail: Numbering of the detail; None if there is none.
        """
        self.source = source
        self.detail = detail if detail is not None and detail.factor > 1 else None
        self._detailed = source if isinstance(source, Detailed) else None
        self._edits: dict[Block, Edit] = {}
        self._details: dict[Block, set[Block]] = {}
        self._lock = threading.Lock()

    def block(self, key: Block) -> BlockData:
        """The block as last written, else the source's. Safe from several threads."""
        with self._lock:
            edit = self._edits.get(key)
        if edit is not None:
            return edit.data or ZERO
        if key.level == DETAIL_LEVEL and self._detailed is None:
            return ZERO
        return self.source.block(key)

    def details(self, base: Block) -> list[Block]:
        """Detail blocks within a level-0 block that are not all zero, in order."""
        return sorted(self._details_of(base))

    def detail_count(self, base: Block) -> int:
        """How many they are."""
        return len(self._details_of(base))

    def load(self, key: Block) -> Loaded:
        """A block and its detail. Safe from several threads."""
        keys = self.details(key) if key.level == 0 else []
        return Loaded(self.block(key), [(one, self.block(one)) for one in keys])

    def write(self, key: Block, data: BlockData) -> None:
        """Keep an edited block; :meth:`compact` packs it later, off the step."""
        zero = key.level == DETAIL_LEVEL and data.lowest == data.highest == 0
        if key.level == DETAIL_LEVEL and self.detail is not None:
            known = self._details_of(self.detail.base_of(key))
            known.discard(key) if zero else known.add(key)
        with self._lock:
            self._edits[key] = Edit(None if zero else data)

    def compact(self, key: Block) -> None:
        """Pack an edited block."""
        with self._lock:
            edit = self._edits.get(key)
        if edit is not None:
            edit.pack()

    @property
    def edited(self) -> list[Block]:
        """Keys of the blocks that differ from the source, in order."""
        with self._lock:
            return sorted(self._edits)

    def kept(self) -> dict[Block, Edit]:
        """The blocks that differ from the source, as they are now."""
        with self._lock:
            return dict(self._edits)

    def forget(self, kept: Mapping[Block, Edit]) -> None:
        """Let the source answer for blocks that it holds by now, but for those written since."""
        with self._lock:
            for key, edit in kept.items():
                if self._edits.get(key) is edit:
                    del self._edits[key]

    def clear(self) -> None:
        """Forget every edit: the source is as it is to be."""
        with self._lock:
            self._edits.clear()
            self._details = {}

    def _details_of(self, base: Block) -> set[Block]:
        if self.detail is None:
            return set()
        # A thread that asks while all is forgotten must not leave its answer behind.
        details = self._details
        known = details.get(base)
        if known is None:
            source = self._detailed
            found = source.details(base) if source and source.detail_factor > 1 else []
            known = details.setdefault(base, set(found))
        return known


ZERO = BlockData(np.zeros((BLOCK, BLOCK), dtype=np.int32), 0, 0, 0)
"""A detail block that is not there."""
ZERO.posts.flags.writeable = False
