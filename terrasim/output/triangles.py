"""Triangles of a tile: of whole cells, of cells in parts, and of cells split at points on edges."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from terrasim.output.tile_ground import Mask
from terrasim.output.tiles import TILE

Triangles = npt.NDArray[np.int32]
Posts = npt.NDArray[np.int64]
Joints = dict[tuple[int, int, str], list[int]]
"""Points on the edges of cells that are to be split there: cell and side, then the points in order
along +x or +y."""

SIDES = ("south", "east", "north", "west")
PITCH = TILE + 1
"""Posts along a tile's side."""


@dataclass(frozen=True)
class Points:
    """A tile's own points: its posts row by row, then those between posts."""

    parts: int
    """Parts of a cell's side."""
    between: Posts
    """Rank in the tile of each point between posts, in order, int64."""

    def at(self, rows: Posts, cols: Posts) -> Posts:
        """Which points stand at places [parts from the tile's first post]."""
        post = rows // self.parts * PITCH + cols // self.parts
        if not self.between.size:
            return post
        found = np.searchsorted(self.between, rows * (TILE * self.parts + 1) + cols)
        on_post = (rows % self.parts == 0) & (cols % self.parts == 0)
        return np.where(on_post, post, PITCH * PITCH + found)


def between_posts(fine: Mask, parts: int) -> tuple[Posts, Posts]:
    """Rows and columns of the points of fine cells that are no posts, in order, each once."""
    rows, cols = _parts_of(fine, parts, parts + 1)
    between = (rows % parts > 0) | (cols % parts > 0)
    pitch = TILE * parts + 1
    ranks = np.unique(rows[between] * pitch + cols[between])
    return ranks // pitch, ranks % pitch


def _parts_of(fine: Mask, parts: int, each: int) -> tuple[Posts, Posts]:
    """Rows and columns of the first ``each`` by ``each`` points of fine cells, a cell at a time."""
    row, col = np.nonzero(fine)
    step = np.arange(each)
    rows = row[:, None, None] * parts + step[:, None] + 0 * step
    cols = col[:, None, None] * parts + step + 0 * step[:, None]
    return rows, cols


def own_joints(fine: Mask, inside: Mask, points: Points) -> Joints:
    """Where a tile's other cells are to be split because a fine one lies beside them."""
    joints: Joints = {}
    step = np.arange(1, points.parts)
    if not step.size:
        return joints
    around = np.pad(fine, 1)
    beside = {
        "south": around[:-2, 1:-1], "north": around[2:, 1:-1],
        "west": around[1:-1, :-2], "east": around[1:-1, 2:],
    }  # fmt: skip
    for side, neighbour in beside.items():
        for row, col in np.argwhere(inside & ~fine & neighbour).tolist():
            low, left = row * points.parts, col * points.parts
            up, right = low + points.parts, left + points.parts
            on = {
                "south": (low + 0 * step, left + step), "north": (up + 0 * step, left + step),
                "west": (low + step, left + 0 * step), "east": (low + step, right + 0 * step),
            }  # fmt: skip
            joints[row, col, side] = points.at(*on[side]).tolist()
    return joints


def triangles(fine: Mask, inside: Mask, points: Points, joints: Joints) -> Triangles:
    """All triangles of a tile: of whole cells, of fine ones and of those that are split."""
    split = np.zeros((TILE, TILE), bool)
    for row, col, _ in joints:
        split[row, col] = True
    rows, cols = np.nonzero(inside & ~split & ~fine)
    found = [_two_each(rows * points.parts, cols * points.parts, points.parts, points)]
    rows, cols = _parts_of(fine, points.parts, points.parts)
    found.append(_two_each(rows.reshape(-1), cols.reshape(-1), 1, points))
    found += [_split_cell(row, col, joints) for row, col in np.argwhere(split & inside).tolist()]
    return np.concatenate(found).astype(np.int32)


def _two_each(rows: Posts, cols: Posts, size: int, points: Points) -> Posts:
    """Two triangles for each cell of a size, with the surface's diagonal."""
    near, right = points.at(rows, cols), points.at(rows, cols + size)
    up, far = points.at(rows + size, cols), points.at(rows + size, cols + size)
    both = np.stack([near, right, far, near, far, up], axis=1)
    return both.reshape(-1, 3)


def _split_cell(row: int, col: int, joints: Joints) -> Posts:
    """A cell's triangles, split at the points on its edges."""
    near = row * PITCH + col
    right, up, far = near + 1, near + PITCH, near + PITCH + 1
    on = {side: joints.get((row, col, side), []) for side in SIDES}
    # Points come along +x and +y; a triangle's edges run counter-clockwise.
    below = _fan(near, right, far, on["south"], on["east"])
    above = _fan(far, up, near, on["north"][::-1], on["west"][::-1])
    return np.array(below + above, np.int64).reshape(-1, 3)


def _fan(a: int, b: int, c: int, ab: list[int], bc: list[int]) -> list[tuple[int, int, int]]:
    """Triangle ``a b c`` split at points on its edges from a to b and from b to c."""
    first = [a, *ab, b]
    triangles = [(c, p, q) for p, q in pairwise(first)]
    if bc:
        _, corner, _ = triangles.pop()
        second = [b, *bc, c]
        triangles += [(corner, p, q) for p, q in pairwise(second)]
    return triangles
