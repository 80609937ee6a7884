"""Rays: exact on the triangles, watertight, the same as other ways to find them."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.counts import HOLE
from terrasim.grid import Grid
from terrasim.kernels.ray_cell import FROM_BELOW, MISSED
from terrasim.query import sample
from terrasim.raycast import raycast
from terrasim.sources.analytic import Plane
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

Table = npt.NDArray[np.float64]
DOWN = np.array([[0.0, 0.0, -1.0]])


def rough(rows: int, cols: int, grid: Grid | None = None, seed: int = 1) -> ArraySource:
    """Random heights of a few metres."""
    posts = np.random.default_rng(seed).integers(-300_000, 300_000, (rows, cols))
    return ArraySource(posts.astype(np.int32), grid or Grid(rows, cols, 1.5))


def triangles(source: ArraySource) -> Table:
    """All triangles in world coordinates, shape ``(count, 3, 3)``; none where a post is a hole."""
    grid = source.grid
    rows, cols = np.arange(grid.rows) + grid.row, np.arange(grid.cols) + grid.col
    height = source.posts(0, rows, cols) * 1e-5 + grid.datum
    x, y = np.meshgrid(grid.post_x(cols), grid.post_y(rows))
    place = np.stack([x, y, height], axis=-1)
    near, far = place[:-1, :-1], place[1:, 1:]
    found = [np.stack([near, mid, far], axis=-2) for mid in (place[:-1, 1:], place[1:, :-1])]
    table = np.concatenate([part.reshape(-1, 3, 3) for part in found])
    keep: Table = table[(table[:, :, 2] > HOLE * 1e-5 + 1.0 + grid.datum).all(axis=1)]
    return keep


def brute_force(corners: Table, origin: Table, direction: Table, longest: float) -> float:
    """Distance of the first triangle that a ray meets: Moeller and Trumbore's test on all."""
    way = direction / np.linalg.norm(direction)
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    across = np.cross(way, second)
    inverse = 1.0 / np.einsum("ij,ij->i", first, across)
    away = origin - corners[:, 0]
    u = np.einsum("ij,ij->i", away, across) * inverse
    along = np.cross(away, first)
    v = (along @ way) * inverse
    t = np.einsum("ij,ij->i", second, along) * inverse
    hit = (u >= -1e-12) & (v >= -1e-12) & (u + v <= 1.0 + 1e-12) & (t >= 0.0) & (t <= longest)
    return float(t[hit].min()) if hit.any() else np.inf


def shots(count: int, side: float, seed: int = 2) -> tuple[Table, Table]:
    """Rays in all directions from in, above, below and beside a terrain; many graze it."""
    rng = np.random.default_rng(seed)
    origins = np.column_stack(
        [rng.uniform(-0.3 * side, 1.3 * side, (count, 2)), rng.uniform(-5.0, 12.0, count)]
    )
    directions = rng.normal(0.0, 1.0, (count, 3)) * [1.0, 1.0, 0.3]
    return origins, directions


