"""From the tallies of a launch's rows to the blocks' new bounds, what changed and a ledger."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from terrasim.counts import HOLE
from terrasim.deform.ledger import Ledger
from terrasim.deform.placing import Records
from terrasim.deform.target import Target
from terrasim.deform.touched import Touched
from terrasim.grid import Block, Indices
from terrasim.kernels.addressing import BLOCK
from terrasim.terrain import Terrain


def ledger_of(rows: Records, unit: int) -> Ledger:
    """What happened to all rows of a launch.

    Args:
        rows: ``kernels.edit_row.RowTally``, any shape.
        unit: The ledger's unit.
    """
    names = ("removed", "added", "changed", "clamped", "holes")
    sums = [int(rows[name].sum(dtype=np.int64)) for name in names]
    return replace(Ledger(*sums), unit=unit)


def note(terrain: Terrain, keys: list[Block], rows: Records, target: Target) -> list[Touched]:
    """Tell the cache the new bounds of blocks; returns those that changed.

    Args:
        terrain: The terrain.
        keys: The blocks.
        rows: ``kernels.edit_row.RowTally``, shape ``(blocks, BLOCK)``.
        target: The posts that changed.
    """
    lowest, highest = rows["lowest"].min(axis=1), rows["highest"].max(axis=1)
    lowest = np.where(highest == HOLE, HOLE, lowest)
    rise, fall = rows["rose"].max(axis=1), rows["fell"].max(axis=1)
    changed = np.flatnonzero(rise | fall)
    for i in changed.tolist():
        error = terrain.cache.describe(keys[i])[2]
        terrain.cache.edited(keys[i], int(lowest[i]), int(highest[i]), error)
    found = _rects(rows[changed])
    return [
        _touched(keys[i], target, tuple(rect), int(rise[i]), int(fall[i]))
        for i, rect in zip(changed.tolist(), found.tolist(), strict=True)
    ]


def _touched(
    key: Block, target: Target, rect: tuple[int, int, int, int], rise: int, fall: int
) -> Touched:
    """What changed in a block, as posts and counts of level 0."""
    factor = target.factor
    row0 = max(key.row * BLOCK + rect[0], target.row)
    row1 = min(key.row * BLOCK + rect[1], target.last_row)
    col0 = max(key.col * BLOCK + rect[2], target.col)
    col1 = min(key.col * BLOCK + rect[3], target.last_col)
    return Touched(
        key,
        target.row0 + row0 // factor,
        target.row0 - (-row1 // factor),
        target.col0 + col0 // factor,
        target.col0 - (-col1 // factor),
        -(-rise // factor),
        -(-fall // factor),
    )


def _rects(rows: Records) -> Indices:
    """First and last row and first and last column of each block that changed."""
    first = rows["first"].min(axis=1)
    last = rows["last"].max(axis=1)
    hit = rows["last"] >= 0
    row0 = hit.argmax(axis=1)
    row1 = BLOCK - 1 - hit[:, ::-1].argmax(axis=1)
    return np.stack([row0, row1, first, last], axis=1)
