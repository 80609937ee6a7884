"""Smooth heights between a source's posts: a bicubic through them, held near the triangles.

Along a line of posts ``p0 p1 p2 p3`` the Catmull-Rom cubic between ``p1`` and ``p2`` is their
chord less a bulge, which the second differences ``D1 = p0 - 2 p1 + p2`` and ``D2`` give::

    c(t) = p1 + t (p2 - p1) - t (1 - t) / 2 * ((1 - t) D1 + t D2)

It is taken along x and then along y. Three rules hold it to the posts: second differences are
clipped at a limit ``L``, and are 0 at the terrain's edge (where the cubic then runs out straight);
a cell's cross difference ``X = h11 - h10 - h01 + h00`` beyond ``L`` bends along the diagonal
instead; and a hole counts as the mean of its neighbours that are none, so that the ground beside
it is smooth too. So the heights are continuous and everywhere within ``L / 2`` of the triangles:
``L / 8`` from each direction's bulge and ``L / 4`` because ``|bilinear - triangles| <= |X| / 4``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from terrasim.counts import HOLE
from terrasim.grid import Indices
from terrasim.sources.error_bound import curvature_bound
from terrasim.sources.source import Source

Floats = npt.NDArray[np.float64]
Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Line:
    """Where fine posts stand among a source's rows (or columns)."""

    nodes: Indices
    """The source's rows two before to three after every fine post's cell, ascending."""
    at: Indices
    """Place in ``nodes`` of the row at or before each fine post."""
    t: Floats
    """Fine post's distance from that row in cells, 0 to below 1."""
    inner: Mask
    """Which of the nodes lie inside the terrain, not on its edge or beyond."""


@dataclass(frozen=True)
class Bends:
    """The largest bends of a source's posts over some cells and their neighbours [counts]."""

    along_x: float
    """Largest second difference along x."""
    along_y: float
    """Largest second difference along y."""
    cross: float
    """Largest cross difference of a cell."""
    holes: bool
    """Whether any of the posts is a hole."""


def line(fine: Indices, shift: int, first: int, last: int) -> Line:
    """Place fine rows (or columns) among a source's, ``2^shift`` to one.

    Args:
        fine: Fine level-0 indices.
        shift: Binary logarithm of the fine posts to one of the source.
        first: The source's first index.
        last: The source's last index.
    """
    cells = fine >> shift
    nodes = np.unique(cells[:, None] + np.arange(-2, 4))
    t = (fine & ((1 << shift) - 1)) / float(1 << shift)
    return Line(nodes, np.searchsorted(nodes, cells), t, (nodes > first) & (nodes < last))


def heights(source: Source, rows: Line, cols: Line, limit: float) -> tuple[Indices, Floats, Mask]:
    """Heights at fine posts, as the count of the source's post before and what is added to it.

    Args:
        source: The source.
        rows: Where the fine posts stand among its rows.
        cols: Where they stand among its columns.
        limit: ``L`` [counts].

    Returns:
        Counts of the post at or before, int64; what is added [counts]; which are holes. Each of
        shape ``(len(rows.at), len(cols.at))``.
    """
    posts, hole = _read(source, rows.nodes, cols.nodes)
    whole, rest = _along_x(posts, cols, limit)
    added = _along_y(whole, rest, rows, limit)
    cross = _cross(posts)
    excess = cross - np.clip(cross, -limit, limit)
    corner = np.ix_(rows.at, cols.at)
    if excess.any():
        low = np.minimum(rows.t[:, None], cols.t[None, :])
        high = np.maximum(rows.t[:, None], cols.t[None, :])
        added += excess[corner] * low * (1.0 - high)
    return whole[rows.at], added, _holes(hole, rows, cols)


def bends(source: Source, rows: Indices, cols: Indices) -> Bends:
    """Bends of the source's posts from the second to the last but one of rows and columns.

    Args:
        source: The source.
        rows: Consecutive row indices, with two more on each side than the cells asked about.
        cols: Column indices likewise.
    """
    posts, hole = _read(source, rows, cols)
    grid = source.grid
    inner_rows = (rows > grid.row) & (rows < grid.row + grid.rows - 1)
    inner_cols = (cols > grid.col) & (cols < grid.col + grid.cols - 1)
    posts = posts[1:-1, 1:-1]
    along_x = _bend(posts, 1)[:, inner_cols[2:-2]]
    along_y = _bend(posts, 0)[inner_rows[2:-2], :]
    return Bends(_largest(along_x), _largest(along_y), _largest(_cross(posts)), bool(hole.any()))


def deviation(bent: Bends, limit: float) -> float:
    """Bound [counts] of the distance of the heights from the source's triangulated surface.

    The bulge along x is at most ``Mx / 8``. Second differences along y between columns are at most
    ``My`` and those of the bulges, ``4 Mx / 8``; so the bulge along y is at most ``(My + Mx / 2) /
    8``. With the ``|X| / 4`` of the bilinear surface: ``3/16 Mx + My / 8 + |X| / 4``.
    """
    return min(0.5 * limit, 0.1875 * bent.along_x + 0.125 * bent.along_y + 0.25 * bent.cross)


