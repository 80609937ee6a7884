"""Where the posts are, and how blocks and levels divide them."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from terrasim.errors import InputError
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT

MAX_INDEX = 2**30
"""Post indices stay below this in magnitude, so that sums of two fit an int32."""

Indices = npt.NDArray[np.int64]


class Block(NamedTuple):
    """One block: a square of ``BLOCK`` by ``BLOCK`` posts at one level.

    It holds the level's posts ``row * BLOCK`` to ``row * BLOCK + BLOCK - 1``, and columns likewise.
    """

    level: int
    row: int
    col: int


class Span(NamedTuple):
    """A half-open rectangle of indices: rows ``row0 <= r < row1``, columns likewise."""

    row0: int
    row1: int
    col0: int
    col1: int


@dataclass(frozen=True)
class Grid:
    """Placement of the level-0 posts.

    Post ``(r, c)`` stands at ``(x + c * spacing, y + r * spacing)``; ``r`` runs from ``row`` to
    ``row + rows - 1``. Indices may be negative. Outside, the surface goes on at the height of the
    nearest edge post: every level samples that extended surface.
    """

    rows: int
    """Number of posts along y (north), at least 2."""
    cols: int
    """Number of posts along x (east), at least 2."""
    spacing: float
    """Distance between neighbouring posts [m]."""
    x: float = 0.0
    """World x of column 0 [m]."""
    y: float = 0.0
    """World y of row 0 [m]."""
    row: int = 0
    """Index of the first row of posts."""
    col: int = 0
    """Index of the first column of posts."""
    datum: float = 0.0
    """World z of count 0 [m]."""
    crs: str | None = field(default=None)
    """Coordinate reference system of x and y as WKT or ``EPSG:n``, if known."""

    def __post_init__(self) -> None:
        """Refuse what cannot be addressed."""
        if self.rows < 2 or self.cols < 2:
            raise InputError(f"a terrain needs at least 2 x 2 posts, got {self.rows} x {self.cols}")
        if not (math.isfinite(self.spacing) and self.spacing > 0.0):
            raise InputError(f"spacing must be positive and finite [m], got {self.spacing}")
        for name in ("x", "y", "datum"):
            if not math.isfinite(getattr(self, name)):
                raise InputError(f"{name} must be finite, got {getattr(self, name)}")
        far = max(
            abs(self.row), abs(self.row + self.rows), abs(self.col), abs(self.col + self.cols)
        )
        if far > MAX_INDEX:
            raise InputError(f"post indices must stay within +-{MAX_INDEX}, got {far}")

    @property
    def top(self) -> int:
        """The coarsest level: the first at which a block could hold the whole terrain."""
        cells = max(self.rows, self.cols) - 1
        return max(0, (cells // BLOCK).bit_length())

    @property
    def levels(self) -> int:
        """Number of levels, ``top + 1``."""
        return self.top + 1

    def posts(self, level: int) -> Span:
        """Indices of the level's posts whose cells cover the terrain."""
        up = (1 << level) - 1
        return Span(
            self.row >> level,
            ((self.row + self.rows - 1 + up) >> level) + 1,
            self.col >> level,
            ((self.col + self.cols - 1 + up) >> level) + 1,
        )

    def blocks(self, level: int) -> Span:
        """Indices of the level's blocks that hold its posts."""
        span = self.posts(level)
        return Span(
            span.row0 >> BLOCK_SHIFT,
            ((span.row1 - 1) >> BLOCK_SHIFT) + 1,
            span.col0 >> BLOCK_SHIFT,
            ((span.col1 - 1) >> BLOCK_SHIFT) + 1,
        )

    def clamp_rows(self, rows: Indices) -> Indices:
        """Level-0 row indices moved into the terrain."""
        return np.clip(rows, self.row, self.row + self.rows - 1)

    def clamp_cols(self, cols: Indices) -> Indices:
        """Level-0 column indices moved into the terrain."""
        return np.clip(cols, self.col, self.col + self.cols - 1)

    def post_x(self, cols: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """World x [m] of level-0 columns."""
        return self.x + np.asarray(cols, dtype=np.float64) * self.spacing

    def post_y(self, rows: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """World y [m] of level-0 rows."""
        return self.y + np.asarray(rows, dtype=np.float64) * self.spacing
