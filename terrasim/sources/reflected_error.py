"""Errors of levels that are seen reflected, where cells are split by the other diagonal."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from terrasim.counts import Counts
from terrasim.grid import Indices


def half_cross(posts: Counts) -> int:
    """Half the largest cross difference of a cell [counts], rounded up."""
    rise = np.diff(posts.astype(np.int64), axis=1)
    return -(-int(np.abs(rise[1:] - rise[:-1]).max(initial=0)) // 2)


def cell_range(posts: Counts, up: int) -> int:
    """Largest range of heights in a cell of the level ``up`` above [counts].

    Args:
        posts: The posts of a level from corner to corner; a power of two cells each way if ``up``
            is not 0.
        up: Number of levels up; cells larger than the posts are as large as these.
    """
    low = high = posts.astype(np.int64)
    for _ in range(2):
        step = min(1 << up, len(low) - 1)
        cells = (-1, step, low.shape[1])
        low = np.minimum(low[:-1].reshape(cells).min(axis=1), low[step::step]).T
        high = np.maximum(high[:-1].reshape(cells).max(axis=1), high[step::step]).T
    return int((high - low).max())


def distance(posts: Counts, up: int) -> int:
    """Distance [counts] of posts from the level ``up`` above, triangulated either way."""
    heights = posts.astype(np.float64)
    row0, row1, v = _corners(heights.shape[0] - 1, up)
    col0, col1, u = _corners(heights.shape[1] - 1, up)
    v, u = v[:, None], u[None, :]
    straight = _triangulated(heights, row0, row1, col0, col1, v, u)
    reflected = _triangulated(heights, row0, row1, col1, col0, v, 1.0 - u)
    worst = float(max(np.abs(straight - heights).max(), np.abs(reflected - heights).max()))
    # What is compared has at most 32 binary places, so that a whole number is met exactly.
    return math.ceil(worst)


def _corners(cells: int, up: int) -> tuple[Indices, Indices, npt.NDArray[np.float64]]:
    """The coarse posts on both sides of each post, and its distance from the first in cells."""
    step = 1 << up
    index = np.arange(cells + 1)
    if step > cells:
        # Every coarse post folds to the source's first.
        first = np.zeros_like(index)
        return first, first, np.zeros(cells + 1)
    first = np.minimum(index >> up, (cells >> up) - 1) << up
    return first, first + step, (index - first) / float(step)


def _triangulated(
    heights: npt.NDArray[np.float64],
    row0: Indices,
    row1: Indices,
    col0: Indices,
    col1: Indices,
    v: npt.NDArray[np.float64],
    u: npt.NDArray[np.float64],
) -> npt.NDArray[np.float64]:
    """Heights of the triangles with the diagonal from corner 00 to corner 11."""
    h00 = heights[np.ix_(row0, col0)]
    h10 = heights[np.ix_(row0, col1)] - h00
    h01 = heights[np.ix_(row1, col0)] - h00
    h11 = heights[np.ix_(row1, col1)] - h00
    return (
        h00 + np.maximum(u - v, 0.0) * h10 + np.maximum(v - u, 0.0) * h01 + np.minimum(u, v) * h11
    )
