"""Meshes of base and detail: on the surface, joined without gaps, no larger than there is room."""

from __future__ import annotations

from collections import Counter

import numpy as np
import numpy.typing as npt
import pytest
from detail_ground import add_detail, rough_ground, scatter

from terrasim.counts import COUNT_M, HOLE
from terrasim.grid import Grid, Span
from terrasim.output.mesh import TileMesh, tile_heights, tile_mesh, tile_origin
from terrasim.output.outline import outline
from terrasim.output.tile_history import START, TileHistory
from terrasim.output.tiles import Choice, Tile, choose_tiles, leaf_at
from terrasim.query import sample
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

Table = npt.NDArray[np.float64]
Corner = tuple[int, int, int]


def meshes_of(terrain: Terrain, choice: Choice) -> list[TileMesh]:
    history = TileHistory(terrain, choice)
    cover, factor = history.cover(), terrain.detail.factor
    ground_of = {tile: history.at(tile, START) for tile in choice.tiles}
    shapes = [outline(terrain.grid, cover, tile) for tile in choice.tiles]
    return [tile_mesh(terrain.grid, one, tile_heights(one, ground_of), factor) for one in shapes]


def focused(terrain: Terrain, most_cells: int = 1 << 22) -> Choice:
    """Level 0 in the middle, level 1 around it: detail lies on the border of both."""
    grid = terrain.grid
    focus = [Span(grid.row + 60, grid.row + 62, grid.col + 100, grid.col + 102)]
    return choose_tiles(grid, focus, most_cells=most_cells)


def beside_coarser(terrain: Terrain, choice: Choice, tile: Tile) -> bool:
    """Whether a tile of level 0 has a coarser one in the east."""
    box = tile.box
    east = leaf_at(frozenset(choice.tiles), box.row1 - 1, box.col1, terrain.grid.top)
    return tile.level == 0 and east is not None and east.level > 0


def corners(mesh: TileMesh) -> list[tuple[Corner, ...]]:
    """Triangles by row and column [parts] and exact height of their corners."""
    shape = mesh.shape
    z = np.rint(mesh.points[:, 2].astype(np.float64) / COUNT_M * 8.0 + mesh.base * 8.0)
    rows, cols = shape.rows[mesh.used], shape.cols[mesh.used]
    keys = list(zip(rows.tolist(), cols.tolist(), z.tolist(), strict=True))
    return [tuple(keys[i] for i in triangle) for triangle in mesh.triangles.tolist()]


def check_watertight(terrain: Terrain, meshes: list[TileMesh]) -> None:
    """Hold that triangles meet edge to edge in both directions, and end along the rim alone."""
    parts, grid = meshes[0].shape.parts, terrain.grid
    low, left = grid.row * parts, grid.col * parts
    high, right = low + (grid.rows - 1) * parts, left + (grid.cols - 1) * parts
    edges: Counter[tuple[Corner, Corner]] = Counter()
    for mesh in meshes:
        for a, b, c in corners(mesh):
            edges.update([(a, b), (b, c), (c, a)])
    assert max(edges.values()) == 1
    for a, b in [(a, b) for a, b in edges if (b, a) not in edges]:
        assert a[0] == b[0] in (low, high) or a[1] == b[1] in (left, right), (a, b)


def world(terrain: Terrain, mesh: TileMesh) -> Table:
    """Points of a mesh in the world [m]."""
    return np.asarray(mesh.points.astype(np.float64) + tile_origin(terrain.grid, mesh))


@pytest.mark.parametrize("factor", [2, 3, 8])
def test_cells_with_detail_join_all_others_without_gaps(factor: int) -> None:
    """Those of the same tile, of tiles beside it, and of coarser tiles; every edge has two sides.

    Heights are compared as whole numbers for factors that divide 8, else to an eighth of a count.
    """
    with rough_ground(factor) as terrain:
        scatter(terrain)
        choice = focused(terrain)
        border = [tile.box for tile in choice.tiles if beside_coarser(terrain, choice, tile)]
        for box in border:
            row, col = (box.row1 + 290 - 20) * factor, (box.col1 + 60 - 3) * factor
            add_detail(terrain, np.full((5 * factor, 5 * factor), 1234, np.int32), row, col)
        meshes = meshes_of(terrain, choice)
        assert {mesh.shape.tile.level for mesh in meshes} == {0, 1}
        coarse = [mesh.shape for mesh in meshes if mesh.shape.tile.level == 1]
        divided = [np.count_nonzero(rows % factor) for one in coarse for _, rows, _ in one.extra]
        assert sum(divided) >= 2 * 5 * (factor - 1)
        assert meshes[0].shape.parts == factor
        check_watertight(terrain, meshes)
        area = 0.0
        for mesh in meshes:
            p = mesh.points[mesh.triangles].astype(np.float64)
            first, second = p[:, 1, :2] - p[:, 0, :2], p[:, 2, :2] - p[:, 0, :2]
            twice = first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]
            assert twice.min() > 0.0
            area += twice.sum() / 2.0
        assert area == pytest.approx(299 * 329 * 0.25, rel=1e-6)


