"""Meshes of base and detail: on the surface, joined without gaps, no larger than there is room."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from detail_ground import base_between

from terrasim.counts import COUNT_M, HOLE, Counts, to_metres
from terrasim.deform.patch import Patch, apply_patch
from terrasim.grid import Grid, Span
from terrasim.output.mesh import TileMesh, tile_heights, tile_mesh, tile_origin
from terrasim.output.outline import outline
from terrasim.output.stage_tiles import StageTiles
from terrasim.output.tile_ground import DetailPosts, detailed, fine_cells, most_parts
from terrasim.output.tile_history import START, TileHistory
from terrasim.output.tiles import TILE, Choice, Tile, choose_tiles, leaf_at
from terrasim.output.usd import Clock, MeshPrim, write_stage
from terrasim.output.views import Happening, detail_between, on_triangles, views_of
from terrasim.query import sample
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

Table = npt.NDArray[np.float64]
Corner = tuple[int, int, int]


def ground(
    factor: int, rows: int = 300, cols: int = 330, *, holes: bool = False, **more: Any
) -> Terrain:
    """Rough ground whose first post lies within a tile of the first block."""
    rng = np.random.default_rng(7)
    counts = rng.integers(-200_000, 200_000, (rows, cols)).astype(np.int32)
    if holes:
        counts[rng.random(counts.shape) < 0.03] = HOLE
    grid = Grid(rows, cols, 0.5, x=1e5, y=-3e5, row=-290, col=-60, datum=40.0)
    return Terrain(ArraySource(counts, grid), detail_factor=factor, **more)


def put(terrain: Terrain, posts: Counts, row: int = 0, col: int = 0) -> None:
    """Add differences; row and column of detail posts from the terrain's first post."""
    first = terrain.detail.posts
    apply_patch(terrain, Patch(first.row0 + row, first.col0 + col, posts, detail=True))


def scatter(terrain: Terrain) -> None:
    """Detail over borders of tiles, blocks and the terrain, and at single posts on edges."""
    rng, factor = np.random.default_rng(8), terrain.detail.factor
    span = terrain.detail.posts
    rows, cols = span.row1 - span.row0, span.col1 - span.col0
    # Post (34, 60) from the first is the corner of four blocks, (34 + 64 n, 60 + 64 m) of tiles.
    for row, col in ((0, 0), (30, 55), (30, 120), (95, 100), (200, 20), (33, 200), (290, 320)):
        high, wide = (
            min(7 * factor, rows - row * factor),
            min(9 * factor, cols - col * factor),
        )
        part = rng.integers(-9_000 * factor, 9_000 * factor, (high, wide)).astype(np.int32)
        put(terrain, part, row * factor, col * factor)
    for row, col in ((98, 124), (162, 188), (98, 70)):
        put(terrain, np.full((1, 1), 7_777, np.int32), row * factor, col * factor)
        put(terrain, np.full((1, 1), 7_777, np.int32), row * factor, col * factor + 1)


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
    with ground(factor) as terrain:
        scatter(terrain)
        choice = focused(terrain)
        border = [tile.box for tile in choice.tiles if beside_coarser(terrain, choice, tile)]
        for box in border:
            row, col = (box.row1 + 290 - 20) * factor, (box.col1 + 60 - 3) * factor
            put(terrain, np.full((5 * factor, 5 * factor), 1234, np.int32), row, col)
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
    with ground(factor, holes=holes) as terrain:
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
    with ground(factor) as terrain:
        put(terrain, np.full((1, 1), 55, np.int32), 100 * factor + 2, 100 * factor + 1)
        choice = choose_tiles(terrain.grid, [], most_cells=1 << 22)
        whole = 2 * 299 * 329
        meshes = meshes_of(terrain, choice)
        # One cell in 2 * 16; each of its four neighbours gets 3 triangles more.
        assert sum(len(mesh.triangles) for mesh in meshes) == whole + 2 * 15 + 4 * 3
    with ground(factor) as terrain:
        put(terrain, np.full((1, 1), 55, np.int32), 100 * factor, 100 * factor)
        meshes = meshes_of(terrain, choice)
        # The four cells round a post, and the eight beside them.
        assert sum(len(mesh.triangles) for mesh in meshes) == whole + 4 * 2 * 15 + 8 * 3


