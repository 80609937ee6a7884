"""Pointer tables: from a block to its layer in the pool, on host and device alike."""

from __future__ import annotations

from typing import Any

import numpy as np
import warp as wp

from terrasim.errors import InputError
from terrasim.grid import Block, Grid
from terrasim.kernels.addressing import ABSENT, HEADER, PAGE, PAGE_SHIFT
from terrasim.kernels.transfer import scatter

_PAGE_ENTRIES = PAGE * PAGE
_MOST_ENTRIES = 2**31 - 1


def _directory_shape(grid: Grid, level: int) -> tuple[int, int, int, int]:
    """First page row, first page column, page rows and page columns of a level."""
    span = grid.blocks(level)
    row0, col0 = span.row0 >> PAGE_SHIFT, span.col0 >> PAGE_SHIFT
    rows = ((span.row1 - 1) >> PAGE_SHIFT) - row0 + 1
    cols = ((span.col1 - 1) >> PAGE_SHIFT) - col0 + 1
    return row0, col0, rows, cols


def table_entries(grid: Grid, layers: int) -> int:
    """Length of a table: header, directories and as many pages as ``layers`` blocks can touch.

    Raises:
        InputError: If an int32 cannot address them.
    """
    pages = 0
    for level in range(grid.levels):
        _, _, rows, cols = _directory_shape(grid, level)
        pages += rows * cols
    entries = HEADER * grid.levels + pages + (1 + min(layers, pages)) * _PAGE_ENTRIES
    if entries > _MOST_ENTRIES:
        raise InputError(
            f"a terrain of {grid.rows} x {grid.cols} posts needs a pointer table of {entries} "
            f"entries: at most {_MOST_ENTRIES} can be addressed; take fewer posts"
        )
    return entries


class Table:
    """One pointer table in device memory, written from the host.

    Changes gather on the host and reach the device with :meth:`publish`; on the CPU the two are one
    memory. A page exists while a block of it is present.
    """

    def __init__(self, grid: Grid, layers: int, device: Any, section: int = 0) -> None:
        """Lay the table out with nothing present.

        Args:
            grid: The terrain's grid.
            layers: Most blocks that are ever present at once.
            device: Warp device.
            section: Entries behind the table's own, for the detail.

        Raises:
            InputError: If an int32 cannot address them.
        """
        self.section = table_entries(grid, layers)
        """Where the entries behind the table's own begin."""
        if self.section + section > _MOST_ENTRIES:
            raise InputError(
                f"a pointer table of {self.section + section} entries is needed: at most "
                f"{_MOST_ENTRIES} can be addressed; take a smaller detail_pool_bytes"
            )
        host = np.full(self.section + section, ABSENT, dtype=np.int32)
        start = HEADER * grid.levels
        for level in range(grid.levels):
            row0, col0, rows, cols = _directory_shape(grid, level)
            host[HEADER * level : HEADER * (level + 1)] = (start, cols, row0, col0)
            start += rows * cols
        host[HEADER * grid.levels : start] = start  # the first page stays empty and serves all
        first = start + _PAGE_ENTRIES
        self._empty_page = start
        self._free = list(range(self.section - _PAGE_ENTRIES, first - 1, -_PAGE_ENTRIES))
        self._population: dict[int, int] = {}
        self._changed: dict[int, int] = {}
        self._cuda = bool(device.is_cuda)
        self.entries: Any = wp.array(host, dtype=wp.int32, device=device)
        """The table on the device, int32, shape ``(table_entries + section,)``."""
        # On the CPU this is the device's memory itself.
        self._host = host if self._cuda else self.entries.numpy()

    def set(self, key: Block, layer: int) -> None:
        """Point a block to a layer."""
        directory = self._directory_entry(key)
        page = int(self._host[directory])
        if page == self._empty_page:
            page = self._free.pop()
            self._population[page] = 0
            self._write(directory, page)
        entry = self._entry(page, key)
        if self._host[entry] == ABSENT:
            self._population[page] += 1
        self._write(entry, layer)

    def clear(self, key: Block) -> None:
        """Mark a block as absent; a page without blocks is given back."""
        directory = self._directory_entry(key)
        page = int(self._host[directory])
        entry = self._entry(page, key)
        if page == self._empty_page or self._host[entry] == ABSENT:
            return
        self._write(entry, ABSENT)
        self._population[page] -= 1
        if self._population[page] == 0:
            self._write(directory, self._empty_page)
            del self._population[page]
            self._free.append(page)

    def get(self, key: Block) -> int:
        """Layer of a block, or ``ABSENT``."""
        return int(self._host[self._entry(int(self._host[self._directory_entry(key)]), key)])

    def at(self, entry: int) -> int:
        """An entry as the host last wrote it."""
        return int(self._host[entry])

    def put(self, entry: int, value: int) -> None:
        """Write an entry behind the table's own."""
        self._write(entry, value)

    def publish(self) -> None:
        """Send what changed to the device, on its current stream."""
        if not self._cuda or not self._changed:
            return
        device = self.entries.device
        index: Any = wp.array(np.fromiter(self._changed.keys(), dtype=np.int32), device=device)
        value: Any = wp.array(np.fromiter(self._changed.values(), dtype=np.int32), device=device)
        wp.launch(
            scatter,
            dim=len(self._changed),
            inputs=[index, value],
            outputs=[self.entries],
            device=device,
        )
        self._changed.clear()

    def _directory_entry(self, key: Block) -> int:
        start, cols, row0, col0 = self._host[HEADER * key.level : HEADER * (key.level + 1)]
        row = (key.row >> PAGE_SHIFT) - int(row0)
        col = (key.col >> PAGE_SHIFT) - int(col0)
        return int(start) + row * int(cols) + col

    @staticmethod
    def _entry(page: int, key: Block) -> int:
        return page + ((key.row & (PAGE - 1)) << PAGE_SHIFT) + (key.col & (PAGE - 1))

    def _write(self, entry: int, value: int) -> None:
        self._host[entry] = value
        if self._cuda:
            self._changed[entry] = value
