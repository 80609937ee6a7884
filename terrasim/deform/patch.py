"""Patches: a rectangle of whole numbers that is added to the posts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from terrasim.counts import MAX_COUNT, Counts
from terrasim.deform.ledger import Ledger
from terrasim.deform.placing import blank
from terrasim.deform.propagate import Touched, propagate
from terrasim.deform.tallies import ledger_of, note
from terrasim.deform.target import Target, target_of
from terrasim.errors import InputError
from terrasim.grid import Block
from terrasim.kernels import patch as kernels
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT
from terrasim.kernels.edit_row import RowTally
from terrasim.launch import launch
from terrasim.terrain import Terrain

GROUP = 256
"""Most blocks changed in one launch."""


@dataclass(frozen=True)
class Patch:
    """What is added to each post of a rectangle. Its negative undoes it, if nothing was clamped."""

    row: int
    """First row: of level-0 posts, or of detail posts if ``detail``."""
    col: int
    """First column likewise."""
    counts: Counts
    """Counts to add, int32, shape ``(rows, cols)``: of 10 micrometres, or that divided by the
    detail's factor if ``detail``."""
    detail: bool = False
    """Whether the posts are the detail grid's."""

    def __post_init__(self) -> None:
        """Refuse what is no rectangle of counts."""
        counts = np.asarray(self.counts)
        if counts.dtype != np.int32:
            raise InputError(f"a patch's counts must be int32, got {counts.dtype}")
        if counts.ndim != 2 or counts.size == 0:
            raise InputError(
                f"a patch's counts must be 2-D and not empty, got shape {counts.shape}"
            )
        if counts.min() < -MAX_COUNT:
            raise InputError(
                f"a patch's counts must lie within +-{MAX_COUNT}, got {counts.min()}: "
                "the smallest int32 has no negative"
            )


def check_patch(terrain: Terrain, patch: Patch) -> None:
    """Refuse a patch that does not lie on the terrain, before anything is allocated or changed.

    Raises:
        InputError: If it does not, or is for a detail grid that the terrain has not.
    """
    _target(terrain, patch)


def apply_patch(terrain: Terrain, patch: Patch) -> Ledger:
    """Add a patch to the ground and carry the change up through the levels.

    Args:
        terrain: The terrain.
        patch: What to add. Holes stay holes, and a height stops at the end of the range; both are
            counted.

    Returns:
        What happened to the posts.

    Raises:
        InputError: If the patch does not lie on the terrain.
        RunError: If a block cannot be read or written.
    """
    target = _target(terrain, patch)
    rows, cols = patch.counts.shape
    keys = [
        Block(target.level, row, col)
        for row in range(patch.row >> BLOCK_SHIFT, ((patch.row + rows - 1) >> BLOCK_SHIFT) + 1)
        for col in range(patch.col >> BLOCK_SHIFT, ((patch.col + cols - 1) >> BLOCK_SHIFT) + 1)
    ]
    counts: Any = wp.array(
        np.ascontiguousarray(patch.counts), dtype=wp.int32, device=terrain.device, copy=False
    )
    most = GROUP
    if target.level < terrain.grid.top:
        most = max(1, min(most, terrain.cache.capacity))
    ledger = Ledger()
    touched: list[Touched] = []
    for first in range(0, len(keys), most):
        group = keys[first : first + most]
        tally = _add(terrain, target, patch, counts, group)
        ledger += ledger_of(tally, target.unit)
        touched += note(terrain, group, tally, target)
    propagate(terrain, touched)
    return ledger


def _target(terrain: Terrain, patch: Patch) -> Target:
    """The posts that a patch changes."""
    target = target_of(terrain, detail=patch.detail)
    for name, first, size, low, high in (
        ("rows", patch.row, patch.counts.shape[0], target.row, target.last_row),
        ("columns", patch.col, patch.counts.shape[1], target.col, target.last_col),
    ):
        if first < low or first + size - 1 > high:
            raise InputError(
                f"a patch must lie on the terrain, {name} {low} to {high}, "
                f"got {first} to {first + size - 1}"
            )
    return target


def _add(terrain: Terrain, target: Target, patch: Patch, counts: Any, keys: list[Block]) -> Any:
    """Change a group of blocks; ``kernels.edit_row.RowTally``, shape ``(blocks, BLOCK)``."""
    device, rows = terrain.device, len(keys) * BLOCK
    work = blank(kernels.PatchBlock, len(keys))
    work["layer"] = terrain.cache.hold(keys)
    work["row"], work["col"] = [key.row for key in keys], [key.col for key in keys]
    blocks: Any = wp.array(work, dtype=kernels.PatchBlock, device=device, copy=False)
    place: Any = wp.array(np.arange(rows, dtype=np.int32), device=device, copy=False)
    tally: Any = wp.empty(rows, dtype=RowTally, device=device)
    launch(
        kernels.add_patch,
        rows,
        shared=[terrain.pool, target.posts(undo=False), patch.row, patch.col, counts, blocks],
        items=[place, tally],
        device=device,
        threads=terrain.threads,
    )
    return tally.numpy().reshape(len(keys), BLOCK)
