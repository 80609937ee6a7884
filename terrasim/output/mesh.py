"""A tile as triangles: an outline at heights, around an origin of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from terrasim.counts import COUNT_M
from terrasim.grid import Grid
from terrasim.output.outline import Outline
from terrasim.output.tile_ground import NO_GROUND, Heights, TileGround
from terrasim.output.tiles import Tile
from terrasim.output.triangles import Posts, Triangles

Floats = npt.NDArray[np.float32]


@dataclass(frozen=True)
class TileMesh:
    """Triangles around a place of their own."""

    shape: Outline
    """What it was made from."""
    used: Posts
    """Which of the outline's points each point is, int64, shape ``(count,)``: posts without
    ground, and those of no triangle, are left out."""
    factor: int
    """The detail's factor."""
    base: int
    """Height of the local origin [counts]."""
    points: Floats
    """Points relative to the origin [m], float32, shape ``(count, 3)``."""
    triangles: Triangles
    """Points of each triangle, counter-clockwise from above, int32, shape ``(count, 3)``."""


def tile_heights(shape: Outline, ground: Mapping[Tile, TileGround]) -> Heights:
    """Heights [counts / factor] of an outline's points, int64, shape ``(count,)``.

    Args:
        shape: The outline.
        ground: The tile and its neighbours, all with the outline's parts.
    """
    found = [ground[shape.tile].heights(*shape.own)]
    found += [ground[leaf].heights(rows, cols) for leaf, rows, cols in shape.extra]
    heights = np.concatenate(found)
    for leaf, points, rows, cols in shape.exact:
        heights[points] = ground[leaf].heights(rows, cols)
    return heights


def tile_mesh(grid: Grid, shape: Outline, heights: Heights, factor: int = 1) -> TileMesh:
    """Triangles of an outline; those with a hole at a corner are left out.

    Args:
        grid: The terrain's grid.
        shape: The tile's outline.
        heights: Heights of the outline's points [counts / factor].
        factor: The detail's factor.
    """
    triangles = shape.triangles
    if (heights == NO_GROUND).any():
        triangles = triangles[(heights[triangles] != NO_GROUND).all(axis=1)]
    used = np.unique(triangles).astype(np.int64)
    place = np.zeros(heights.size, np.int32)
    place[used] = np.arange(used.size, dtype=np.int32)
    base = int(heights[used].min()) // factor if used.size else 0
    mesh = TileMesh(shape, used, factor, base, np.zeros((0, 3), np.float32), place[triangles])
    return replace(mesh, points=tile_points(grid, mesh, heights))


def tile_points(grid: Grid, mesh: TileMesh, heights: Heights) -> Floats:
    """Points of a mesh at heights [m], relative to its origin, float32, shape ``(count, 3)``.

    Args:
        grid: The terrain's grid.
        mesh: The mesh.
        heights: Heights of its outline's points [counts / factor].
    """
    shape, used = mesh.shape, mesh.used
    points = np.empty((used.size, 3), np.float64)
    points[:, 0] = (shape.cols[used] - shape.cols[0]) * grid.spacing / shape.parts
    points[:, 1] = (shape.rows[used] - shape.rows[0]) * grid.spacing / shape.parts
    points[:, 2] = (heights[used] - mesh.base * mesh.factor) * COUNT_M / mesh.factor
    return points.astype(np.float32)


def tile_origin(grid: Grid, mesh: TileMesh) -> tuple[float, float, float]:
    """World place of a mesh's local origin [m], on the tile's south-western post."""
    return (
        float(grid.post_x(int(mesh.shape.cols[0]) // mesh.shape.parts)),
        float(grid.post_y(int(mesh.shape.rows[0]) // mesh.shape.parts)),
        grid.datum + mesh.base * COUNT_M,
    )
