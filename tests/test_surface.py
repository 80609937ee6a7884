"""The one surface: exact on its triangles, second order between posts, the same as MuJoCo's."""

from __future__ import annotations

from collections.abc import Callable
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

import terrasim as ts
from terrasim.grid import Grid

Metres = npt.NDArray[np.float64]


def places(grid: Grid, count: int, seed: int) -> Metres:
    """Random world points on a terrain."""
    random = np.random.default_rng(seed)
    share = random.random((count, 2))
    col = grid.col + share[:, 0] * (grid.cols - 1)
    row = grid.row + share[:, 1] * (grid.rows - 1)
    return np.column_stack([grid.x + col * grid.spacing, grid.y + row * grid.spacing])


def small(corners: list[list[int]]) -> ts.ArraySource:
    """A few posts at 1 m, heights given in counts by row from the south."""
    posts = np.array(corners, dtype=np.int32)
    return ts.ArraySource(posts, Grid(posts.shape[0], posts.shape[1], 1.0))


def test_a_cell_is_split_from_its_south_west_to_its_north_east_post() -> None:
    """A saddle of 1 m: along that diagonal it is level, where the two others meet it folds."""
    with ts.Terrain(small([[0, 100_000], [100_000, 0]])) as terrain:
        points = [[0.5, 0.5], [0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [1.0, 0.0], [0.0, 1.0]]
        assert ts.sample(terrain, points).height.tolist() == [0.0, 0.0, 0.5, 0.5, 1.0, 1.0]


def test_heights_on_posts_edges_and_diagonals_are_the_posts_interpolation() -> None:
    """Numbers of counts and fractions are such that float64 holds every answer exactly."""
    with ts.Terrain(small([[0, 400_000], [800_000, 3_200_000]])) as terrain:
        heights = {(0, 0): 0, (1, 0): 4, (0, 1): 8, (1, 1): 32, (0.5, 0): 2, (0, 0.25): 2}
        heights |= {(1, 0.5): 18, (0.75, 1): 26, (0.5, 0.5): 16, (0.75, 0.25): 10}
        heights |= {(0.25, 0.75): 12}
        found = ts.sample(terrain, list(heights)).height
        assert found.tolist() == pytest.approx(list(heights.values()), rel=1e-15, abs=0.0)


def test_a_cliff_of_the_whole_range_of_heights_is_exact() -> None:
    """Its rise is twice what an int32 holds."""
    most = 2**31 - 1
    with ts.Terrain(small([[-most, most], [-most, most]])) as terrain:
        found = ts.sample_all(terrain, [[0.0, 0.2], [0.25, 0.2], [0.5, 0.9], [1.0, 1.0]])
        rise = 2 * most * 1e-5
        np.testing.assert_allclose(found.height, rise * np.array([-0.5, -0.25, 0.0, 0.5]))
        np.testing.assert_allclose(found.slope, rise, rtol=1e-15)


@pytest.mark.parametrize("slopes", [(0.0, 0.0), (0.5, 0.0), (-0.25, 3.0), (64.0, -128.0)])
def test_normals_and_slopes_of_planes_are_exact(slopes: tuple[float, float]) -> None:
    east, north = slopes
    # A coarser level's last posts are the terrain's: beyond, the edge's height would go on.
    rows, cols = np.mgrid[0:41, 0:301]
    posts = np.rint((east * cols + north * rows) * 25_000).astype(np.int32)
    source = ts.ArraySource(posts, Grid(41, 301, 0.25, x=5.0, y=-7.0))
    expected = np.array([-east, -north, 1.0]) / np.sqrt(1.0 + east**2 + north**2)
    with ts.Terrain(source) as terrain:
        for level in range(terrain.grid.levels):
            points = places(terrain.grid, 3000, level)
            points[:100, 0] = 80.0  # the last column and the last row
            points[50:150, 1] = 3.0
            found = ts.sample_all(terrain, points, level=level)
            plane = east * (points[:, 0] - 5.0) + north * (points[:, 1] + 7.0)
            np.testing.assert_allclose(found.height, plane, rtol=0, atol=1e-10)
            np.testing.assert_allclose(found.normal, np.tile(expected, (3000, 1)), rtol=4e-16)
            np.testing.assert_allclose(found.slope, np.hypot(east, north), rtol=4e-16)
            assert (found.level == level).all()


def sample_error(surface: Callable[[Metres, Metres], Metres], posts: int) -> float:
    """Largest difference between a surface over a square metre and its triangulation."""
    line = np.linspace(0.0, 1.0, posts)
    heights = surface(line[None, :], line[:, None])
    points = np.random.default_rng(0).random((20_000, 2))
    with ts.Terrain(ts.ArraySource.from_metres(heights, spacing=1.0 / (posts - 1))) as terrain:
        found = ts.sample(terrain, points).height
    return float(np.abs(found - surface(points[:, 0], points[:, 1])).max())


def test_smooth_surface_converges_at_second_order() -> None:
    """Halving the spacing divides the error by four."""
    errors = [
        sample_error(lambda x, y: np.sin(3.0 * x) * np.cos(2.0 * y), posts=n) for n in (17, 33, 65)
    ]
    orders = np.log2([coarse / fine for coarse, fine in pairwise(errors)])
    np.testing.assert_allclose(orders, 2.0, atol=0.2)


@pytest.mark.parametrize("rough_ground", [False, True])
def test_vertical_rays_of_mujoco_meet_the_same_surface(rough_ground: bool) -> None:
    """An independent engine with the same triangles; its data are float32 of 1/1024, exact."""
    mujoco: Any = pytest.importorskip("mujoco")
    rows, cols, spacing, high = 23, 31, 0.5, 10.24
    steps = np.random.default_rng(6).integers(0, 1025, (rows, cols))
    if not rough_ground:
        steps = (
            np.tile(np.array([0, 1024]), (rows, cols))[:, :cols]
            ^ (np.arange(rows) % 2 * 1024)[:, None]
        )
    half = (cols - 1) * spacing / 2, (rows - 1) * spacing / 2
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><asset><hfield name="ground" nrow="{rows}" ncol="{cols}" '
        f'size="{half[0]} {half[1]} {high} 1"/></asset>'
        '<worldbody><geom type="hfield" hfield="ground"/></worldbody></mujoco>'
    )
    # Written after compiling, which would scale it to the range it has.
    model.hfield_data[:] = (steps / 1024.0).ravel()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    grid = Grid(rows, cols, spacing, x=-half[0], y=-half[1])
    points = places(grid, 1500, 7)
    down, geom = np.array([0.0, 0.0, -1.0]), np.zeros(1, np.int32)
    theirs = [
        100.0 - mujoco.mj_ray(model, data, np.array([x, y, 100.0]), down, None, 1, -1, geom)
        for x, y in points
    ]
    with ts.Terrain(ts.ArraySource((steps * 1000).astype(np.int32), grid)) as terrain:
        ours = ts.sample(terrain, points).height
    np.testing.assert_allclose(ours, theirs, rtol=0, atol=1e-5)
