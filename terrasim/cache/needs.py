"""What actors need of the ground: sets of blocks at a level."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from terrasim.errors import InputError
from terrasim.grid import Block, Grid, Indices, Span
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT


class Need(Protocol):
    """Something that needs ground at a level."""

    @property
    def level(self) -> int:
        """The level it needs."""
        ...

    def blocks(self, grid: Grid, level: int) -> list[Block]:
        """Blocks of a level that cover the same ground, nearest first."""
        ...


@dataclass(frozen=True)
class Disc:
    """All posts within a radius of a place."""

    row: float
    """Place along y [level-0 posts]."""
    col: float
    """Place along x [level-0 posts]."""
    radius: float
    """Radius [posts of its level]."""
    level: int = 0
    """Level that is needed there."""

    def __post_init__(self) -> None:
        """Refuse a disc that is nowhere."""
        for name in ("row", "col"):
            if not math.isfinite(getattr(self, name)):
                raise InputError(f"{name} must be finite, got {getattr(self, name)}")
        if not (math.isfinite(self.radius) and self.radius >= 0.0):
            raise InputError(f"radius must be finite and not negative, got {self.radius}")
        if self.level < 0:
            raise InputError(f"level must not be negative, got {self.level}")

    def blocks(self, grid: Grid, level: int) -> list[Block]:
        """Blocks that the disc's cells read, nearest first."""
        scale = float(1 << level)
        # What lies off the terrain reads its nearest edge, and so no further from the moved centre.
        row = min(max(self.row, grid.row), grid.row + grid.rows - 1) / scale
        col = min(max(self.col, grid.col), grid.col + grid.cols - 1) / scale
        radius = self.radius * float(1 << self.level) / scale
        span = grid.blocks(level)
        # Plain numbers: NumPy's calls give Python's lock away, and a loader thread keeps it.
        cols = _reach(col, radius, span.col0, span.col1)
        found = [
            (math.hypot(away_row, away_col), Block(level, block_row, block_col))
            for block_row, away_row in _reach(row, radius, span.row0, span.row1)
            for block_col, away_col in cols
        ]
        return [key for distance, key in sorted(found) if distance <= radius]


@dataclass(frozen=True)
class Boxes:
    """Rectangles of level-0 cells, one for each of many small actors."""

    row0: Indices
    """First row of cells, int64, shape ``(count,)``."""
    row1: Indices
    """Last row of cells, inclusive."""
    col0: Indices
    """First column of cells."""
    col1: Indices
    """Last column of cells, inclusive."""
    level: int = 0
    """Level that is needed there."""

    def blocks(self, grid: Grid, level: int) -> list[Block]:
        """Blocks that the boxes' cells read, by row and column."""
        if len(self.row0) == 0:
            return []
        span = grid.blocks(level)
        first_row, last_row = _block_range(self.row0, self.row1, level, span.row0, span.row1)
        first_col, last_col = _block_range(self.col0, self.col1, level, span.col0, span.col1)
        corners = (
            np.unique(np.stack([first_row, last_row, first_col, last_col], axis=1), axis=0)
            if len(first_row) < 64
            else _unique_ranges(first_row, last_row, first_col, last_col)
        )
        found = {
            Block(level, row, col)
            for r0, r1, c0, c1 in corners.tolist()
            for row in range(r0, r1 + 1)
            for col in range(c0, c1 + 1)
        }
        return sorted(found)


def region_blocks(grid: Grid, region: Span, level: int) -> list[Block]:
    """Blocks that hold a half-open rectangle of a level's posts, within the terrain."""
    span = grid.blocks(level)
    row0, row1 = max(region.row0 >> BLOCK_SHIFT, span.row0), (region.row1 - 1) >> BLOCK_SHIFT
    col0, col1 = max(region.col0 >> BLOCK_SHIFT, span.col0), (region.col1 - 1) >> BLOCK_SHIFT
    return [
        Block(level, row, col)
        for row in range(row0, min(row1, span.row1 - 1) + 1)
        for col in range(col0, min(col1, span.col1 - 1) + 1)
    ]


def _reach(centre: float, radius: float, first: int, end: int) -> list[tuple[int, float]]:
    """Blocks along one axis that lie within a radius, each with its distance [posts].

    A cell reads one post beyond its own, so a block serves cells from one before it.
    """
    low = math.floor(centre - radius) >> BLOCK_SHIFT
    high = (math.floor(centre + radius) + 1) >> BLOCK_SHIFT
    return [
        (block, max(block * BLOCK - 1.0 - centre, centre - (block + 1) * BLOCK, 0.0))
        for block in range(max(low, first), min(high, end - 1) + 1)
    ]


def _block_range(
    low: Indices, high: Indices, level: int, first: int, end: int
) -> tuple[Indices, Indices]:
    start = np.clip((low >> level) >> BLOCK_SHIFT, first, end - 1)
    stop = np.clip(((high >> level) + 1) >> BLOCK_SHIFT, first, end - 1)
    return start, stop


def _unique_ranges(row0: Indices, row1: Indices, col0: Indices, col1: Indices) -> Indices:
    """Distinct rows of four columns; packed into one integer each where the ranges allow it."""
    base_row, base_col = int(row0.min()), int(col0.min())
    rows, cols = row0 - base_row, col0 - base_col
    high, wide = row1 - row0, col1 - col0
    if max(int(high.max()), int(wide.max())) > 255:
        return np.unique(np.stack([row0, row1, col0, col1], axis=1), axis=0)
    code = np.unique((rows << 40) | (cols << 16) | (high << 8) | wide)
    row = (code >> 40) + base_row
    col = ((code >> 16) & 0xFFFFFF) + base_col
    return np.stack([row, row + ((code >> 8) & 255), col, col + (code & 255)], axis=1)
