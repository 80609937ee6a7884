"""Patches: a rectangle of whole numbers that is added to the posts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from terrasim.counts import MAX_COUNT, Counts
from terrasim.deform.ledger import Ledger
from terrasim.deform.placing import Records, blank
from terrasim.deform.propagate import Touched, propagate
from terrasim.deform.room import Room
from terrasim.deform.tallies import ledger_of, note
from terrasim.deform.target import Target, target_of
from terrasim.errors import InputError
from terrasim.grid import Block
from terrasim.kernels import patch as kernels
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT
from terrasim.kernels.edit_row import RowTally
from terrasim.launch import launch
from terrasim.terrain import Terrain

MOST = 256
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
        places: tuple[tuple[str, object], ...] = (("row", self.row), ("col", self.col))
        for name, value in places:
            if not isinstance(value, int | np.integer) or isinstance(value, bool):
                raise InputError(f"a patch's {name} must be a whole number, got {value!r}")
        flag: object = self.detail
        if not isinstance(flag, bool):
            raise InputError(f"a patch's detail must be true or false, got {flag!r}")
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
        RunError: If a block cannot be read or written, or the pool has no room for the detail;
            nothing is changed then.
    """
    target = _target(terrain, patch)
    if patch.detail:
        # A terrain without detail never compiles its kernel.
        from terrasim.deform.patch_detail import add_detail

        ledger, touched = add_detail(terrain, patch, target)
    else:
        ledger, touched = _add_base(terrain, patch, target)
    propagate(terrain, touched)
    return ledger


def blocks_of(patch: Patch, level: int) -> list[Block]:
    """Blocks that a patch changes."""
    rows, cols = patch.counts.shape
    return [
        Block(level, row, col)
        for row in range(patch.row >> BLOCK_SHIFT, ((patch.row + rows - 1) >> BLOCK_SHIFT) + 1)
        for col in range(patch.col >> BLOCK_SHIFT, ((patch.col + cols - 1) >> BLOCK_SHIFT) + 1)
    ]


def add(
    terrain: Terrain,
    kernel: Any,
    terms: Sequence[Any],
    patch: Patch,
    keys: list[Block],
    layers: list[int],
) -> Records:
    """Add a patch to resident blocks.

    Args:
        terrain: The terrain.
        kernel: ``kernels.patch.add_patch`` or one like it.
        terms: Its parameters before the patch.
        patch: The patch.
        keys: The blocks.
        layers: The layers they are in.

    Returns:
        ``kernels.edit_row.RowTally``, shape ``(blocks, BLOCK)``.
    """
    device, rows = terrain.device, len(keys) * BLOCK
    work = blank(kernels.PatchBlock, len(keys))
    work["layer"] = layers
    work["row"], work["col"] = [key.row for key in keys], [key.col for key in keys]
    blocks: Any = wp.array(work, dtype=kernels.PatchBlock, device=device, copy=False)
    given = np.ascontiguousarray(patch.counts)
    counts: Any = wp.array(given, dtype=wp.int32, device=device, copy=False)
    place: Any = wp.array(np.arange(rows, dtype=np.int32), device=device, copy=False)
    tally: Any = wp.empty(rows, dtype=RowTally, device=device)
    launch(
        kernel,
        rows,
        shared=[*terms, patch.row, patch.col, counts, blocks],
        items=[place, tally],
        device=device,
        threads=terrain.threads,
    )
    found: Records = tally.numpy().reshape(len(keys), BLOCK)
    return found


def _add_base(terrain: Terrain, patch: Patch, target: Target) -> tuple[Ledger, list[Touched]]:
    ledger = Ledger()
    touched: list[Touched] = []
    terms = [terrain.pool, target.posts(undo=False)]
    for group in Room.of(terrain).groups(blocks_of(patch, 0), MOST):
        layers = terrain.cache.hold(group)
        rows = add(terrain, kernels.add_patch, terms, patch, group, layers)
        ledger += ledger_of(rows, target.unit)
        touched += note(terrain, group, rows, target)
    return ledger, touched


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
