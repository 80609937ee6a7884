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

Levels above have detail rounded to a count. Where a post of theirs is also one of a fine cell, it
is at that one's height.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from terrasim.grid import Grid
from terrasim.output.tile_ground import Mask
from terrasim.output.tiles import TILE, Tile, leaf_at
from terrasim.output.triangles import (
    PITCH,
    SIDES,
    Points,
    Posts,
    Triangles,
    between_posts,
    own_joints,
    triangles,
)


@dataclass(frozen=True)
class Cover:
    """The tiles of a mesh, and which of their cells are shown in parts."""

    tiles: frozenset[Tile]
    """All tiles."""
    fine: Mapping[Tile, Mask]
    """Cells with detail of those tiles of level 0 that have any, shape ``(TILE, TILE)``."""
    parts: int = 1
    """Parts of a fine cell's side."""

    @cached_property
    def exact(self) -> dict[tuple[int, int], Tile]:
        """Level-0 posts of fine cells on the borders of tiles, and a tile that has each."""
        found: dict[tuple[int, int], Tile] = {}
        for tile, fine in self.fine.items():
            touched = np.zeros((PITCH, PITCH), bool)
            for down in (0, 1):
                for right in (0, 1):
                    touched[down : down + TILE, right : right + TILE] |= fine
            touched[1:-1, 1:-1] = False
            for row, col in np.argwhere(touched).tolist():
                found[tile.row * TILE + row, tile.col * TILE + col] = tile
        return found


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
    exact: tuple[tuple[Tile, Posts, Posts, Posts], ...]
    """Points among those, of tiles above level 0, that stand on posts of fine cells: the tile that
    has these, which points they are, and the row and column of each as its ground counts them."""
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
    between = between_posts(fine, parts)
    along = np.arange(PITCH, dtype=np.int64) * parts
    rows = [np.repeat(line_rows, PITCH) * parts, between[0] + tile.row * TILE * parts]
    cols = [np.tile(line_cols, PITCH) * parts, between[1] + tile.col * TILE * parts]
    own = (
        np.concatenate([np.repeat(along, PITCH), between[0]]),
        np.concatenate([np.tile(along, PITCH), between[1]]),
    )
    points = Points(parts, between[0] * (TILE * parts + 1) + between[1])
    joints = own_joints(fine, inside, points)
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
    all_rows, all_cols = np.concatenate(rows), np.concatenate(cols)
    return Outline(
        tile,
        parts,
        all_rows,
        all_cols,
        own,
        tuple(extra),
        _exact_points(cover, tile, all_rows, all_cols),
        triangles(fine, inside, points, joints),
    )


def _exact_points(
    cover: Cover, tile: Tile, rows: Posts, cols: Posts
) -> tuple[tuple[Tile, Posts, Posts, Posts], ...]:
    """Which points on a tile's border stand on posts of fine cells of level 0."""
    if tile.level == 0 or not cover.exact:
        return ()
    border = (rows == rows[0]) | (rows == rows.max()) | (cols == cols[0]) | (cols == cols.max())
    found: dict[Tile, list[int]] = {}
    for point in np.flatnonzero(border).tolist():
        row, i = divmod(int(rows[point]), cover.parts)
        col, j = divmod(int(cols[point]), cover.parts)
        leaf = cover.exact.get((row, col)) if i == j == 0 else None
        if leaf is not None:
            found.setdefault(leaf, []).append(point)
    return tuple(
        (
            leaf,
            np.array(at, np.int64),
            _in_tile(rows[at], leaf.row, 0, cover.parts),
            _in_tile(cols[at], leaf.col, 0, cover.parts),
        )
        for leaf, at in found.items()
    )


def _line(first: int, level: int, start: int, end: int) -> Posts:
    """Level-0 indices of a tile's posts, moved onto the terrain."""
    line: Posts = np.clip((first * TILE + np.arange(PITCH, dtype=np.int64)) << level, start, end)
    return line


def _in_tile(line: Posts, first: int, level: int, parts: int) -> Posts:
    """Rows or columns [parts of a level-0 cell] as a tile counts them."""
    return (line >> level) - first * TILE * parts


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
