"""What a tile's mesh is made of, whatever its heights are: points and triangles.

Where cells of one size meet cells of a smaller one, the triangles of the larger are split at the
points of the smaller, so that both sides have the same points there::

    coarse | fine            coarse | fine
       +---+                    +---+
       |  /|                    |  /|
       | / + <- a post of       | /.+
       |/  |    the finer       |/. |
       +---+                    +---+

So it is between tiles of different levels, and between cells with detail and those without. Rows
and columns count in parts: a cell of level 0 has ``parts`` of them along its side.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from terrasim.grid import Grid
from terrasim.output.tile_ground import Mask
from terrasim.output.tiles import TILE, Tile, leaf_at

Triangles = npt.NDArray[np.int32]
Posts = npt.NDArray[np.int64]
Joints = dict[tuple[int, int, str], list[int]]
"""Points on the edges of cells that are to be split there: cell and side, then the points in order
along +x or +y."""

SIDES = ("south", "east", "north", "west")
_PITCH = TILE + 1


@dataclass(frozen=True)
class Cover:
    """The tiles of a mesh, and which of their cells are shown in parts."""

    tiles: frozenset[Tile]
    """All tiles."""
    fine: Mapping[Tile, Mask]
    """Cells with detail of those tiles of level 0 that have any, shape ``(TILE, TILE)``."""
    parts: int = 1
    """Parts of a fine cell's side."""


@dataclass(frozen=True)
class Outline:
    """What a tile's mesh is made of, whatever its heights are."""

    tile: Tile
    """The tile."""
    parts: int
    """Parts of a level-0 cell's side."""
    rows: Posts
    """Row of each point [parts of a level-0 cell], int64, shape ``(count,)``."""
    cols: Posts
    """Column of each point likewise."""
    own: tuple[Posts, Posts]
    """Rows and columns of the points that are the tile's own, as its ground counts them."""
    extra: tuple[tuple[Tile, Posts, Posts], ...]
    """Points taken from neighbours, after the tile's own: the neighbour, and the row and column of
    each as its ground counts them."""
    triangles: Triangles
    """Points of each triangle, counter-clockwise from above, int32, shape ``(count, 3)``."""


