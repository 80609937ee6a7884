"""Patches: a rectangle of whole numbers that is added to the posts."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from terrasim.counts import HOLE, MAX_COUNT, Counts
from terrasim.deform.ledger import Ledger
from terrasim.deform.propagate import Touched, propagate
from terrasim.errors import InputError
from terrasim.grid import Block, Indices
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT
from terrasim.sources.source import describe
from terrasim.terrain import Terrain


@dataclass(frozen=True)
class Patch:
    """What is added to each post of a rectangle."""

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
            raise InputError(f"a patch's counts must be 2-D and not empty, got {counts.shape}")


def check_patch(terrain: Terrain, patch: Patch) -> None:
    """Refuse a patch that does not lie on the terrain.

    Raises:
        InputError: If it does not, or is for a detail grid that the terrain has not.
    """
    if patch.detail:
        raise InputError("this terrain has no detail grid; open it with a detail factor")
    grid = terrain.grid
    for name, first, size, low, count in (
        ("rows", patch.row, patch.counts.shape[0], grid.row, grid.rows),
        ("columns", patch.col, patch.counts.shape[1], grid.col, grid.cols),
    ):
        if first < low or first + size > low + count:
            raise InputError(
                f"a patch must lie on the terrain, {name} {low} to {low + count - 1}, "
                f"got {first} to {first + size - 1}"
            )


def apply_patch(terrain: Terrain, patch: Patch) -> Ledger:
    """Add a patch to the ground, at every level.

    Args:
        terrain: The terrain.
        patch: What to add.

    Returns:
        What happened to the posts of level 0.

    Raises:
        InputError: If the patch does not lie on the terrain.
        RunError: If a block cannot be read or written.
    """
    check_patch(terrain, patch)
    grid = terrain.grid
    rows, cols = patch.counts.shape
    ledger = Ledger()
    touched = []
    for row in range(patch.row >> BLOCK_SHIFT, ((patch.row + rows - 1) >> BLOCK_SHIFT) + 1):
        for col in range(patch.col >> BLOCK_SHIFT, ((patch.col + cols - 1) >> BLOCK_SHIFT) + 1):
            key = Block(0, row, col)
            [layer] = terrain.cache.hold([key])
            posts = terrain.cache.pool.read(layer)
            at_row, in_row = _along(row, grid.row, grid.rows, patch.row, rows)
            at_col, in_col = _along(col, grid.col, grid.cols, patch.col, cols)
            inside = np.ix_(at_row, at_col)
            old = posts[inside].astype(np.int64)
            step = patch.counts[np.ix_(in_row, in_col)].astype(np.int64)
            wanted = old + step
            new = np.where(old == HOLE, HOLE, np.clip(wanted, -MAX_COUNT, MAX_COUNT))
            posts[inside] = new
            data = describe(posts, 0)
            terrain.cache.pool.write(layer, posts, 0)
            terrain.cache.edited(key, data.lowest, data.highest, 0)
            first_row, first_col = row * BLOCK, col * BLOCK
            real_row = (at_row + first_row >= grid.row) & (
                at_row + first_row < grid.row + grid.rows
            )
            real_col = (at_col + first_col >= grid.col) & (
                at_col + first_col < grid.col + grid.cols
            )
            real = real_row[:, None] & real_col
            change = new - old
            ledger += Ledger(
                int(-change[real & (change < 0)].sum()),
                int(change[real & (change > 0)].sum()),
                int(np.count_nonzero(change[real])),
                int(np.count_nonzero(real & (new != wanted) & (old != HOLE))),
                int(np.count_nonzero(real & (old == HOLE) & (step != 0))),
            )
            touched.append(
                Touched(
                    key,
                    patch.row + int(in_row.min()),
                    patch.row + int(in_row.max()),
                    patch.col + int(in_col.min()),
                    patch.col + int(in_col.max()),
                    max(int(change.max()), 0),
                    max(-int(change.min()), 0),
                )
            )
    propagate(terrain, touched)
    return ledger


def _along(block: int, low: int, count: int, first: int, size: int) -> tuple[Indices, Indices]:
    """Posts of a block that a patch changes along one axis, and what of the patch they take."""
    at = np.arange(BLOCK, dtype=np.int64)
    inside = np.clip(at + block * BLOCK, low, low + count - 1) - first
    met = (inside >= 0) & (inside < size)
    return at[met], inside[met]