@pytest.mark.parametrize("holes", [False, True])
@pytest.mark.parametrize("factor", [2, 3, 8])
def test_points_and_triangles_lie_on_the_surface(factor: int, holes: bool) -> None:
    """Every point of every tile, and the middle of every triangle of level 0.

    Points are float32: 2e-6 m in heights of some 10 m, and 2e-6 m along x and y over tiles of
    32 m, times slopes of up to 12.
    """
    with rough_ground(factor, holes=holes) as terrain:
        scatter(terrain)
        seen = 0
        for mesh in meshes_of(terrain, focused(terrain)):
            points = world(terrain, mesh)
            # Beside a hole a point may be rounded into it.
            found = sample(terrain, points[:, :2]).height
            known = np.isfinite(found)
            assert known.all() or (holes and known.mean() > 0.8)
            np.testing.assert_allclose(points[known, 2], found[known], rtol=0, atol=5e-5)
            if mesh.shape.tile.level == 0:
                middle = points[mesh.triangles].mean(axis=1)
                found = sample(terrain, middle[:, :2]).height
                np.testing.assert_allclose(middle[:, 2], found, rtol=0, atol=5e-5)
                seen += len(middle)
        assert seen > 2 * 4096


def test_only_cells_that_touch_detail_are_divided() -> None:
    factor = 4
    with rough_ground(factor) as terrain:
        add_detail(terrain, np.full((1, 1), 55, np.int32), 100 * factor + 2, 100 * factor + 1)
        choice = choose_tiles(terrain.grid, [], most_cells=1 << 22)
        whole = 2 * 299 * 329
        meshes = meshes_of(terrain, choice)
        # One cell in 2 * 16; each of its four neighbours gets 3 triangles more.
        assert sum(len(mesh.triangles) for mesh in meshes) == whole + 2 * 15 + 4 * 3
    with rough_ground(factor) as terrain:
        add_detail(terrain, np.full((1, 1), 55, np.int32), 100 * factor, 100 * factor)
        meshes = meshes_of(terrain, choice)
        # The four cells round a post, and the eight beside them.
        assert sum(len(mesh.triangles) for mesh in meshes) == whole + 4 * 2 * 15 + 8 * 3


def test_holes_in_a_triangle_of_the_base_are_holes_in_all_its_parts() -> None:
    factor = 3
    counts = np.zeros((65, 65), np.int32)
    counts[10, 11] = HOLE
    with Terrain(ArraySource(counts, Grid(65, 65, 1.0)), detail_factor=factor) as terrain:
        add_detail(terrain, np.full((6, 6), 30, np.int32), 10 * factor - 2, 10 * factor - 2)
        [mesh] = meshes_of(terrain, choose_tiles(terrain.grid, [], most_cells=1 << 20))
        middle = world(terrain, mesh)[mesh.triangles].mean(axis=1)
        assert np.isfinite(sample(terrain, middle[:, :2]).height).all()
        p = mesh.points[mesh.triangles].astype(np.float64)
        first, second = p[:, 1, :2] - p[:, 0, :2], p[:, 2, :2] - p[:, 0, :2]
        area = (first[:, 0] * second[:, 1] - first[:, 1] * second[:, 0]).sum() / 2.0
        # Six triangles meet at a post.
        assert area == pytest.approx(64 * 64 - 3, rel=1e-6)


def test_detail_beyond_the_room_is_shown_in_fewer_parts_and_the_error_says_so() -> None:
    """Points still lie on the surface; between them it is off by no more than the bound."""
    factor = 12
    with rough_ground(factor) as terrain:
        scatter(terrain)
        choice = choose_tiles(terrain.grid, [], most_cells=1 << 20)
        everything = TileHistory(terrain, choice)
        assert everything.parts == factor
        assert everything.error == 0
        fine = sum(int(one.sum()) for one in everything.cover().fine.values())
        tight = Choice(choice.tiles, choice.finest, fine * 15)
        history = TileHistory(terrain, tight)
        assert history.parts == 4
        assert 0 < history.error <= 2 * 9_000 + 1
        meshes = meshes_of(terrain, tight)
        check_watertight(terrain, meshes)
        cells = sum(len(mesh.triangles) for mesh in meshes) / 2
        # Neighbours of fine cells have 3 triangles more on a side.
        assert cells < 299 * 329 + fine * 15 + fine * 4 * 1.5
        worst = 0.0
        for mesh in meshes:
            points = world(terrain, mesh)
            found = sample(terrain, points[:, :2]).height
            np.testing.assert_allclose(points[:, 2], found, rtol=0, atol=5e-5)
            middle = points[mesh.triangles].mean(axis=1)
            found = sample(terrain, middle[:, :2]).height
            worst = max(worst, float(np.abs(found - middle[:, 2]).max()))
        assert 0.01 < worst <= history.error * COUNT_M


def test_the_finest_detail_over_many_cells_is_not_read_into_a_mesh_of_any_size() -> None:
    """A factor of 1,024 in 9 cells would be 9 million cells: no more are made than are allowed.

    They are shown in the most parts that divide it and fit.
    """
    factor = 1024
    counts = np.zeros((70, 70), np.int32)
    with Terrain(ArraySource(counts, Grid(70, 70, 1.0)), detail_factor=factor) as terrain:
        away = np.arange(3 * factor - 1) - 3 * factor // 2
        bowl = (away[:, None] ** 2 + away[None, :] ** 2) // 100 + 1
        add_detail(terrain, bowl.astype(np.int32), 20 * factor + 1, 20 * factor + 1)
        choice = choose_tiles(terrain.grid, [], most_cells=20_000)
        history = TileHistory(terrain, choice)
        assert history.parts == 16
        meshes = meshes_of(terrain, choice)
        # Of the terrain's own cells, 69 by 69, nine are shown in 256, and twelve are split.
        cells = sum(len(mesh.triangles) for mesh in meshes) / 2
        assert cells == 69 * 69 + 9 * 255 + 12 * 15 / 2
        for mesh in meshes:
            points = world(terrain, mesh)
            found = sample(terrain, points[:, :2]).height
            np.testing.assert_allclose(points[:, 2], found, rtol=0, atol=5e-5)
