"""How far a level's surface can be from level 0's, known without reading level 0.

Both surfaces are triangulated with the same diagonal and the coarse edges are made of fine ones, so
their difference is linear on every fine triangle and is largest at a level-0 post. There the fine
surface is the function ``f`` of the source, rounded; the coarse one interpolates three corners
``v_i`` of a right triangle with legs ``H``. Below, ``w_i`` are the weights of the corners at the
post ``p``; they are at least 0 and sum to 1.
"""

from __future__ import annotations

import math
from typing import Protocol, runtime_checkable

from terrasim.grid import Block, Grid
from terrasim.kernels.addressing import BLOCK
from terrasim.sources.source import Source

_SLACK = 1e-3
"""Counts that stand for the rounding of float64; heights are below 2^31 counts."""


@runtime_checkable
class Bounded(Protocol):
    """A source that knows a block's error without reading the block."""

    def bound(self, key: Block) -> int:
        """The ``error`` [counts] that ``block(key)`` would state."""
        ...


def bound_of(source: Source, key: Block) -> int:
    """Error bound [counts] of a source's block, without reading the block where that can be."""
    return source.bound(key) if isinstance(source, Bounded) else source.block(key).error


def curvature_bound(leg: float, fxx: float, fxy: float, fyy: float) -> float:
    """Largest distance between a twice differentiable function and its interpolant.

    Taylor's formula at ``p`` gives ``sum w_i f(v_i) - f(p) = sum w_i d_i' F_i d_i / 2`` with
    ``d_i = v_i - p``, because ``sum w_i d_i = 0``. ``sum w_i dx_i^2`` is the variance of a number
    between 0 and ``H``, at most ``H^2 / 4``; likewise in y, and by Cauchy and Schwarz for the
    mixed term. So the distance is at most ``H^2 / 8 * (|fxx| + 2 |fxy| + |fyy|)``. The second
    derivatives may jump, as long as the first do not.

    Args:
        leg: ``H``, in the unit of x.
        fxx: Largest magnitude of the second derivative in x; likewise the others.
        fxy: Mixed derivative.
        fyy: Second derivative in y.
    """
    return leg * leg / 8.0 * (fxx + 2.0 * fxy + fyy)


def slope_bound(leg: float, fx: float, fy: float) -> float:
    """Largest distance between a function of bounded slopes and its interpolant.

    The distance is at most ``sum w_i (|fx| |dx_i| + |fy| |dy_i|)``, and the mean distance of a
    number between 0 and ``H`` from its mean is at most ``H / 2``: ``H / 2 * (|fx| + |fy|)``. Kinks
    do not matter, so this also holds where the terrain's edge runs through a cell.
    """
    return leg / 2.0 * (fx + fy)


def in_counts(distance: float) -> int:
    """The bound as a whole count, with the rounding of the posts of both levels (half each)."""
    return math.ceil(distance * (1.0 + 1e-9) + _SLACK) + 1


def straddles_edge(grid: Grid, key: Block) -> bool:
    """Whether the block reaches beyond an edge of the terrain that is no post of its level.

    The surface goes on level beyond the edge, so it has a kink there, inside the cells. An edge
    that is a post of the level puts the kink between cells, where it does no harm.
    """
    return _straddles(key.row, key.level, grid.row, grid.row + grid.rows - 1) or _straddles(
        key.col, key.level, grid.col, grid.col + grid.cols - 1
    )


def _straddles(index: int, level: int, first: int, last: int) -> bool:
    low = (index * BLOCK) << level
    high = ((index + 1) * BLOCK) << level
    mask = (1 << level) - 1
    return (low < first and first & mask != 0) or (high > last and last & mask != 0)
