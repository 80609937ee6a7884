"""A source of heights that is simply an array in memory."""

from __future__ import annotations

from typing import Self

import numpy as np
import numpy.typing as npt

from terrasim.counts import HOLE, Counts, to_counts
from terrasim.errors import InputError
from terrasim.grid import Block, Grid, Indices
from terrasim.kernels.addressing import BLOCK
from terrasim.sources.source import BlockData, read_block

_STRIP_POSTS = 1 << 20
"""Level-0 posts compared at once when a block's error is measured."""


class ArraySource:
    """Counts in memory as a source: small terrains, tests, results of another source."""

    def __init__(self, posts: npt.ArrayLike, grid: Grid, synthetic: str = "") -> None:
        """Take the posts; they are not copied if they are int32 already, so leave them alone.

        Args:
            posts: Counts, shape ``(grid.rows, grid.cols)``, south to north, ``HOLE`` where there
                is no ground.
            grid: Placement of the posts.
            synthetic: What part of the heights is invented; empty if none is.

        Raises:
            InputError: If the posts are no int32 or have not the grid's shape.
        """
        array = np.asarray(posts)
        if array.dtype != np.int32:
            raise InputError(
                f"posts must be int32 counts, got {array.dtype}; metres go through from_metres"
            )
        if array.shape != (grid.rows, grid.cols):
            raise InputError(
                f"posts have shape {array.shape}, the grid expects {(grid.rows, grid.cols)}"
            )
        self._posts: Counts = np.ascontiguousarray(array).view()
        self._posts.flags.writeable = False
        self._grid = grid
        self._synthetic = synthetic
        self._errors: dict[Block, int] = {}
        self.provenance: dict[str, object] = {"driver": "array"}
        """Where the heights come from, ready for JSON."""

    @classmethod
    def from_metres(
        cls,
        heights: npt.ArrayLike,
        *,
        spacing: float,
        x: float = 0.0,
        y: float = 0.0,
        datum: float = 0.0,
        crs: str | None = None,
        synthetic: str = "",
    ) -> Self:
        """A source of heights in metres, rounded to counts.

        Args:
            heights: Heights [m], shape ``(rows, cols)``, south to north; NaN marks a hole.
            spacing: Distance between neighbouring posts [m].
            x: World x of column 0 [m].
            y: World y of row 0 [m].
            datum: World z of count 0 [m].
            crs: Coordinate reference system of x and y, if known.
            synthetic: What part of the heights is invented; empty if none is.

        Raises:
            InputError: If the heights are not 2-D, infinite or too far from the datum.
        """
        metres = np.asarray(heights, dtype=np.float64)
        if metres.ndim != 2:
            raise InputError(f"heights must be 2-D, (rows, cols), got shape {metres.shape}")
        rows, cols = metres.shape
        grid = Grid(rows, cols, spacing=spacing, x=x, y=y, datum=datum, crs=crs)
        return cls(to_counts(metres, datum), grid, synthetic)

    @property
    def grid(self) -> Grid:
        """Placement of the level-0 posts."""
        return self._grid

    @property
    def synthetic(self) -> str:
        """What part of the heights is invented, in a few words; empty if none is."""
        return self._synthetic

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        """Heights of the level's posts at the outer product of two index vectors.

        See :meth:`terrasim.sources.source.Source.posts`.
        """
        row = self._grid.clamp_rows(np.asarray(rows, dtype=np.int64) << level) - self._grid.row
        col = self._grid.clamp_cols(np.asarray(cols, dtype=np.int64) << level) - self._grid.col
        return self._posts[row[:, None], col[None, :]]

    def block(self, key: Block) -> BlockData:
        """One block, ready for the pool."""
        return read_block(self, key, self.bound(key))

    def bound(self, key: Block) -> int:
        """The block's error [counts]: exact, rounded up to a count, measured once."""
        error = self._errors.get(key)
        if error is None:
            error = self._errors[key] = _block_error(self, key)
        return error

    def read_rows(self, row: int, count: int) -> Counts:
        """Rows ``row`` to ``row + count - 1`` counted from the southern edge."""
        return self._posts[row : row + count]


def _block_error(source: ArraySource, key: Block) -> int:
    """Largest distance [counts] between the level's surface and level 0's over a block's cells.

    Both are triangulations and the finer refines the coarser, so it is reached at a level-0 post.
    Cells wholly outside the terrain repeat the first one outside.
    """
    if key.level == 0:
        return 0
    span = source.grid.posts(key.level)
    row0, row1 = (
        max(key.row * BLOCK, span.row0 - 1),
        min((key.row + 1) * BLOCK, span.row1),
    )
    col0, col1 = (
        max(key.col * BLOCK, span.col0 - 1),
        min((key.col + 1) * BLOCK, span.col1),
    )
    cells = max(1, _STRIP_POSTS >> (2 * key.level))
    wide = min(cells, col1 - col0)
    high = max(1, cells // wide)
    return max(
        _cells_error(source, key.level, row, col, min(high, row1 - row), min(wide, col1 - col))
        for row in range(row0, row1, high)
        for col in range(col0, col1, wide)
    )


def _cells_error(source: ArraySource, level: int, row: int, col: int, rows: int, cols: int) -> int:
    """The same over a rectangle of cells, all of whose level-0 posts fit in memory."""
    step = 1 << level
    fine_rows = (np.arange(rows)[:, None] + row) * step + np.arange(step + 1)
    fine_cols = (np.arange(cols)[:, None] + col) * step + np.arange(step + 1)
    fine = source.posts(0, fine_rows.ravel(), fine_cols.ravel()).astype(np.int64)
    # [cell row, row in cell, cell column, column in cell]
    fine = fine.reshape(rows, step + 1, cols, step + 1)
    h00, h01 = fine[:, :1, :, :1], fine[:, -1:, :, :1]
    h10, h11 = fine[:, :1, :, -1:], fine[:, -1:, :, -1:]
    v = np.arange(step + 1)[None, :, None, None]
    u = np.arange(step + 1)[None, None, None, :]
    below = u * (h10 - h00) + v * (h11 - h10)
    above = v * (h01 - h00) + u * (h11 - h01)
    scaled = np.abs((fine - h00) * step - np.where(u >= v, below, above))
    if (fine == HOLE).any():
        diagonal = (h00 != HOLE) & (h11 != HOLE)
        ground = diagonal & np.where(
            u > v,
            h10 != HOLE,
            np.where(u < v, h01 != HOLE, (h10 != HOLE) | (h01 != HOLE)),
        )
        scaled = np.where(ground & (fine != HOLE), scaled, 0)
    return -(-int(scaled.max()) // step)
