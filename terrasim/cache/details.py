"""The detail blocks in the pool: those of a level-0 block come and go with it."""

from __future__ import annotations

from collections.abc import Sequence

from terrasim.cache.detail_table import DetailTable
from terrasim.cache.table import Table
from terrasim.counts import HOLE, MAX_COUNT
from terrasim.detail.grid import DetailGrid
from terrasim.grid import Block

Range = tuple[int, int]
"""Lowest and highest of some heights."""


class Details:
    """Which detail blocks lie in which layers, and how far they reach.

    A block is *blank* if it is all zero: one about to be edited, or one whose edits were undone.
    """

    def __init__(
        self, detail: DetailGrid, tables: Sequence[Table], layers: int, detail_layers: int
    ) -> None:
        """Begin with none.

        Args:
            detail: Numbering of the detail.
            tables: Pointer tables with room for the detail's section.
            layers: Layers of the pool for blocks of levels; those for detail follow.
            detail_layers: Layers for detail.
        """
        self.grid = detail
        self.capacity = detail_layers
        """Detail blocks the pool can hold."""
        self.table = DetailTable(tables, layers, detail_layers)
        self.layer: dict[Block, int] = {}
        """Layer of each detail block in the pool."""
        self.blank: set[Block] = set()
        """Those of them that are all zero."""
        self._range: dict[Block, Range] = {}
        self._on: dict[Block, list[Block]] = {}
        self._layers = layers
        self._free = list(range(layers + detail_layers - 1, layers - 1, -1))

    @property
    def free(self) -> int:
        """Number of layers for detail with nothing in them."""
        return len(self._free)

    @property
    def bases(self) -> set[Block]:
        """Level-0 blocks that have detail in the pool."""
        return set(self._on)

    def on(self, base: Block) -> list[Block]:
        """Detail blocks in the pool that lie on a level-0 block, in order."""
        return sorted(self._on.get(base, []))

    def count(self, base: Block) -> int:
        """How many of them are not blank."""
        return sum(key not in self.blank for key in self._on.get(base, []))

    def range_of(self, key: Block) -> Range:
        """Lowest and highest difference in a detail block [counts / factor]."""
        return self._range[key]

    def set_range(self, key: Block, lowest: int, highest: int) -> None:
        """Take note of what a detail block holds now."""
        self._range[key] = (lowest, highest)
        if lowest == highest == 0:
            self.blank.add(key)
        else:
            self.blank.discard(key)

    def reserve(self, key: Block, lowest: int, highest: int) -> int:
        """A free layer for a detail block, which nobody finds before :meth:`show`."""
        layer = self._free.pop()
        self.layer[key] = layer
        self._on.setdefault(self.grid.base_of(key), []).append(key)
        self.set_range(key, lowest, highest)
        return layer

    def show(self, base: Block, base_layer: int) -> None:
        """Let kernels find the detail of a level-0 block."""
        for key in self._on.get(base, []):
            self.table.set(key, self.layer[key])
        self.table.flag(base_layer, has_detail=base in self._on)

    def remove(self, key: Block, base_layer: int) -> None:
        """Take a detail block out of the pool and the tables."""
        base = self.grid.base_of(key)
        self._on[base].remove(key)
        if not self._on[base]:
            del self._on[base]
            self.table.flag(base_layer, has_detail=False)
        self.table.clear(key)
        self._free.append(self.layer.pop(key))
        self.blank.discard(key)
        del self._range[key]

    def raised(self, base: Block, own: Range) -> Range:
        """Range of a level-0 block's surface, from its posts' range and the detail on it [counts].

        A bound over the cells whose posts are all the block's.
        """
        lowest, highest = own
        ranges = [self._range[key] for key in self._on.get(base, [])]
        if not ranges or highest == HOLE:
            return own
        lowest += min(0, *(low for low, _ in ranges)) // self.grid.factor
        highest += -(min(0, *(-high for _, high in ranges)) // self.grid.factor)
        return max(lowest, -MAX_COUNT), min(highest, MAX_COUNT)
