"""Heights of level 0 as they are now, as exact whole numbers."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from terrasim.counts import HOLE
from terrasim.deform.target import target_of
from terrasim.grid import Block, Indices
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT
from terrasim.kernels.detail import NO_GROUND
from terrasim.terrain import Terrain

__all__ = ["NO_GROUND", "Heights", "read_window"]

Heights = npt.NDArray[np.int64]


def read_window(
    terrain: Terrain, row: int, col: int, rows: int, cols: int, detail: bool = False
) -> Heights:
    """Heights of a rectangle of posts.

    Their blocks are brought in, one of level 0 and its detail at a time, so call it between steps.

    Args:
        terrain: The terrain.
        row: First row: of level-0 posts, or of detail posts if ``detail``.
        col: First column likewise.
        rows: Number of rows.
        cols: Number of columns.
        detail: Base and detail together, on the posts of the detail grid.

    Returns:
        Counts, int64, shape ``(rows, cols)``: of 10 micrometres, or that divided by the detail's
        factor if ``detail``. ``NO_GROUND``, the smallest int64, marks a hole. Posts beyond the
        terrain repeat its edge.

    Raises:
        InputError: If ``detail`` is asked of a terrain without a detail grid.
        RunError: If a block cannot be read.
    """
    target = target_of(terrain, detail=detail)
    at_row = np.clip(np.arange(row, row + rows, dtype=np.int64), target.row, target.last_row)
    at_col = np.clip(np.arange(col, col + cols, dtype=np.int64), target.col, target.last_col)
    if not detail:
        posts = _base(terrain, at_row, at_col)
        return np.where(posts == HOLE, NO_GROUND, posts)
    ground = _interpolated(terrain, at_row, at_col)
    return np.where(ground == NO_GROUND, ground, ground + _differences(terrain, at_row, at_col))


def _base(terrain: Terrain, rows: Indices, cols: Indices) -> Heights:
    """Posts of level 0 at the outer product of two index vectors."""
    posts = np.empty((len(rows), len(cols)), dtype=np.int64)
    for block_row, block_col, at in _by_block(rows, cols):
        [layer] = terrain.cache.hold([Block(0, block_row, block_col)])
        block = terrain.cache.pool.read(layer)
        posts[np.ix_(*at)] = block[np.ix_(rows[at[0]] & (BLOCK - 1), cols[at[1]] & (BLOCK - 1))]
    return posts


def _interpolated(terrain: Terrain, rows: Indices, cols: Indices) -> Heights:
    """The base's surface at detail posts [counts / factor]: see ``kernels.detail``."""
    grid, detail = terrain.grid, terrain.detail
    (row, i), (col, j) = np.divmod(rows, detail.factor), np.divmod(cols, detail.factor)
    row, col = row + detail.row0, col + detail.col0
    # Beyond the last posts there are none; what is read instead has no weight.
    next_row = np.minimum(row + 1, grid.row + grid.rows - 1)
    next_col = np.minimum(col + 1, grid.col + grid.cols - 1)
    larger = np.maximum(i[:, None], j[None, :])
    smaller = np.minimum(i[:, None], j[None, :])
    east, north = _base(terrain, row, next_col), _base(terrain, next_row, col)
    corners = (
        (detail.factor - larger, _base(terrain, row, col)),
        (larger - smaller, np.where(j[None, :] >= i[:, None], east, north)),
        (smaller, _base(terrain, next_row, next_col)),
    )
    total = sum((weight * posts for weight, posts in corners), np.zeros_like(larger))
    for weight, posts in corners:
        total[(weight > 0) & (posts == HOLE)] = NO_GROUND
    return total


def _differences(terrain: Terrain, rows: Indices, cols: Indices) -> Heights:
    """Detail at detail posts [counts / factor]."""
    cache, detail = terrain.cache, terrain.detail
    found = np.zeros((len(rows), len(cols)), dtype=np.int64)
    there: dict[Block, set[Block]] = {}
    for block_row, block_col, at in _by_block(rows, cols):
        key = Block(-1, block_row, block_col)
        base = detail.base_of(key)
        if base not in there:
            there[base] = set(cache.details(base))
        if key in there[base]:
            cache.hold([base])
            block = cache.pool.read(cache.layer_of(key))
            inside = rows[at[0]] & (BLOCK - 1), cols[at[1]] & (BLOCK - 1)
            found[np.ix_(*at)] = block[np.ix_(*inside)]
    return found


def _by_block(rows: Indices, cols: Indices) -> Iterator[tuple[int, int, tuple[Indices, Indices]]]:
    """Row and column of each block of posts at two index vectors, and which of these it has."""
    row_blocks, col_blocks = rows >> BLOCK_SHIFT, cols >> BLOCK_SHIFT
    for row in np.unique(row_blocks).tolist():
        for col in np.unique(col_blocks).tolist():
            yield row, col, (np.flatnonzero(row_blocks == row), np.flatnonzero(col_blocks == col))