def test_holes_in_a_triangle_of_the_base_are_holes_in_all_its_parts() -> None:
    factor = 3
    counts = np.zeros((65, 65), np.int32)
    counts[10, 11] = HOLE
    with Terrain(ArraySource(counts, Grid(65, 65, 1.0)), detail_factor=factor) as terrain:
        put(terrain, np.full((6, 6), 30, np.int32), 10 * factor - 2, 10 * factor - 2)
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
    with ground(factor) as terrain:
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
        put(terrain, bowl.astype(np.int32), 20 * factor + 1, 20 * factor + 1)
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


@pytest.mark.parametrize(
    ("factor", "cells", "room", "parts"),
    [(8, 10, 630, 8), (8, 10, 629, 4), (12, 1, 100, 6), (7, 1, 47, 1), (1024, 3, 10**9, 1024)],
)
def test_parts_divide_the_factor_and_keep_to_the_room(
    factor: int, cells: int, room: int, parts: int
) -> None:
    assert most_parts(factor, cells, room) == parts


@pytest.mark.parametrize(("factor", "parts"), [(6, 6), (6, 3), (6, 2), (6, 1), (5, 5)])
def test_a_tile_s_heights_are_base_and_detail(factor: int, parts: int) -> None:
    """Against the sum over the whole tile; detail comes in pieces that reach beyond it."""
    rng = np.random.default_rng(9)
    counts: Counts = rng.integers(-9_999, 9_999, (TILE + 1, TILE + 1), np.int32)
    side = TILE * factor + 1
    whole = np.zeros((side + 10, side + 10), np.int32)
    for r, c in ((0, 0), (5, 5), (100, 200), (side - 20, side - 9), (177, 60)):
        whole[r : r + 19, c : c + 14] = rng.integers(-99, 99, whole[r : r + 19, c : c + 14].shape)
    middle = side // 2
    pieces = [
        DetailPosts(r - 5, c - 5, whole[r : r + middle + 7, c : c + middle + 7])
        for r in (0, middle + 7)
        for c in (0, middle + 7)
    ]
    fine = np.logical_or.reduce([fine_cells(piece, factor) for piece in pieces])
    ground = detailed(counts, fine, pieces, factor, parts)
    step = factor // parts
    line = np.arange(TILE * parts + 1)
    rows, cols = np.repeat(line, line.size), np.tile(line, line.size)
    detail = whole[5:-5, 5:-5]
    expected = (base_between(counts, factor) + detail)[::step, ::step]
    np.testing.assert_array_equal(ground.heights(rows, cols).reshape(expected.shape), expected)
    touched = np.zeros((TILE, TILE), bool)
    for r, c in np.argwhere(detail):
        touched[
            max(-(-r // factor) - 1, 0) : r // factor + 1,
            max(-(-c // factor) - 1, 0) : c // factor + 1,
        ] = True
    np.testing.assert_array_equal(fine, touched)


def test_a_stage_follows_edits_of_the_detail(tmp_path: Path) -> None:
    """Triangles stay; before the edit they lie in the base's, after it on base and detail."""
    from pxr import Usd, UsdGeom, UsdValidation

    factor = 4
    with ground(factor) as terrain:
        grid = terrain.grid
        before = terrain.source.posts
        choice = focused(terrain)
        box = Span(grid.row + 34, grid.row + 42, grid.col + 120, grid.col + 128)
        tiles = StageTiles(terrain, choice, [box])
        tiles.changed(3.0, [box])
        part = np.random.default_rng(3).integers(-40_000, 40_000, (20, 20)).astype(np.int32)
        put(terrain, part, 35 * factor, 121 * factor)
        tiles.changed(5.0, [box])
        tiles.changed(7.0, [box])
        prims = tiles.prims(0.0, 1.0)
        changed = [prim for prim in prims if len(prim.points) > 1]
        # Post (34, 124) from the first is the corner of two tiles.
        assert {tuple(prim.points) for prim in changed} == {(0.0, 4.0, 5.0)}
        assert 1 <= len(changed) <= 4
        assert tiles.parts == factor
        for prim in changed:
            for time in (0.0, 5.0):
                points = prim.points[time] + np.array(prim.origin)
                if time == 0.0:
                    heights = below(terrain, before, points[:, :2])
                else:
                    heights = sample(terrain, points[:, :2]).height
                np.testing.assert_allclose(points[:, 2], heights, rtol=0, atol=5e-5)
            moved = np.abs(prim.points[5.0][:, 2] - prim.points[0.0][:, 2])
            dyed = np.abs(prim.colours[5.0] - prim.colours[0.0]).max(axis=1)
            assert moved.max() > 0.05
            assert (dyed[moved == 0.0] == 0.0).all()
            assert dyed.max() > 0.05
    check_stage(tmp_path / "scene.usdc", prims)
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    assert [error.GetErrorAsString() for error in context.Validate(stage)] == []
    for prim in prims:
        mesh = UsdGeom.Mesh.Get(stage, f"/World/Terrain/{prim.name}")
        for time, points in prim.points.items():
            low, high = np.array(mesh.GetExtentAttr().Get(time))
            np.testing.assert_array_equal(low, points.min(axis=0))
            np.testing.assert_array_equal(high, points.max(axis=0))


def check_stage(path: Path, prims: list[MeshPrim]) -> None:
    write_stage(path, prims, None, Clock(0.0, 10.0, 24.0))


def below(terrain: Terrain, posts: Any, places: Table) -> Table:
    """Heights of the source's own surface [m]."""
    grid = terrain.grid
    counts = posts(0, grid.row + np.arange(grid.rows), grid.col + np.arange(grid.cols))
    with Terrain(ArraySource(counts, grid)) as plain:
        return np.asarray(sample(plain, places).height)


@pytest.mark.parametrize("finer", [1, 3, 8])
def test_pictures_are_shaded_from_base_and_detail(finer: int) -> None:
    """Values on and between posts, as the surface has them."""
    factor = 4
    with ground(factor) as terrain:
        scatter(terrain)
        grid = terrain.grid
        posts = Span(grid.row + 25, grid.row + 50, grid.col + 50, grid.col + 90)
        counts = terrain.source.posts(
            0, np.arange(posts.row0, posts.row1), np.arange(posts.col0, posts.col1)
        )
        found = on_triangles(to_metres(counts, grid.datum), finer)
        more = detail_between(terrain, posts, finer)
        assert more.any()
        r, c = (np.arange(size) / finer for size in found.shape)
        x = grid.post_x(0) + (posts.col0 + c) * grid.spacing
        y = grid.post_y(0) + (posts.row0 + r) * grid.spacing
        places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        expected = sample(terrain, places).height.reshape(found.shape)
        # Places in a world 3e5 m wide are rounded to 6e-11 m, times slopes of some 10.
        np.testing.assert_allclose(found + more, expected, rtol=0, atol=1e-8)


def test_a_close_view_shows_detail_and_what_it_changed() -> None:
    factor = 8
    with ground(factor) as terrain:
        part = np.full((5, 5), 8 * 50_000, np.int32)
        put(terrain, part, 101 * factor, 101 * factor)
        places = np.full((2, 3, 2), 50.5)
        happening = Happening([], places, np.full(3, 0.02))
        close = views_of(terrain, (terrain.grid.row, terrain.grid.col), happening)[-1]
        west, east, south, north = close.box
        assert east - west < 8.0
        assert west < 50.75 < east
        assert south < 50.75 < north
        assert "0.0625 m in the detail" in close.title
        row, col = (
            round((50.75 - close.y) / close.spacing),
            round((50.75 - close.x) / close.spacing),
        )
        x, y = close.x + col * close.spacing, close.y + row * close.spacing
        west_x, south_y = 1e5 - 60 * 0.5, -3e5 - 290 * 0.5
        assert close.heights[row, col] == pytest.approx(
            float(sample(terrain, [[west_x + x, south_y + y]]).height[0]), abs=1e-8
        )


def test_tiles_are_those_of_the_terrain() -> None:
    """A tile that reaches beyond the edge has no fine cells there."""
    with ground(2) as terrain:
        span = terrain.detail.posts
        every = np.ones((span.row1 - span.row0, span.col1 - span.col0), np.int32)
        put(terrain, every)
        choice = choose_tiles(terrain.grid, [], most_cells=1 << 22)
        fine = TileHistory(terrain, choice).cover().fine
        assert sum(int(mask.sum()) for mask in fine.values()) == 299 * 329
        assert fine[Tile(0, -5, -1)].sum() == (290 - 256) * 60
