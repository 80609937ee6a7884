"""The posts that stamps change: those of level 0, or those of the detail grid."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.counts import COUNTS_PER_M
from terrasim.deform.anchored import Anchor
from terrasim.detail.grid import DETAIL_LEVEL, DetailGrid
from terrasim.errors import InputError
from terrasim.grid import Grid, Span
from terrasim.kernels.addressing import BLOCK_SHIFT
from terrasim.kernels.edit_row import Posts
from terrasim.terrain import Terrain


@dataclass(frozen=True)
class Target:
    """A lattice of posts, and what their counts mean."""

    level: int
    """Level of its blocks: 0, or -1 for the detail grid."""
    factor: int
    """Posts along a cell of level 0, and parts of a count; 1 for level 0 itself."""
    row: int
    """First row of posts on the terrain."""
    last_row: int
    """Last row."""
    col: int
    """First column."""
    last_col: int
    """Last column."""
    row0: int
    """Row of level 0 that its row 0 lies on."""
    col0: int
    """Column of level 0 that its column 0 lies on."""
    spacing: float
    """Distance between its posts [m]."""
    datum: float
    """World z of count 0 [m]."""

    @property
    def per_metre(self) -> float:
        """Its counts in a metre."""
        return float(COUNTS_PER_M * self.factor)

    @property
    def unit(self) -> int:
        """Parts of a count at a post of level 0 that a count at one of its posts is."""
        return self.factor**3

    @property
    def blocks(self) -> Span:
        """Its blocks that hold posts of the terrain."""
        return Span(
            self.row >> BLOCK_SHIFT,
            (self.last_row >> BLOCK_SHIFT) + 1,
            self.col >> BLOCK_SHIFT,
            (self.last_col >> BLOCK_SHIFT) + 1,
        )

    def anchor(self, anchor: Anchor) -> Anchor:
        """Its post that a post of level 0 is."""
        return (anchor[0] - self.row0) * self.factor, (anchor[1] - self.col0) * self.factor

    def counts(self, z: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """World heights [m] as its counts, not rounded."""
        return (z - self.datum) * self.per_metre

    def posts(self, *, undo: bool) -> Any:
        """The same as kernels take it; ``undo`` turns what is added around."""
        posts: Any = Posts()
        posts.detail = int(self.level < 0)
        posts.row, posts.last_row = self.row, self.last_row
        posts.col, posts.last_col = self.col, self.last_col
        posts.spacing = self.spacing
        posts.unit = -self.per_metre if undo else self.per_metre
        return posts


def target_of(terrain: Terrain, *, detail: bool) -> Target:
    """The posts of level 0, or of the detail grid.

    Raises:
        InputError: If the terrain has no detail grid.
    """
    return target_on(terrain.grid, terrain.detail, detail=detail)


def target_on(grid: Grid, fine: DetailGrid, *, detail: bool) -> Target:
    """The same before there is a terrain.

    Args:
        grid: Placement of the level-0 posts.
        fine: The detail that the terrain will have.
        detail: Whether the posts are the detail's.

    Raises:
        InputError: If there is no detail.
    """
    if detail and fine.factor == 1:
        raise InputError("this terrain has no detail grid; open it with a detail_factor above 1")
    factor, row0, col0 = (fine.factor, fine.row0, fine.col0) if detail else (1, 0, 0)
    return Target(
        level=DETAIL_LEVEL if detail else 0,
        factor=factor,
        row=(grid.row - row0) * factor,
        last_row=(grid.row + grid.rows - 1 - row0) * factor,
        col=(grid.col - col0) * factor,
        last_col=(grid.col + grid.cols - 1 - col0) * factor,
        row0=row0,
        col0=col0,
        spacing=grid.spacing / factor,
        datum=grid.datum,
    )
