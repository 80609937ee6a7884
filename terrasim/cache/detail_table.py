"""The detail's section at the end of pointer tables: flags, and a hash of detail blocks.

``terrasim.kernels.detail`` describes and reads it. Every table has the same section, so that
whoever finds a level-0 block in a table finds its detail, too.
"""

from __future__ import annotations

from collections.abc import Sequence

from terrasim.cache.table import Table
from terrasim.grid import Block
from terrasim.kernels.addressing import ABSENT
from terrasim.kernels.detail import COL_FACTOR, HASH_SHIFT, ROW_FACTOR, SLOT

_WORD = 2**32 - 1


def slots_for(detail_layers: int) -> int:
    """Slots of the hash: a power of two, at least twice what it ever holds."""
    return 1 << (2 * detail_layers - 1).bit_length() if detail_layers else 0


def section_entries(layers: int, detail_layers: int) -> int:
    """Length of the section; 0 without layers for detail."""
    return layers + SLOT * slots_for(detail_layers) if detail_layers else 0


class DetailTable:
    """The section, written from the host into all tables alike."""

    def __init__(self, tables: Sequence[Table], layers: int, detail_layers: int) -> None:
        """Begin with no block that has detail.

        Args:
            tables: Tables made with room for :func:`section_entries`.
            layers: Layers of the pool for blocks of levels.
            detail_layers: Layers for blocks of detail.
        """
        self._tables = tables
        self.mask = slots_for(detail_layers) - 1
        """Slots less 1; -1 without any."""
        self.start = tables[0].section
        """Where the section begins in every table."""
        self._hash = self.start + layers
        for layer in range(layers if detail_layers else 0):
            self.flag(layer, has_detail=False)

    def flag(self, layer: int, *, has_detail: bool) -> None:
        """Say whether the level-0 block of a layer has detail."""
        self._put(self.start + layer, int(has_detail))

    def get(self, key: Block) -> int:
        """Layer of a detail block, or ``ABSENT``."""
        return self._entry(self._slot(key), 2)

    def set(self, key: Block, layer: int) -> None:
        """Point a detail block to a layer."""
        self._fill(self._slot(key), (key.row, key.col, layer))

    def clear(self, key: Block) -> None:
        """Take a detail block out; those that were put off by it move up to where it was."""
        free = self._slot(key)
        if self._entry(free, 2) == ABSENT:
            return
        slot = (free + 1) & self.mask
        while self._entry(slot, 2) != ABSENT:
            row, col, layer = (self._entry(slot, i) for i in range(SLOT))
            home = self._home(row, col)
            # It may move only to a slot that its own search passes.
            if (slot - home) & self.mask >= (slot - free) & self.mask:
                self._fill(free, (row, col, layer))
                free = slot
            slot = (slot + 1) & self.mask
        self._fill(free, (0, 0, ABSENT))

    def _home(self, row: int, col: int) -> int:
        mixed = (row * ROW_FACTOR + col * COL_FACTOR) & _WORD
        return (mixed ^ (mixed >> HASH_SHIFT)) & self.mask

    def _slot(self, key: Block) -> int:
        """The slot of a block, or the empty one where it would stand."""
        slot = self._home(key.row, key.col)
        while self._entry(slot, 2) != ABSENT:
            if self._entry(slot, 0) == key.row and self._entry(slot, 1) == key.col:
                break
            slot = (slot + 1) & self.mask
        return slot

    def _entry(self, slot: int, field: int) -> int:
        return self._tables[0].at(self._hash + slot * SLOT + field)

    def _fill(self, slot: int, values: tuple[int, int, int]) -> None:
        for field, value in enumerate(values):
            self._put(self._hash + slot * SLOT + field, value)

    def _put(self, entry: int, value: int) -> None:
        for table in self._tables:
            table.put(entry, value)
