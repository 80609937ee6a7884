"""A tile as triangles: the surface's own, joined without gaps to finer neighbours.

Where a neighbour is finer, the triangles of the coarser tile along the common edge are split at
the neighbour's posts, so that both sides have the same points there::

    coarse | fine            coarse | fine
       +---+                    +---+
       |  /|                    |  /|
       | / + <- a post of       | /.+
       |/  |    the finer       |/. |
       +---+                    +---+
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import numpy.typing as npt

from terrasim.counts import COUNT_M, HOLE, Counts
from terrasim.grid import Grid
from terrasim.output.tiles import TILE, Tile, leaf_at

Floats = npt.NDArray[np.float32]
Triangles = npt.NDArray[np.int32]
Posts = npt.NDArray[np.int64]

SIDES = ("south", "east", "north", "west")


@dataclass(frozen=True)
class Outline:
    """What a tile's mesh is made of, whatever its heights are."""

    tile: Tile
    """The tile."""
    rows: Posts
    """Level-0 row of each point, int64, shape ``(count,)``."""
    cols: Posts
    """Level-0 column of each point, int64, shape ``(count,)``."""
    extra: tuple[tuple[Tile, Posts, Posts], ...]
    """Points taken from finer neighbours, after the tile's own: the neighbour, and the row and
    column of each in it, int64."""
    triangles: Triangles
    """Points of each triangle, counter-clockwise from above, int32, shape ``(count, 3)``."""


@dataclass(frozen=True)
class TileMesh:
    """Triangles around a place of their own."""

    shape: Outline
    """What it was made from."""
    used: Posts
    """Which of the outline's points each point is, int64, shape ``(count,)``: posts without
    ground, and those of no triangle, are left out."""
    base: int
    """Height of the local origin [counts]."""
    points: Floats
    """Points relative to the origin [m], float32, shape ``(count, 3)``."""
    triangles: Triangles
    """Points of each triangle, counter-clockwise from above, int32, shape ``(count, 3)``."""


def outline(grid: Grid, tiles: frozenset[Tile], tile: Tile) -> Outline:
    """Points and triangles of a tile among others.

    Posts beyond the terrain's edge are moved onto it, and cells wholly beyond it left out.
    """
    last_row, last_col = grid.row + grid.rows - 1, grid.col + grid.cols - 1
    line_rows = np.clip((tile.row * TILE + np.arange(TILE + 1)) << tile.level, grid.row, last_row)
    line_cols = np.clip((tile.col * TILE + np.arange(TILE + 1)) << tile.level, grid.col, last_col)
    rows, cols = np.repeat(line_rows, TILE + 1), np.tile(line_cols, TILE + 1)
    inside = (np.diff(line_rows) > 0)[:, None] & (np.diff(line_cols) > 0)[None, :]
    finer: dict[tuple[int, int, str], list[int]] = {}
    extra = []
    count = rows.size
    for side in SIDES:
        for leaf, own in _finer_posts(grid, tiles, tile, side):
            extra.append((leaf, own[:, 0] - (leaf.row * TILE), own[:, 1] - (leaf.col * TILE)))
            for row, col in (own << leaf.level).tolist():
                finer.setdefault(_border_cell(tile, side, row, col), []).append(count)
                count += 1
            rows = np.append(rows, own[:, 0] << leaf.level)
            cols = np.append(cols, own[:, 1] << leaf.level)
    split = np.zeros((TILE, TILE), bool)
    for row, col, _ in finer:
        split[row, col] = True
    parts = [_whole_cells(inside & ~split)]
    for row, col in np.argwhere(split & inside).tolist():
        parts.append(_split_cell(row, col, finer))
    return Outline(tile, rows, cols, tuple(extra), np.concatenate(parts).astype(np.int32))


def tile_counts(shape: Outline, posts: Mapping[Tile, Counts]) -> Counts:
    """Heights [counts] of an outline's points, int32, shape ``(count,)``.

    Args:
        shape: The outline.
        posts: Counts of the tile's and its neighbours' posts, shape ``(TILE + 1, TILE + 1)``.
    """
    own = [posts[shape.tile].reshape(-1)]
    own += [posts[leaf][rows, cols] for leaf, rows, cols in shape.extra]
    return np.concatenate(own)


def tile_mesh(grid: Grid, shape: Outline, counts: Counts) -> TileMesh:
    """Triangles of an outline at given heights; those with a hole at a corner are left out."""
    triangles = shape.triangles
    if (counts == HOLE).any():
        triangles = triangles[(counts[triangles] != HOLE).all(axis=1)]
    used = np.unique(triangles).astype(np.int64)
    place = np.zeros(counts.size, np.int32)
    place[used] = np.arange(used.size, dtype=np.int32)
    base = int(counts[used].min()) if used.size else 0
    return TileMesh(
        shape, used, base, tile_points(grid, shape, counts, used, base), place[triangles]
    )


