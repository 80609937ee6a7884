"""Tiles as triangles: the surface's own, watertight across levels, open at holes."""

from __future__ import annotations

from collections import Counter

import numpy as np
import pytest

from terrasim.counts import COUNT_M, HOLE, Counts
from terrasim.grid import Grid, Span
from terrasim.output.mesh import TileMesh, tile_heights, tile_mesh, tile_origin
from terrasim.output.outline import Cover, Outline, outline
from terrasim.output.tile_ground import plain_ground
from terrasim.output.tiles import TILE, Tile, choose_tiles
from terrasim.sources.array_source import ArraySource


def posts_of(source: ArraySource, tile: Tile) -> Counts:
    """A tile's posts."""
    along = np.arange(TILE + 1)
    return source.posts(tile.level, tile.row * TILE + along, tile.col * TILE + along)


def meshes_of(source: ArraySource, focus: Span) -> list[TileMesh]:
    """All tiles of a terrain."""
    return meshed(source, frozenset(choose_tiles(source.grid, [focus], most_cells=1 << 24).tiles))


def meshed(source: ArraySource, tiles: frozenset[Tile]) -> list[TileMesh]:
    """Some tiles of a terrain."""
    ground = {tile: plain_ground(posts_of(source, tile)) for tile in tiles}
    shapes = [outline(source.grid, Cover(tiles, {}), tile) for tile in sorted(tiles)]
    return [tile_mesh(source.grid, one, tile_heights(one, ground)) for one in shapes]


def rough(rows: int, cols: int, row: int = 0, col: int = 0, holes: bool = False) -> ArraySource:
    """Random heights of some metres."""
    rng = np.random.default_rng(7)
    counts = rng.integers(-500_000, 500_000, (rows, cols)).astype(np.int32)
    if holes:
        counts[rng.random((rows, cols)) < 0.02] = HOLE
    return ArraySource(counts, Grid(rows, cols, spacing=0.5, x=1e6, y=2e6, row=row, col=col))


def corners(mesh: TileMesh) -> list[tuple[tuple[int, int, int], ...]]:
    """Triangles by the level-0 row, column and height of their corners."""
    shape: Outline = mesh.shape
    z = np.rint(mesh.points[:, 2] / COUNT_M).astype(np.int64) + mesh.base
    rows, cols = shape.rows[mesh.used], shape.cols[mesh.used]
    keys = list(zip(rows.tolist(), cols.tolist(), z.tolist(), strict=True))
    return [tuple(keys[i] for i in triangle) for triangle in mesh.triangles.tolist()]


@pytest.mark.parametrize(("row", "col"), [(0, 0), (-77, 130)])
def test_tiles_of_different_levels_join_without_gaps(row: int, col: int) -> None:
    """Every edge belongs to two triangles that run along it in opposite directions.

    Those along the terrain's rim belong to one. Points are compared exactly, heights included.
    """
    source = rough(700, 500, row, col)
    meshes = meshes_of(source, Span(row + 100, row + 120, col + 300, col + 310))
    assert {mesh.shape.tile.level for mesh in meshes} == {0, 1, 2}
    check_watertight(meshes, Span(row, row + 699, col, col + 499))


def test_a_tile_joins_neighbours_much_finer_on_every_side() -> None:
    """Three posts of level 0 lie inside each border cell of a tile of level 2."""
    source = rough(769, 769)
    fine = {Tile(0, row, col) for row in range(12) for col in range(12)}
    inside = {Tile(0, row, col) for row in range(4, 8) for col in range(4, 8)}
    tiles = frozenset(fine - inside | {Tile(2, 1, 1)})
    check_watertight(meshed(source, tiles), Span(0, 768, 0, 768))


def check_watertight(meshes: list[TileMesh], rim: Span) -> None:
    """Hold that triangles meet edge to edge, and end along the rim alone."""
    edges: Counter[tuple[tuple[int, int, int], tuple[int, int, int]]] = Counter()
    for mesh in meshes:
        for a, b, c in corners(mesh):
            edges.update([(a, b), (b, c), (c, a)])
    assert max(edges.values()) == 1
    for a, b in [(a, b) for a, b in edges if (b, a) not in edges]:
        on_rim = [
            a[0] == b[0] == rim.row0, a[0] == b[0] == rim.row1,
            a[1] == b[1] == rim.col0, a[1] == b[1] == rim.col1,
        ]  # fmt: skip
        assert any(on_rim), (a, b)


def test_the_mesh_covers_the_terrain_once_and_looks_up() -> None:
    source = rough(700, 500)
    area = 0.0
    for mesh in meshes_of(source, Span(100, 120, 300, 310)):
        p = mesh.points[mesh.triangles].astype(np.float64)
        first, second = p[:, 1, :2] - p[:, 0, :2], p[:, 2, :2] - p[:, 0, :2]
        twice = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
        assert twice.min() > 0.0
        area += twice.sum() / 2.0
    assert area == pytest.approx(699 * 499 * 0.25, rel=1e-6)


def test_cells_are_split_along_the_surface_s_diagonal() -> None:
    mesh = meshes_of(rough(65, 65), Span(0, 1, 0, 1))[0]
    assert len(mesh.triangles) == 2 * 64 * 64
    found = {frozenset((r, c) for r, c, _ in triangle) for triangle in corners(mesh)}
    assert frozenset([(5, 5), (5, 6), (6, 6)]) in found
    assert frozenset([(5, 5), (6, 6), (6, 5)]) in found


def test_points_are_posts_to_float32_rounding() -> None:
    source = rough(300, 300)
    for mesh in meshes_of(source, Span(0, 10, 0, 10)):
        x, y, z = tile_origin(source.grid, mesh)
        rows, cols = mesh.shape.rows[mesh.used], mesh.shape.cols[mesh.used]
        truth = source.posts(0, np.arange(300), np.arange(300))[rows, cols] * COUNT_M
        # Heights of some 10 m in float32 and tiles some 100 m wide.
        np.testing.assert_allclose(mesh.points[:, 2] + z, truth, atol=1e-6)
        np.testing.assert_array_equal(mesh.points[:, 0] + x, source.grid.post_x(cols))
        np.testing.assert_array_equal(mesh.points[:, 1] + y, source.grid.post_y(rows))


def test_triangles_at_holes_are_left_out_and_their_posts_too() -> None:
    source = rough(200, 200, holes=True)
    meshes = meshes_of(source, Span(0, 10, 0, 10))
    posts = source.posts(0, np.arange(200), np.arange(200))
    for mesh in meshes:
        rows, cols = mesh.shape.rows[mesh.used], mesh.shape.cols[mesh.used]
        assert (posts[rows, cols] != HOLE).all()
        assert mesh.triangles.max() == len(mesh.points) - 1
    fine = next(mesh for mesh in meshes if mesh.shape.tile == Tile(0, 0, 0))
    ground = posts[:65, :65] != HOLE
    below = ground[:-1, :-1] & ground[:-1, 1:] & ground[1:, 1:]
    above = ground[:-1, :-1] & ground[1:, :-1] & ground[1:, 1:]
    assert len(fine.triangles) == below.sum() + above.sum()
