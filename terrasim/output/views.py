"""Which parts of a run's ground to draw, and the posts for it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from terrasim.counts import COUNT_M, HOLE, Counts
from terrasim.grid import Span
from terrasim.output.footprint import Footprint
from terrasim.output.picture import View
from terrasim.output.window import detail_at, level_window, read_window
from terrasim.terrain import Terrain

Metres = npt.NDArray[np.float64]

MOST_POSTS = 900
"""Posts along a view's longer side; wider views are drawn from a coarser level."""
_FEWEST_POSTS = 12
_CLOSE_BALLS = 160.0
"""Width of the closest view in radii of a ball."""
_CLOSE_STAMP = 3.0
"""Width of the closest view in reaches of a stamp where there are no balls."""
_MARGIN = 1.15


@dataclass(frozen=True)
class Happening:
    """Where things happened, in metres from the anchor."""

    stamps: Sequence[Footprint]
    """All deformations."""
    places: npt.NDArray[np.float64]
    """Places of balls over time, shape ``(frames, balls, 2)``."""
    radii: npt.NDArray[np.float64]
    """Radii of the balls [m], shape ``(balls,)``."""


@dataclass(frozen=True)
class Square:
    """A square of ground, in metres from the anchor."""

    x: float
    """Centre, east."""
    y: float
    """Centre, north."""
    half: float
    """Half its width."""


def views_of(terrain: Terrain, anchor: tuple[int, int], happening: Happening) -> list[View]:
    """The whole terrain, the site where things happen, and a close look."""
    grid = terrain.grid
    everything = Span(grid.row, grid.row + grid.rows - 1, grid.col, grid.col + grid.cols - 1)
    views = [_view(terrain, anchor, everything, "the whole terrain", happening)]
    whole = max(grid.rows, grid.cols) * grid.spacing
    for square, title in (
        (site(happening), "where things happen"),
        (close_up(happening), "close up"),
    ):
        if square is None:
            continue
        half = max(square.half, _FEWEST_POSTS / 2.0 * terrain.detail.spacing)
        if 2.0 * half > 0.7 * whole:
            continue
        whole = 2.0 * half
        cells = _cells(terrain, anchor, Square(square.x, square.y, half))
        views.append(_view(terrain, anchor, cells, title, happening))
    return views


def site(happening: Happening) -> Square | None:
    """The square that holds every deformation and every ball, if there are any."""
    low, high = [], []
    for stamp in happening.stamps:
        west, south, east, north = stamp.extent
        low.append([stamp.x + west, stamp.y + south])
        high.append([stamp.x + east, stamp.y + north])
    if happening.places.size:
        low.append(happening.places.min(axis=(0, 1)).tolist())
        high.append(happening.places.max(axis=(0, 1)).tolist())
    if not low:
        return None
    first, last = np.min(low, axis=0), np.max(high, axis=0)
    middle = (first + last) / 2.0
    half = _MARGIN * float((last - first).max()) / 2.0
    return Square(float(middle[0]), float(middle[1]), half)


def close_up(happening: Happening) -> Square | None:
    """A square in which balls, or else the largest deformation, are seen at their size."""
    if happening.places.size:
        half = _CLOSE_BALLS / 2.0 * float(np.median(happening.radii))
        x, y = _busiest(happening, half)
        return Square(x, y, half)
    if not happening.stamps:
        return None
    largest = max(happening.stamps, key=_size)
    return Square(largest.x, largest.y, _CLOSE_STAMP / 2.0 * largest.reach)


def _size(stamp: Footprint) -> tuple[float, float]:
    """What a stamp counts among others: its volume, then its reach."""
    # Some have no volume of their own.
    return (0.0 if math.isnan(stamp.volume) else abs(stamp.volume), stamp.reach)


def _busiest(happening: Happening, half: float) -> tuple[float, float]:
    """Where most balls come to lie in or beside a deformation; else where most balls lie."""
    last = happening.places[-1]
    near = np.zeros(len(last), bool)
    for stamp in happening.stamps:
        near |= np.hypot(last[:, 0] - stamp.x, last[:, 1] - stamp.y) < stamp.reach / 2.0
    chosen = last[near] if near.any() else last
    bins = np.floor(chosen / half).astype(np.int64)
    kinds, which, counts = np.unique(bins, axis=0, return_inverse=True, return_counts=True)
    del kinds
    fullest = chosen[which.reshape(-1) == int(np.argmax(counts))]
    return float(fullest[:, 0].mean()), float(fullest[:, 1].mean())


def _cells(terrain: Terrain, anchor: tuple[int, int], square: Square) -> Span:
    """Level-0 cells of a square, within the terrain."""
    grid = terrain.grid
    half = max(1, round(square.half / grid.spacing))
    row = anchor[0] + round(square.y / grid.spacing)
    col = anchor[1] + round(square.x / grid.spacing)
    return Span(
        *_within(row, half, grid.row, grid.row + grid.rows - 1),
        *_within(col, half, grid.col, grid.col + grid.cols - 1),
    )


