"""Patches of the detail grid: one block of level 0 after another, each with its neighbours."""

from __future__ import annotations

from typing import TYPE_CHECKING

from terrasim.deform.ledger import Ledger
from terrasim.deform.tallies import ledger_of, note
from terrasim.deform.target import Target
from terrasim.deform.touched import Touched
from terrasim.errors import RunError
from terrasim.grid import Block
from terrasim.kernels.patch_detail import add_detail_patch
from terrasim.terrain import Terrain

if TYPE_CHECKING:
    from terrasim.deform.patch import Patch

Shares = dict[Block, list[Block]]
"""Detail blocks that a patch changes, by the block of level 0 they lie on."""


def add_detail(terrain: Terrain, patch: Patch, target: Target) -> tuple[Ledger, list[Touched]]:
    """Add a patch to the detail.

    Raises:
        RunError: If the pool has no room for the detail; nothing is changed then.
    """
    from terrasim.deform.patch import add, blocks_of

    shares: Shares = {}
    for key in blocks_of(patch, -1):
        shares.setdefault(terrain.detail.base_of(key), []).append(key)
    _require_room(terrain, shares)
    ledger = Ledger(unit=target.unit)
    touched: list[Touched] = []
    for base, keys in shares.items():
        # The ground under the last posts lies between this block and the next ones.
        layers = terrain.cache.hold_details(keys, _around(terrain, base))
        terms = [terrain.pool, terrain.resident, terrain.lattice]
        rows = add(terrain, add_detail_patch, terms, patch, keys, layers)
        ledger += ledger_of(rows, target.unit)
        touched += note(terrain, keys, rows, target)
    return ledger, touched


def _around(terrain: Terrain, base: Block) -> list[Block]:
    """A block of level 0 and the next ones along x, y and both."""
    span = terrain.grid.blocks(0)
    return [
        Block(0, row, col)
        for row in range(base.row, min(base.row + 2, span.row1))
        for col in range(base.col, min(base.col + 2, span.col1))
    ]


def _require_room(terrain: Terrain, shares: Shares) -> None:
    """Refuse a patch after which blocks would have more detail than the pool holds at once."""
    cache, span = terrain.cache, terrain.grid.blocks(0)
    always = (
        [Block(0, r, c) for r in range(span.row0, span.row1) for c in range(span.col0, span.col1)]
        if terrain.grid.top == 0
        else []
    )
    for base in shares:
        held = dict.fromkeys([*_around(terrain, base), *always])
        count = sum(len({*cache.details(key), *shares.get(key, [])}) for key in held)
        if count > cache.detail_capacity:
            raise RunError(
                f"{count} detail blocks are needed at once but the pool holds "
                f"{cache.detail_capacity}; raise detail_pool_bytes"
            )
