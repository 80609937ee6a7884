"""Heights of a tile: its posts, and on level 0 the detail of the cells that have any.

A cell is *fine* if a post of the detail in it or on its edges is not zero. A mesh may show fewer
detail cells than there are: ``parts`` along a cell's side, a divisor of the detail's factor.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from terrasim.counts import HOLE, Counts
from terrasim.output.tiles import TILE

Heights = npt.NDArray[np.int64]
Mask = npt.NDArray[np.bool_]

NO_GROUND = -(2**63)
"""What stands for a hole: the smallest int64."""


@dataclass(frozen=True)
class TileGround:
    """What is known of a tile's heights at one time."""

    counts: Counts
    """Posts of the tile [counts], int32, shape ``(TILE + 1, TILE + 1)``."""
    factor: int
    """Detail cells along a base cell's side, 1 without detail."""
    which: npt.NDArray[np.int32]
    """Place of each cell's detail in ``detail``, -1 without, int32, shape ``(TILE, TILE)``."""
    detail: Counts
    """Detail of fine cells [counts / factor], int32, shape ``(cells, parts + 1, parts + 1)``."""

    @property
    def parts(self) -> int:
        """Detail cells shown along a cell's side."""
        return int(self.detail.shape[1]) - 1

    @property
    def fine(self) -> Mask:
        """Cells with detail, shape ``(TILE, TILE)``."""
        fine: Mask = self.which >= 0
        return fine

    def heights(self, rows: Heights, cols: Heights) -> Heights:
        """Heights at points of the tile [counts / factor]; ``NO_GROUND`` in holes.

        Args:
            rows: Rows in parts of a cell from the tile's first post, 0 to ``TILE * parts``.
            cols: Columns likewise.
        """
        row, col = (np.minimum(line // self.parts, TILE - 1) for line in (rows, cols))
        i, j = rows - row * self.parts, cols - col * self.parts
        # The surface's own triangles, as weights of their three posts: exact whole numbers.
        step = self.factor // self.parts
        larger, smaller = step * np.maximum(i, j), step * np.minimum(i, j)
        middle = np.where(j >= i, self.counts[row, col + 1], self.counts[row + 1, col])
        posts = (self.counts[row, col], middle, self.counts[row + 1, col + 1])
        weights = (self.factor - larger, larger - smaller, smaller)
        found: Heights = np.zeros(row.shape, np.int64)
        hole = np.zeros(row.shape, bool)
        for post, weight in zip(posts, weights, strict=True):
            found += post.astype(np.int64) * weight
            hole |= (post == HOLE) & (weight > 0)
        if len(self.detail):
            place = self.which[row, col]
            found += np.where(place >= 0, self.detail[np.maximum(place, 0), i, j], 0)
        found[hole] = NO_GROUND
        return found

    def coarsened(self, parts: int) -> TileGround:
        """The same with fewer parts; ``parts`` divides those it has."""
        step = self.parts // parts
        if step == 1:
            return self
        detail = self.detail[:, ::step, ::step].copy()
        return TileGround(self.counts, self.factor, self.which, detail)

    def same(self, other: TileGround) -> bool:
        """Whether both have the same heights."""
        return all(
            np.array_equal(getattr(self, name), getattr(other, name))
            for name in ("counts", "which", "detail")
        )


@dataclass(frozen=True)
class DetailPosts:
    """A rectangle of detail around or across a tile."""

    row: int
    """First row, from the tile's first post [detail posts]."""
    col: int
    """First column likewise."""
    counts: Counts
    """Differences [counts / factor], int32, shape ``(rows, cols)``."""


def plain_ground(counts: Counts, factor: int = 1, parts: int = 1) -> TileGround:
    """A tile without detail."""
    none = np.full((TILE, TILE), -1, np.int32)
    return TileGround(counts, factor, none, np.zeros((0, parts + 1, parts + 1), np.int32))


def fine_cells(posts: DetailPosts, factor: int) -> Mask:
    """Cells of a tile with one of these posts that is not zero, shape ``(TILE, TILE)``."""
    # One cell more on every side, for posts on edges that are shared and those beyond.
    fine = np.zeros((TILE + 2, TILE + 2), bool)
    at_row, at_col = np.nonzero(posts.counts)
    row, i = np.divmod(at_row + posts.row, factor)
    col, j = np.divmod(at_col + posts.col, factor)
    near = (row >= 0) & (row <= TILE) & (col >= 0) & (col <= TILE)
    row, i, col, j = row[near] + 1, i[near], col[near] + 1, j[near]
    for down in (0, 1):
        for left in (0, 1):
            on = ((i == 0) | (down == 0)) & ((j == 0) | (left == 0))
            fine[row[on] - down, col[on] - left] = True
    return fine[1:-1, 1:-1]


def detailed(
    counts: Counts, fine: Mask, posts: Iterable[DetailPosts], factor: int, parts: int
) -> TileGround:
    """A tile with detail.

    Args:
        counts: The tile's posts [counts].
        fine: Its fine cells, shape ``(TILE, TILE)``.
        posts: All detail in the tile and on its edges that is not zero.
        factor: Detail cells along a base cell's side.
        parts: How many of them to show, a divisor of ``factor``.
    """
    which = np.full((TILE, TILE), -1, np.int32)
    which[fine] = np.arange(np.count_nonzero(fine), dtype=np.int32)
    detail = np.zeros((np.count_nonzero(fine), parts + 1, parts + 1), np.int32)
    for part in posts:
        down = _places(part.row, part.counts.shape[0], factor, parts)
        right = _places(part.col, part.counts.shape[1], factor, parts)
        for at_row, row, i in down:
            for at_col, col, j in right:
                place = which[np.ix_(row, col)]
                value = part.counts[np.ix_(at_row, at_col)]
                r, c = np.nonzero(place >= 0)
                detail[place[r, c], i[r], j[c]] = value[r, c]
    return TileGround(counts, factor, which, detail)


def most_parts(factor: int, cells: int, room: int) -> int:
    """Most parts, a divisor of ``factor``, in which fine cells add no more cells than ``room``."""
    fits = (
        parts
        for parts in range(factor, 1, -1)
        if factor % parts == 0 and cells * (parts**2 - 1) <= room
    )
    return next(fits, 1)


def _places(first: int, count: int, factor: int, parts: int) -> list[tuple[Heights, ...]]:
    """Where rows of detail lie that are shown: each in its cell, and on an edge in both.

    Returns:
        Twice: index in the rectangle, cell of the tile, and part within it.
    """
    step = factor // parts
    at = np.arange(-first % step, count, step, dtype=np.int64)
    cell, part = np.divmod((at + first) // step, parts)
    inside = (cell >= 0) & (cell < TILE)
    edge = (part == 0) & (cell >= 1) & (cell <= TILE)
    own = (at[inside], cell[inside], part[inside])
    before = (at[edge], cell[edge] - 1, np.full(np.count_nonzero(edge), parts, np.int64))
    return [own, before]
