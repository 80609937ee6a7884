"""From the tallies of a launch's rows to the blocks' new bounds, what changed and a ledger."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from terrasim.counts import HOLE
from terrasim.deform.ledger import Ledger
from terrasim.deform.placing import Records
from terrasim.deform.propagate import Touched
from terrasim.deform.target import Target
from terrasim.grid import Block, Indices
from terrasim.kernels.addressing import BLOCK
from terrasim.terrain import Terrain


def ledger_of(rows: Records, unit: int) -> Ledger:
    """What happened to all rows of a launch.

    Args:
        rows: ``kernels.stamps.RowTally``, any shape.
        unit: The ledger's unit.
    """
    names = ("removed", "added", "changed", "clamped", "holes")
    sums = [int(rows[name].sum(dtype=np.int64)) for name in names]
    return replace(Ledger(*sums), unit=unit)


def note_base(terrain: Terrain, keys: list[Block], rows: Records, target: Target) -> list[Touched]:
    """Tell the cache the new bounds of blocks of level 0; returns those that changed.

    Args:
        terrain: The terrain.
        keys: The blocks.
        rows: ``kernels.stamps.RowTally``, shape ``(blocks, BLOCK)``.
        target: Level 0.
    """
    lowest, highest = rows["lowest"].min(axis=1), rows["highest"].max(axis=1)
    lowest = np.where(highest == HOLE, HOLE, lowest)
    changed = rects(rows)
    rise, fall = rows["rose"].max(axis=1), rows["fell"].max(axis=1)
    touched = []
    for i in np.flatnonzero(rise | fall).tolist():
        key = keys[i]
        terrain.cache.edited(key, int(lowest[i]), int(highest[i]), terrain.cache.describe(key)[2])
        row0, row1, col0, col1 = changed[i].tolist()
        touched.append(
            Touched(
                key,
                max(key.row * BLOCK + row0, target.row),
                min(key.row * BLOCK + row1, target.last_row),
                max(key.col * BLOCK + col0, target.col),
                min(key.col * BLOCK + col1, target.last_col),
                int(rise[i]),
                int(fall[i]),
            )
        )
    return touched


def rects(rows: Records) -> Indices:
    """First and last row and first and last column of each block that changed."""
    first = rows["first"].min(axis=1)
    last = rows["last"].max(axis=1)
    hit = rows["last"] >= 0
    row0 = hit.argmax(axis=1)
    row1 = BLOCK - 1 - hit[:, ::-1].argmax(axis=1)
    return np.stack([row0, row1, first, last], axis=1)