def interpolation_error(bent: Bends, limit: float, leg: float) -> float:
    """Bound [counts] of the distance of the heights from their interpolant inside cells.

    Where nothing was clipped the second derivatives are, in units of a cell, at most
    ``1.25 * 3 Mx``, ``1.25 * 3 My`` and ``1.5^2 |X|``: the magnitudes of the cubic's weights sum to
    at most 1.25, those of its slope as a mean of first differences to 1.5, and its second
    derivative is a mean of at most 3 second differences. Anywhere, the triangulated surface is its
    own interpolant, so that twice :func:`deviation` holds.

    Args:
        bent: Bends of the cells.
        limit: ``L`` [counts].
        leg: Legs of the interpolant's triangles in cells, a negative power of two.
    """
    distance = 2.0 * deviation(bent, limit)
    largest = max(bent.along_x, bent.along_y + 0.5 * bent.along_x, bent.cross)
    if bent.holes or largest > limit:
        return distance
    curved = curvature_bound(leg, 3.75 * bent.along_x, 2.25 * bent.cross, 3.75 * bent.along_y)
    return min(distance, curved)


_UNKNOWN = np.int64(HOLE)


def _read(source: Source, rows: Indices, cols: Indices) -> tuple[Indices, Mask]:
    """Posts as int64 with holes filled from their neighbours, and where the holes were."""
    posts = source.posts(0, rows, cols).astype(np.int64)
    hole = posts == HOLE
    if not hole.any():
        return posts, hole
    ground = np.pad(~hole, 1)
    known = np.pad(np.where(hole, 0, posts), 1)
    high, wide = posts.shape
    around = [
        (slice(1 + dr, 1 + dr + high), slice(1 + dc, 1 + dc + wide))
        for dr in (-1, 0, 1)
        for dc in (-1, 0, 1)
    ]
    count = sum((ground[a].astype(np.int64) for a in around), np.zeros_like(posts))
    total = sum((known[a] for a in around), np.zeros_like(posts))
    mean = np.where(count > 0, total // np.maximum(count, 1), _UNKNOWN)
    return np.where(hole, mean, posts), hole


def _bend(posts: Indices, axis: int) -> Floats:
    """Second differences at all posts but the first and last; 0 beside what is unknown."""
    lines = np.moveaxis(posts, axis, 0)
    before, middle, after = lines[:-2], lines[1:-1], lines[2:]
    bend = (before - middle) + (after - middle)
    unknown = (before == _UNKNOWN) | (middle == _UNKNOWN) | (after == _UNKNOWN)
    bend[unknown] = 0
    return np.moveaxis(bend, 0, axis).astype(np.float64)


def _cross(posts: Indices) -> Floats:
    """Cross differences of all cells; 0 where a corner is unknown."""
    h00, h10, h01, h11 = posts[:-1, :-1], posts[:-1, 1:], posts[1:, :-1], posts[1:, 1:]
    cross = (h11 - h10) - (h01 - h00)
    unknown = (np.minimum(np.minimum(h00, h10), np.minimum(h01, h11))) == _UNKNOWN
    cross[unknown] = 0
    return cross.astype(np.float64)


def _along_x(posts: Indices, cols: Line, limit: float) -> tuple[Indices, Floats]:
    """Heights on the source's rows, at every fine column."""
    bend = np.zeros(posts.shape)
    bend[:, 1:-1] = np.clip(_bend(posts, 1), -limit, limit)
    bend *= cols.inner
    at, t = cols.at, cols.t
    whole = posts[:, at]
    rest = t * (posts[:, at + 1] - whole)
    bulge = (1.0 - t) * bend[:, at] + t * bend[:, at + 1]
    return whole, rest - 0.5 * t * (1.0 - t) * bulge


def _along_y(whole: Indices, rest: Floats, rows: Line, limit: float) -> Floats:
    """What is added to the post at or before each fine post, from heights on the rows."""
    bend = np.zeros(rest.shape)
    bend[1:-1] = _bend(whole, 0) + ((rest[:-2] - rest[1:-1]) + (rest[2:] - rest[1:-1]))
    np.clip(bend, -limit, limit, out=bend)
    bend *= rows.inner[:, None]
    rise = np.zeros(rest.shape)
    rise[:-1] = (whole[1:] - whole[:-1]) + (rest[1:] - rest[:-1])
    t = rows.t[:, None]
    added = rise[rows.at]
    added *= t
    added += rest[rows.at]
    added -= (0.5 * t * (1.0 - t) ** 2) * bend[rows.at]
    added -= (0.5 * t * t * (1.0 - t)) * bend[rows.at + 1]
    return added


def _holes(hole: Mask, rows: Line, cols: Line) -> Mask:
    """Fine posts that lie on a triangle, edge or post that has a hole for a corner."""
    if not hole.any():
        return np.zeros((len(rows.at), len(cols.at)), dtype=np.bool_)
    v, u = rows.t[:, None], cols.t[None, :]
    low, high = np.ix_(rows.at, cols.at)
    return (
        hole[low, high]
        | (hole[low + 1, high + 1] & (u > 0) & (v > 0))
        | (hole[low, high + 1] & (u > v))
        | (hole[low + 1, high] & (v > u))
    )


def _largest(values: Floats) -> float:
    return float(np.abs(values).max(initial=0.0))