def _within(centre: int, half: int, first: int, last: int) -> tuple[int, int]:
    """A range around a place, moved into the terrain and cut where it is wider."""
    half = min(half, (last - first + 1) // 2)
    centre = min(max(centre, first + half), last - half)
    return max(centre - half, first), min(centre + half, last)


def _view(
    terrain: Terrain, anchor: tuple[int, int], cells: Span, title: str, happening: Happening
) -> View:
    grid = terrain.grid
    longest = max(cells.row1 - cells.row0, cells.col1 - cells.col0)
    level = 0
    while longest >> level > MOST_POSTS and level < grid.top:
        level += 1
    window = level_window(grid, level, cells)
    counts = read_window(terrain, level, window)
    spacing = grid.spacing * (1 << level)
    # A close view shows the triangles themselves, not a picture smoothed over them.
    finer = max(1, MOST_POSTS // (2 * max(counts.shape)))
    which = f"level {level}, {spacing:.3g} m between posts"
    if level == 0:
        which = f"every triangle, {spacing:.3g} m between posts"
    more, seen = None, spacing
    if level == 0 and terrain.detail.factor > 1:
        finer = max(1, MOST_POSTS // max(counts.shape))
        seen = max(spacing / finer, terrain.detail.spacing)
        more = detail_between(terrain, window, finer)
        if more.any():
            which += f", {terrain.detail.spacing:.3g} m in the detail"
    heights = np.where(counts == HOLE, np.nan, counts * COUNT_M + grid.datum)
    return View(
        f"{title}: {which}",
        _sum(on_triangles(heights, finer), more),
        (float(window.col0 << level) - anchor[1]) * grid.spacing,
        (float(window.row0 << level) - anchor[0]) * grid.spacing,
        spacing / finer,
        # Where the widest deformation lies between posts there is nothing of it to see.
        _sum(on_triangles(_change(terrain, level, window, counts), finer), more)
        if any(stamp.reach > 2.0 * seen for stamp in happening.stamps)
        else None,
    )


def _sum(base: Metres, more: Metres | None) -> Metres:
    return base if more is None else base + more


def _change(terrain: Terrain, level: int, window: Span, counts: Counts) -> Metres:
    """What was added to each post of a window [m]; NaN in holes."""
    before = terrain.source.posts(
        level, np.arange(window.row0, window.row1), np.arange(window.col0, window.col1)
    )
    hole = (counts == HOLE) | (before == HOLE)
    return np.where(hole, np.nan, (counts.astype(np.int64) - before) * COUNT_M)


def detail_between(terrain: Terrain, posts: Span, finer: int) -> Metres:
    """The detail's part of the heights [m] on and between posts of level 0.

    Args:
        terrain: Ground with a detail factor.
        posts: Posts of level 0, half-open.
        finer: Values along a cell's side.

    Returns:
        Shape as :func:`on_triangles` has it.
    """
    factor = terrain.detail.factor
    places = []
    for count in (posts.row1 - posts.row0, posts.col1 - posts.col0):
        near, rest = np.divmod(np.arange((count - 1) * finer + 1) * factor, finer)
        last = near == (count - 1) * factor
        places.append((near - last, np.where(last, 1.0, rest / finer)))
    (row, v), (col, u) = places
    cells = Span(posts.row0, posts.row1 - 1, posts.col0, posts.col1 - 1)
    corners = [
        detail_at(terrain, cells, row + down, col + right).astype(np.float64)
        for down, right in ((0, 0), (0, 1), (1, 0), (1, 1))
    ]
    return _interpolated(corners, u[None, :], v[:, None]) * (COUNT_M / factor)


def on_triangles(posts: npt.NDArray[np.float64], finer: int) -> npt.NDArray[np.float64]:
    """Values between posts on the surface's triangles, ``finer`` times as dense.

    Args:
        posts: Values, shape ``(rows, cols)``; NaN in holes.
        finer: Values along a cell's side.

    Returns:
        Shape ``((rows - 1) * finer + 1, (cols - 1) * finer + 1)``.
    """
    if finer == 1:
        return posts
    rows = np.arange((posts.shape[0] - 1) * finer + 1)
    cols = np.arange((posts.shape[1] - 1) * finer + 1)
    row = np.minimum(rows // finer, posts.shape[0] - 2)
    col = np.minimum(cols // finer, posts.shape[1] - 2)
    v = ((rows - row * finer) / finer)[:, None]
    u = ((cols - col * finer) / finer)[None, :]
    corners = [
        posts[np.ix_(row + down, col + right)] for down, right in ((0, 0), (0, 1), (1, 0), (1, 1))
    ]
    return _interpolated(corners, u, v)


def _interpolated(corners: Sequence[Metres], u: Metres, v: Metres) -> Metres:
    """Values on the triangles of cells at fractions of their sides.

    ``corners`` are those at (x-, y-), (x+, y-), (x-, y+) and (x+, y+).
    """
    near, right, up, far = corners
    middle = np.where(u >= v, right, up)
    value: Metres = near + (middle - near) * np.maximum(u, v) + (far - middle) * np.minimum(u, v)
    return value