def outline(grid: Grid, cover: Cover, tile: Tile) -> Outline:
    """Points and triangles of a tile among others.

    Posts beyond the terrain's edge are moved onto it, and cells wholly beyond it left out.
    """
    parts = cover.parts
    line_rows = _line(tile.row, tile.level, grid.row, grid.row + grid.rows - 1)
    line_cols = _line(tile.col, tile.level, grid.col, grid.col + grid.cols - 1)
    inside = (np.diff(line_rows) > 0)[:, None] & (np.diff(line_cols) > 0)[None, :]
    fine = cover.fine.get(tile, np.zeros((TILE, TILE), bool)) & inside
    between = _between_posts(fine, parts)
    along = np.arange(_PITCH, dtype=np.int64) * parts
    rows = [np.repeat(line_rows, _PITCH) * parts, between[0] + tile.row * TILE * parts]
    cols = [np.tile(line_cols, _PITCH) * parts, between[1] + tile.col * TILE * parts]
    own = (
        np.concatenate([np.repeat(along, _PITCH), between[0]]),
        np.concatenate([np.tile(along, _PITCH), between[1]]),
    )
    points = _Points(parts, between[0] * (TILE * parts + 1) + between[1])
    joints = _own_joints(fine, inside, points)
    extra = []
    count = own[0].size
    for side in SIDES:
        for leaf, row, col in _neighbours_points(grid, cover, tile, side):
            cells = _border_cells(tile, row // parts, col // parts)
            lacking = ~fine[cells[:, 0], cells[:, 1]]
            row, col = row[lacking], col[lacking]  # noqa: PLW2901 fine cells have these points
            extra.append((leaf, _in_tile(row, leaf.row, leaf.level, parts),
                          _in_tile(col, leaf.col, leaf.level, parts)))  # fmt: skip
            for cell_row, cell_col in cells[lacking].tolist():
                joints.setdefault((cell_row, cell_col, side), []).append(count)
                count += 1
            rows.append(row)
            cols.append(col)
    triangles = _triangles(fine, inside, points, joints)
    return Outline(
        tile, parts, np.concatenate(rows), np.concatenate(cols), own, tuple(extra), triangles
    )


@dataclass(frozen=True)
class _Points:
    """A tile's own points: its posts row by row, then those between posts."""

    parts: int
    """Parts of a cell's side."""
    between: Posts
    """Rank in the tile of each point between posts, in order, int64."""

    def at(self, rows: Posts, cols: Posts) -> Posts:
        """Which points stand at places [parts from the tile's first post]."""
        post = rows // self.parts * _PITCH + cols // self.parts
        if not self.between.size:
            return post
        found = np.searchsorted(self.between, rows * (TILE * self.parts + 1) + cols)
        on_post = (rows % self.parts == 0) & (cols % self.parts == 0)
        return np.where(on_post, post, _PITCH * _PITCH + found)


def _line(first: int, level: int, start: int, end: int) -> Posts:
    """Level-0 indices of a tile's posts, moved onto the terrain."""
    line: Posts = np.clip((first * TILE + np.arange(_PITCH, dtype=np.int64)) << level, start, end)
    return line


def _in_tile(line: Posts, first: int, level: int, parts: int) -> Posts:
    """Rows or columns [parts of a level-0 cell] as a tile counts them."""
    return (line >> level) - first * TILE * parts


def _between_posts(fine: Mask, parts: int) -> tuple[Posts, Posts]:
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


def _own_joints(fine: Mask, inside: Mask, points: _Points) -> Joints:
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


def _triangles(fine: Mask, inside: Mask, points: _Points, joints: Joints) -> Triangles:
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


def _two_each(rows: Posts, cols: Posts, size: int, points: _Points) -> Posts:
    """Two triangles for each cell of a size, with the surface's diagonal."""
    near, right = points.at(rows, cols), points.at(rows, cols + size)
    up, far = points.at(rows + size, cols), points.at(rows + size, cols + size)
    both = np.stack([near, right, far, near, far, up], axis=1)
    return both.reshape(-1, 3)


def _split_cell(row: int, col: int, joints: Joints) -> Posts:
    """A cell's triangles, split at the points on its edges."""
    near = row * _PITCH + col
    right, up, far = near + 1, near + _PITCH, near + _PITCH + 1
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


def _neighbours_points(
    grid: Grid, cover: Cover, tile: Tile, side: str
) -> list[tuple[Tile, Posts, Posts]]:
    """Points of neighbours strictly inside the edges of the tile's border cells on one side.

    Returns:
        Each neighbour, and row and column of its points [parts], int64, in order.
    """
    box = tile.box
    along_row = side in {"east", "west"}
    across = {"south": box.row0 - 1, "north": box.row1, "west": box.col0 - 1, "east": box.col1}
    edge = {"south": box.row0, "north": box.row1, "west": box.col0, "east": box.col1}[side]
    start, end = (box.row0, box.row1) if along_row else (box.col0, box.col1)
    first, last = (
        (grid.row, grid.row + grid.rows - 1) if along_row else (grid.col, grid.col + grid.cols - 1)
    )
    at, end = max(start, first), min(end, last)
    found = []
    while at < end:
        cell = (at, across[side]) if along_row else (across[side], at)
        leaf = leaf_at(cover.tiles, *cell, grid.top)
        if leaf is None:
            break  # the terrain's edge
        stop = ((at >> leaf.shift) + 1) << leaf.shift
        line = np.concatenate(
            [
                _between(at, min(stop, end), leaf.level, tile.level, first) * cover.parts,
                _fine_points(cover, leaf, side, at, min(stop, end)),
            ]
        )
        line.sort()
        if line.size:
            other = np.full(line.size, edge * cover.parts, dtype=np.int64)
            found.append((leaf, line, other) if along_row else (leaf, other, line))
        at = stop
    return found


def _between(start: int, end: int, level: int, coarser: int, first: int) -> Posts:
    """Level-0 indices from start to before end of a level's posts that a coarser level lacks.

    ``first`` is the terrain's first index, where the coarser level has a post moved onto it.
    """
    step = 1 << level
    line = np.arange(-(-start // step) * step, end, step, dtype=np.int64)
    missing: Posts = line[((line & ((1 << coarser) - 1)) != 0) & (line > first)]
    return missing


def _fine_points(cover: Cover, leaf: Tile, side: str, start: int, end: int) -> Posts:
    """Points [parts] between the posts of a neighbour's fine cells along its edge, in order."""
    fine = cover.fine.get(leaf)
    if fine is None:
        return np.zeros(0, np.int64)
    border = {"south": fine[-1], "north": fine[0], "west": fine[:, -1], "east": fine[:, 0]}[side]
    cells = (leaf.row if side in {"east", "west"} else leaf.col) * TILE + np.flatnonzero(border)
    cells = cells[(cells >= start) & (cells < end)]
    step = np.arange(1, cover.parts)
    line: Posts = (cells[:, None] * cover.parts + step).reshape(-1).astype(np.int64)
    return line


def _border_cells(tile: Tile, rows: Posts, cols: Posts) -> Posts:
    """Row and column of the tile's cells on whose edges points on its border lie.

    ``rows`` and ``cols`` are those of level-0 cells.
    """
    cell = [
        np.minimum((line >> tile.level) - first * TILE, TILE - 1)
        for line, first in ((rows, tile.row), (cols, tile.col))
    ]
    return np.stack(cell, axis=1)