@pytest.mark.parametrize(("row", "col", "count"), [(0, 0, 2000), (-21, -270, 1000)])
def test_hits_are_those_of_all_triangles_tried_one_by_one(row: int, col: int, count: int) -> None:
    """Rough ground with holes, in one block and across four: same hits, distances to rounding."""
    posts = rough(40, 34).posts(0, np.arange(40), np.arange(34)).copy()
    posts[7, 9] = posts[20:23, 15] = HOLE
    source = ArraySource(posts, Grid(40, 34, 1.5, row=row, col=col))
    corners = triangles(source)
    origins, directions = shots(count, 55.0)
    origins[:, :2] += [col * 1.5, row * 1.5]
    with Terrain(source) as terrain:
        found = raycast(terrain, origins, directions, max_distance=90.0)
    pairs = zip(origins, directions, strict=True)
    expected = np.array([brute_force(corners, *pair, 90.0) for pair in pairs])
    assert 0.1 * count < np.isfinite(expected).sum() < 0.9 * count
    np.testing.assert_allclose(found.distance, expected, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(np.isinf(found.distance), (found.state & MISSED) > 0)


def test_rays_aimed_at_posts_and_edges_never_slip_through() -> None:
    """From above, a hair under every kind of shared place: not one is missed."""
    rng = np.random.default_rng(3)
    count = 100_000
    source = rough(130, 130, Grid(130, 130, 1.0))
    cell = rng.integers(1, 128, (count, 2)).astype(np.float64)
    along = rng.uniform(0.0, 1.0, count)
    kind = rng.integers(0, 4, count)
    target = cell + np.stack([along * (kind % 2 == 1), along * (kind >= 2)], axis=1)
    with Terrain(source) as terrain:
        height = sample(terrain, target).height
        above = np.column_stack([rng.uniform(0.0, 129.0, (count, 2)), np.full(count, 60.0)])
        # A ray that only touches a peak may pass it by a rounding: this one goes into the ground.
        way = np.column_stack([target, height - 1e-7]) - above
        found = raycast(terrain, above, way, max_distance=400.0)
    assert not np.any(found.state & MISSED)
    assert np.all(found.distance <= np.linalg.norm(way, axis=1) + 1e-9)


def test_rays_along_axes_and_diagonals_meet_the_ground() -> None:
    """Level rays that run exactly along rows, columns and the cells' own diagonals."""
    heights = np.zeros((60, 60))
    heights[:, 40:] = 5.0
    heights[40:, :] = 5.0
    source = ArraySource.from_metres(heights, spacing=1.0)
    ways = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    starts = np.array([[3.0, 7.0, 2.5], [7.0, 3.0, 2.5], [4.0, 4.0, 2.5]])
    with Terrain(source) as terrain:
        found = raycast(terrain, starts, ways, max_distance=100.0)
    np.testing.assert_allclose(found.distance, [36.5, 36.5, 35.5 * np.sqrt(2.0)], rtol=1e-14)


def test_straight_down_is_sample_to_the_bit() -> None:
    """The place of a hit lies on the surface, whatever the distance rounds to."""
    rng = np.random.default_rng(4)
    points = rng.uniform(0.0, 448.0, (5000, 2))
    with Terrain(rough(300, 300)) as terrain:
        above = np.column_stack([points, np.full(len(points), 77.0)])
        down = raycast(terrain, above, np.repeat(DOWN, len(points), 0), max_distance=100.0)
        np.testing.assert_array_equal(down.point[:, 2], sample(terrain, points).height)
        np.testing.assert_allclose(down.distance, 77.0 - down.point[:, 2], rtol=0.0, atol=1e-12)


def test_from_below_the_ground_is_met_and_said_to_be() -> None:
    """Upward from under the surface: the same place, with its state."""
    points = np.array([[10.3, 20.9], [33.0, 12.5]])
    with Terrain(rough(60, 60)) as terrain:
        start = np.column_stack([points, np.full(2, -50.0)])
        up = raycast(terrain, start, np.repeat(-DOWN, 2, 0), max_distance=100.0)
        np.testing.assert_array_equal(up.point[:, 2], sample(terrain, points).height)
    assert np.all(up.state == FROM_BELOW)


def test_normals_and_levels_of_a_plane_are_exact() -> None:
    """A plane that is exact in counts has one normal at every level."""
    grid = Grid(1025, 1025, 1.0)
    origins, directions = shots(500, 1000.0)
    origins = np.clip(origins, 0.0, 1024.0)
    origins[:, 2] = 900.0
    directions[:, 2] = -1.0
    expected = np.array([-0.25, 0.125, 1.0]) / np.linalg.norm([-0.25, 0.125, 1.0])
    with Terrain(Plane(grid, slope_x=0.25, slope_y=-0.125)) as terrain:
        for level in range(grid.levels):
            found = raycast(terrain, origins, directions, max_distance=3000.0, level=level)
            hit = np.isfinite(found.distance)
            assert hit.sum() > 100
            np.testing.assert_allclose(
                found.normal[hit], np.broadcast_to(expected, (hit.sum(), 3)), atol=1e-12
            )
            assert set(found.level[hit]) == {level}


def test_a_level_is_the_surface_of_every_second_post() -> None:
    """Rays at level 1 meet what they would meet on a terrain of those posts alone."""
    source = rough(601, 601, Grid(601, 601, 1.0))
    every = np.arange(0, 601, 2)
    halved = ArraySource(source.posts(0, every, every), Grid(301, 301, 2.0))
    origins, directions = shots(2000, 600.0)
    with Terrain(source) as fine, Terrain(halved) as coarse:
        found = raycast(fine, origins, directions, max_distance=300.0, level=1)
        expected = raycast(coarse, origins, directions, max_distance=300.0)
    assert np.isfinite(expected.distance).sum() > 300
    np.testing.assert_allclose(found.distance, expected.distance, rtol=0.0, atol=1e-9)
    np.testing.assert_array_equal(found.normal, expected.normal)


def test_oblique_rays_of_mujoco_meet_the_same_triangles() -> None:
    """An independent engine, its data float32 of 1/1024 so that they are exact."""
    mujoco: Any = pytest.importorskip("mujoco")
    steps = np.random.default_rng(6).integers(0, 1025, (23, 31))
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><asset><hfield name="ground" nrow="23" ncol="31" size="7.5 5.5 10.24 1"/></asset>'
        '<worldbody><geom type="hfield" hfield="ground"/></worldbody></mujoco>'
    )
    # Written after compiling, which would scale it to the range it has.
    model.hfield_data[:] = (steps / 1024.0).ravel()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    rng = np.random.default_rng(11)
    # From above and inside the edges: its field has walls, the terrain has none.
    origins = rng.uniform([-7.5, -5.5, 10.5], [7.5, 5.5, 12.0], (2000, 3))
    directions = rng.normal(0.0, 1.0, (2000, 3))
    directions[:, 2] = -np.abs(directions[:, 2])
    directions /= np.linalg.norm(directions, axis=1)[:, None]
    geom = np.zeros(1, np.int32)
    pairs = zip(origins, directions, strict=True)
    theirs = np.array([mujoco.mj_ray(model, data, *pair, None, 1, -1, geom) for pair in pairs])
    grid = Grid(23, 31, 0.5, x=-7.5, y=-5.5)
    with Terrain(ArraySource((steps * 1000).astype(np.int32), grid)) as terrain:
        found = raycast(terrain, origins, directions, max_distance=100.0)
    ours = np.where(np.isinf(found.distance), -1.0, found.distance)
    assert 500 < np.count_nonzero(ours > 0.0) < 2000
    np.testing.assert_allclose(ours, theirs, rtol=0.0, atol=1e-5)
