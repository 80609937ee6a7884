"""A source at a power of two plus one posts each way, as mirroring needs it."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import numpy.typing as npt

from terrasim.counts import HOLE, Counts
from terrasim.errors import InputError
from terrasim.grid import Indices
from terrasim.sources.array_source import ArraySource
from terrasim.sources.fractal import tiles
from terrasim.sources.source import Source

MAX_EXPONENT = 14
"""The result is an array in memory: at most 2^14 + 1 posts each way."""


def resample_power_of_two(source: Source, exponent: int | None = None) -> Source:
    """Resample a source bilinearly to ``2^k + 1`` posts along its shorter side.

    The longer side gets the power of two that fits its length best, and as the spacing stays the
    same both ways, what is too long of either side is left out, half at each end. ``synthetic``
    says so. A post between holes and ground is a hole.

    Args:
        source: Any source. One that has the posts already is returned as it is.
        exponent: ``k`` of the shorter side, 0 to 14; the nearest to the source's if not given.

    Returns:
        A source whose first post is ``(0, 0)``.

    Raises:
        InputError: If there would be more than 2^14 + 1 posts along a side.
    """
    cells = (source.grid.rows - 1, source.grid.cols - 1)
    powers = _powers(cells, exponent)
    if powers == cells:
        return source
    # Of what a side has too much for its power is left out; neither may have too little.
    step = min(cells[0] / powers[0], cells[1] / powers[1])
    rows, cols = (_places(n, power, step) for n, power in zip(cells, powers, strict=True))
    grid = source.grid
    text = (
        f"resampled from {grid.rows} x {grid.cols} posts at {grid.spacing:g} m to "
        f"{len(rows)} x {len(cols)} at {grid.spacing * step:g} m"
    )
    left = [n - step * power for n, power in zip(cells, powers, strict=True)]
    if max(left) > 1e-6:
        text += f", leaving out {left[0]:.4g} rows and {left[1]:.4g} columns"
    placed = dataclasses.replace(
        grid,
        rows=len(rows),
        cols=len(cols),
        spacing=grid.spacing * step,
        x=float(grid.post_x(grid.col)) + float(cols[0]) * grid.spacing,
        y=float(grid.post_y(grid.row)) + float(rows[0]) * grid.spacing,
        row=0,
        col=0,
    )
    posts = np.empty((len(rows), len(cols)), dtype=np.int32)
    for part_rows, part_cols in tiles(len(rows), len(cols)):
        posts[part_rows, part_cols] = _bilinear(source, rows[part_rows], cols[part_cols])
    return ArraySource(posts, placed, "; ".join(filter(None, (source.synthetic, text))))


def _powers(cells: tuple[int, int], exponent: int | None) -> tuple[int, int]:
    """Cells of the result along y and x."""
    short = min(cells)
    k = max(0, round(math.log2(short))) if exponent is None else exponent
    longer = round(math.log2(max(cells) / short))
    if k < 0 or k + longer > MAX_EXPONENT:
        raise InputError(
            f"resampling {cells[0] + 1} x {cells[1] + 1} posts to 2^{k} + 1 along the shorter "
            f"side leaves 0 to {MAX_EXPONENT} for the exponents; give a smaller one, or import a "
            "smaller part"
        )
    long = 1 << (k + longer)
    return (1 << k, long) if cells[0] == short else (long, 1 << k)


def _places(cells: int, power: int, step: float) -> npt.NDArray[np.float64]:
    """Where the result's posts lie among the source's, counted from its first."""
    places = (cells - step * power) / 2.0 + step * np.arange(power + 1)
    return np.clip(places, 0.0, cells)


def _bilinear(
    source: Source, rows: npt.NDArray[np.float64], cols: npt.NDArray[np.float64]
) -> Counts:
    """Counts between the source's posts."""
    row, v = _split(rows, source.grid.rows - 1)
    col, u = _split(cols, source.grid.cols - 1)
    row_nodes, row_at = np.unique(np.concatenate((row, row + 1)), return_inverse=True)
    col_nodes, col_at = np.unique(np.concatenate((col, col + 1)), return_inverse=True)
    posts = source.posts(0, source.grid.row + row_nodes, source.grid.col + col_nodes)
    total = np.zeros((len(row), len(col)))
    hole = np.zeros(total.shape, dtype=np.bool_)
    for rows_at, weight_y in ((row_at[: len(row)], 1.0 - v), (row_at[len(row) :], v)):
        for cols_at, weight_x in ((col_at[: len(col)], 1.0 - u), (col_at[len(col) :], u)):
            corner = posts[np.ix_(rows_at, cols_at)]
            weight = weight_y[:, None] * weight_x[None, :]
            total += weight * corner
            hole |= (corner == HOLE) & (weight > 0.0)
    return np.where(hole, HOLE, np.rint(total)).astype(np.int32)


def _split(places: npt.NDArray[np.float64], last: int) -> tuple[Indices, npt.NDArray[np.float64]]:
    """Index of the cell that holds each place, and the place in it, 0 to 1."""
    # The last post belongs to the last cell, so that its upper neighbour exists.
    cell = np.minimum(np.floor(places).astype(np.int64), last - 1)
    return cell, places - cell
