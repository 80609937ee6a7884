"""Rays at the edges of what can be asked: holes, borders, extremes, kinds of arrays, bad input."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from terrasim.deform.apply import apply
from terrasim.deform.stamps import Gaussian
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.kernels.ray_cell import FROM_BELOW, MISSED
from terrasim.raycast import raycast
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

DOWN = np.array([[0.0, 0.0, -1.0]])


def rough(rows: int, cols: int) -> ArraySource:
    """Random heights of a few metres."""
    posts = np.random.default_rng(1).integers(-300_000, 300_000, (rows, cols))
    return ArraySource(posts.astype(np.int32), Grid(rows, cols, 1.5))


def test_holes_let_rays_through_and_under_the_ground() -> None:
    """Down through a hole and out under flat ground, up through it from below, and past it."""
    heights = np.zeros((40, 40))
    heights[10:20, 10:20] = np.nan
    starts = [[15.0, 15.0, 3.0], [15.0, 15.0, 3.0], [15.0, 15.0, -3.0], [5.0, 15.0, 1.0]]
    ways = [[0.0, 0.0, -1.0], [3.0, 0.0, -4.0], [3.0, 0.0, 0.5], [4.0, 0.0, -1.0]]
    with Terrain(ArraySource.from_metres(heights, spacing=1.0)) as terrain:
        found = raycast(terrain, starts, ways, max_distance=50.0)
        assert terrain.cache.counters.fallbacks == 0
    np.testing.assert_allclose(
        found.distance, [np.inf, np.inf, 6.0 * np.hypot(3.0, 0.5), np.hypot(4.0, 1.0)]
    )
    assert found.state.tolist() == [MISSED, MISSED, FROM_BELOW, 0]
    np.testing.assert_allclose(found.point[2], [33.0, 15.0, 0.0])
    assert np.isnan(found.point[:2]).all()
    assert not found.normal[:2].any()


def test_rays_see_the_terrain_alone() -> None:
    """From beyond the edge they enter there; the ground does not go on outside, nor has walls."""
    starts = [
        [-30.0, 10.0, 4.0],  # down to the ground at x = 10
        [-30.0, 10.0, 4.0],  # would meet the level of the ground at x = -10
        [-30.0, 10.0, -1.0],  # enters below and comes out
        [10.0, 10.0, 4.0],  # leaves before it is down
        [-30.0, 10.0, 4.0],  # goes away
        [10.0, 19.0, 2.0],  # along the last row of posts
        [19.0, 19.0, 5.0],  # down on the last post
        [19.0 + 1e-9, 19.0, 5.0],  # down beside it
    ]
    ways = [
        [10.0, 0.0, -1.0],
        [5.0, 0.0, -1.0],
        [36.0, 0.0, 1.0],
        [10.0, 0.0, -1.0],
        [-1.0, 0.0, -1.0],
        [4.0, 0.0, -1.0],
        [0.0, 0.0, -1.0],
        [0.0, 0.0, -1.0],
    ]
    with Terrain(ArraySource.from_metres(np.zeros((20, 20)), spacing=1.0)) as terrain:
        found = raycast(terrain, starts, ways, max_distance=1e6)
    miss, below = (np.inf, MISSED), (np.hypot(36.0, 1.0), FROM_BELOW)
    expected = [
        (4.0 * np.hypot(10.0, 1.0), 0),
        *(miss, below, miss, miss),
        *((2.0 * np.hypot(4.0, 1.0), 0), (5.0, 0), miss),
    ]
    np.testing.assert_allclose(found.distance, [distance for distance, _ in expected], rtol=1e-14)
    assert found.state.tolist() == [state for _, state in expected]


@pytest.mark.parametrize("longest", [100.0, 1e9, 1.7e308])
@pytest.mark.parametrize("scale", [1.0, 1e-200, 1e200, 5e-324])
def test_lengths_of_directions_and_rays_do_not_matter(longest: float, scale: float) -> None:
    """Neither what a square would lose nor how far the ray might go changes the hit."""
    with Terrain(rough(60, 60)) as terrain:
        plain = raycast(terrain, [[30.3, 41.2, 50.0]], DOWN, max_distance=90.0)
        found = raycast(terrain, [[30.3, 41.2, 50.0]], DOWN * scale, max_distance=longest)
        assert found.state[0] == 0
        np.testing.assert_array_equal(found.point, plain.point)
        np.testing.assert_allclose(found.distance, plain.distance, rtol=1e-15)
        short = raycast(terrain, [[30.3, 41.2, 50.0]], DOWN * scale, max_distance=40.0)
        assert short.state[0] == MISSED


def test_starts_out_of_all_measure_are_misses_or_far_hits() -> None:
    """No start is too far to be counted in cells or heights."""
    starts = [[1e305, 0.0, 0.0], [-1e300, 5.0, 5.0], [9.5, 9.5, 1e306], [9.5, 9.5, 1e6]]
    ways = [[-1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.0, 0.0, -1.0]]
    with Terrain(ArraySource.from_metres(np.zeros((20, 20)), spacing=0.5)) as terrain:
        found = raycast(terrain, starts, ways, max_distance=1e7)
    assert found.state.tolist() == [MISSED, MISSED, MISSED, 0]
    assert found.distance[3] == pytest.approx(1e6, rel=1e-15)


def test_rays_meet_ground_that_was_raised() -> None:
    """A hill stamped into level ground stands in the way of a ray above it."""
    start, way = [[20.0, 100.0, 2.0]], [[1.0, 0.0, 0.0]]
    with Terrain(ArraySource.from_metres(np.zeros((300, 300)), spacing=1.0)) as terrain:
        assert raycast(terrain, start, way, max_distance=250.0).state[0] == MISSED
        apply(terrain, [Gaussian(x=100.0, y=100.0, amplitude=4.0, sigma=10.0)])
        found = raycast(terrain, start, way, max_distance=250.0)
    # Half its height, less what chords of 1 m miss: under a centimetre where it is steepest.
    assert found.distance[0] == pytest.approx(80.0 - 10.0 * np.sqrt(2.0 * np.log(2.0)), abs=0.02)


def test_a_ray_that_starts_on_the_ground_meets_it_at_once() -> None:
    """Whichever way it goes."""
    with Terrain(ArraySource.from_metres(np.zeros((20, 20)), spacing=1.0)) as terrain:
        found = raycast(terrain, [[7.3, 8.1, 0.0]] * 3, np.eye(3), max_distance=5.0)
    assert found.distance.tolist() == [0.0, 0.0, 0.0]
    assert found.state.tolist() == [0, 0, 0]


@pytest.mark.torch
def test_torch_rays_are_answered_in_torch() -> None:
    """Every field a tensor."""
    torch = pytest.importorskip("torch")
    origins = np.array([[5.0, 5.0, 30.0], [8.0, 9.0, -30.0]])
    with Terrain(rough(20, 20)) as terrain:
        plain = raycast(terrain, origins, DOWN.repeat(2, 0), max_distance=90.0)
        ways = torch.tensor([[0.0, 0.0, -1.0]]).repeat(2, 1)
        found = raycast(terrain, torch.from_numpy(origins), ways, max_distance=90.0)
    for name, value in vars(found).items():
        np.testing.assert_array_equal(value.numpy(), getattr(plain, name))
    assert found.point.shape == (2, 3)


def test_other_kinds_of_arrays_come_back_in_kind() -> None:
    """Warp in, Warp out; float32 is widened."""
    import warp as wp

    origins = np.array([[5.0, 5.0, 30.0]], dtype=np.float32)
    with Terrain(rough(20, 20)) as terrain:
        plain = raycast(terrain, origins, DOWN, max_distance=90.0)
        asked: Any = wp.array(origins, dtype=wp.vec3f, device="cpu")
        kind = raycast(terrain, asked, wp.array(DOWN, dtype=wp.vec3d), max_distance=90.0)
    assert isinstance(kind.distance, wp.array)
    np.testing.assert_array_equal(kind.distance.numpy(), plain.distance)
    np.testing.assert_array_equal(kind.point.numpy(), plain.point)


def test_no_rays_are_no_hits() -> None:
    """An empty question has an empty answer."""
    with Terrain(rough(20, 20)) as terrain:
        found = raycast(terrain, np.zeros((0, 3)), np.zeros((0, 3)), max_distance=1.0)
    assert found.distance.shape == (0,)


@pytest.mark.parametrize(
    ("origins", "directions", "options", "words"),
    [
        ([[0.0, 0.0, np.nan]], DOWN, {}, r"origins\[0\] must be finite"),
        ([[0.0, 0.0, 1.0]], [[0.0, np.inf, 0.0]], {}, r"directions\[0\] must be finite"),
        ([[0.0, 0.0, 1.0]], [[0.0, 0.0, 0.0]], {}, r"directions\[0\] must not be zero"),
        ([[0.0, 0.0]], DOWN, {}, r"origins must have shape \(count, 3\)"),
        ([[0.0, 0.0, 1.0]] * 2, DOWN, {}, "2 origins but 1 directions"),
        ([[0.0, 0.0, 1.0]], DOWN, {"max_distance": 0.0}, "max_distance must be above 0"),
        ([[0.0, 0.0, 1.0]], DOWN, {"max_distance": np.inf}, "max_distance must be above 0"),
        ([[0.0, 0.0, 1.0]], DOWN, {"level": 9}, "level must be 0 to 0"),
    ],
)
def test_bad_rays_are_refused_by_name(
    origins: object, directions: object, options: dict[str, float], words: str
) -> None:
    """The error names the argument, the ray and the rule."""
    settings = {"max_distance": 10.0, **options}
    with Terrain(rough(20, 20)) as terrain, pytest.raises(InputError, match=words):
        raycast(terrain, origins, directions, **settings)  # type: ignore[arg-type]