def tile_points(grid: Grid, shape: Outline, counts: Counts, used: Posts, base: int) -> Floats:
    """Points of a mesh [m], relative to its origin, float32, shape ``(len(used), 3)``.

    Args:
        grid: The terrain's grid.
        shape: The tile's outline.
        counts: Heights of the outline's points [counts].
        used: Which of them the mesh has.
        base: Height of the mesh's origin [counts].
    """
    points = np.empty((used.size, 3), np.float64)
    points[:, 0] = (shape.cols[used] - shape.cols[0]) * grid.spacing
    points[:, 1] = (shape.rows[used] - shape.rows[0]) * grid.spacing
    points[:, 2] = (counts[used].astype(np.int64) - base) * COUNT_M
    return points.astype(np.float32)


def tile_origin(grid: Grid, mesh: TileMesh) -> tuple[float, float, float]:
    """World place of a mesh's local origin [m], on the tile's south-western post."""
    return (
        float(grid.post_x(int(mesh.shape.cols[0]))),
        float(grid.post_y(int(mesh.shape.rows[0]))),
        grid.datum + mesh.base * COUNT_M,
    )


def _whole_cells(cells: npt.NDArray[np.bool_]) -> Posts:
    """Two triangles a cell, with the surface's diagonal."""
    row, col = np.nonzero(cells)
    near = row * (TILE + 1) + col
    right, up, far = near + 1, near + TILE + 1, near + TILE + 2
    both = np.stack([near, right, far, near, far, up], axis=1)
    return both.reshape(-1, 3)


def _split_cell(row: int, col: int, finer: Mapping[tuple[int, int, str], list[int]]) -> Posts:
    """A border cell's triangles, split at the points on its edges."""
    near = row * (TILE + 1) + col
    right, up, far = near + 1, near + TILE + 1, near + TILE + 2
    on = {side: finer.get((row, col, side), []) for side in SIDES}
    # Posts come along +x and +y; a triangle's edges run counter-clockwise.
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


def _finer_posts(
    grid: Grid, tiles: frozenset[Tile], tile: Tile, side: str
) -> list[tuple[Tile, Posts]]:
    """Posts of finer neighbours strictly inside the tile's border cells on one side.

    Returns:
        Each neighbour with its level's row and column of each post, int64, shape ``(count, 2)``.
    """
    box = tile.box
    along_row = side in {"east", "west"}
    across = {"south": box.row0 - 1, "north": box.row1, "west": box.col0 - 1, "east": box.col1}
    edge = {"south": box.row0, "north": box.row1, "west": box.col0, "east": box.col1}[side]
    start, end = (box.row0, box.row1) if along_row else (box.col0, box.col1)
    first, last = (
        (grid.row, grid.row + grid.rows - 1) if along_row else (grid.col, grid.col + grid.cols - 1)
    )
    start, end = max(start, first), min(end, last)
    found = []
    at = start
    while at < end:
        cell = (at, across[side]) if along_row else (across[side], at)
        leaf = leaf_at(tiles, *cell, grid.top)
        if leaf is None:
            break  # the terrain's edge
        stop = ((at >> leaf.shift) + 1) << leaf.shift
        if leaf.level < tile.level:
            line = _between(at, min(stop, end), leaf.level, tile.level)
            line = line[(line > first) & (line < last)] >> leaf.level
            other = np.full(line.size, edge >> leaf.level, dtype=np.int64)
            pair = (line, other) if along_row else (other, line)
            found.append((leaf, np.stack(pair, axis=1)))
        at = stop
    return found


def _between(start: int, end: int, level: int, coarser: int) -> Posts:
    """Level-0 indices from start to before end of a level's posts that a coarser level lacks."""
    step = 1 << level
    line = np.arange(-(-start // step) * step, end, step, dtype=np.int64)
    missing: Posts = line[(line & ((1 << coarser) - 1)) != 0]
    return missing


def _border_cell(tile: Tile, side: str, row: int, col: int) -> tuple[int, int, str]:
    """The tile's cell on whose edge a level-0 post lies."""
    cell_row = (row >> tile.level) - tile.row * TILE
    cell_col = (col >> tile.level) - tile.col * TILE
    return min(cell_row, TILE - 1), min(cell_col, TILE - 1), side
