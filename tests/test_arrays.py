"""Points of any kind go in, answers of the same kind come out."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

import terrasim as ts
from terrasim.arrays import answer, kind_of, vectors
from terrasim.errors import InputError

CPU = "cpu"
POINTS = np.array([[1.5, 2.25], [-3.0, 7.5], [40.125, 0.5]])
"""Every coordinate is exact in float32 too."""


@pytest.fixture(scope="module")
def terrain() -> Iterator[ts.Terrain]:
    posts = np.random.default_rng(0).integers(-(10**6), 10**6, (60, 50), dtype=np.int32)
    with ts.Terrain(ts.ArraySource(posts, ts.Grid(60, 50, 1.0))) as terrain:
        yield terrain


def every_second(array: Any) -> Any:
    """A view that skips every other entry of a Warp array twice as long."""
    return array[::2]


WARP: dict[str, Callable[[], Any]] = {
    "vec2d": lambda: wp.array(POINTS, dtype=wp.vec2d, device=CPU),
    "vec2": lambda: wp.array(POINTS, dtype=wp.vec2, device=CPU),
    "float64": lambda: wp.array(POINTS, dtype=wp.float64, device=CPU),
    "float32": lambda: wp.array(POINTS, dtype=wp.float32, device=CPU),
    "float64 with gaps": lambda: every_second(
        wp.array(POINTS.repeat(2, axis=0), dtype=wp.float64, device=CPU)
    ),
    "vec2d with gaps": lambda: every_second(
        wp.array(POINTS.repeat(2, axis=0), dtype=wp.vec2d, device=CPU)
    ),
    "vec2 with gaps": lambda: every_second(
        wp.array(POINTS.repeat(2, axis=0), dtype=wp.vec2, device=CPU)
    ),
}
read_only = POINTS.copy()
read_only.flags.writeable = False
NUMPY: dict[str, Any] = {
    "float64": POINTS,
    "float32": POINTS.astype(np.float32),
    "Fortran order": np.asfortranarray(POINTS),
    "with gaps": POINTS.repeat(2, axis=0)[::2],
    "read-only": read_only,
    "big-endian": POINTS.astype(">f8"),
    "list": POINTS.tolist(),
    "tuples": tuple(map(tuple, POINTS.tolist())),
}


@pytest.fixture(scope="module")
def expected(terrain: ts.Terrain) -> npt.NDArray[np.float64]:
    heights: npt.NDArray[np.float64] = ts.sample(terrain, POINTS).height
    assert len(set(heights.tolist())) == 3
    return heights


@pytest.mark.parametrize("kind", NUMPY)
def test_numpy_arrays_and_lists_are_answered_with_numpy_arrays(
    terrain: ts.Terrain, expected: npt.NDArray[np.float64], kind: str
) -> None:
    points = NUMPY[kind]
    before = np.array(points)
    found = ts.sample_all(terrain, points)
    assert np.array_equal(found.height, expected)
    assert isinstance(found.height, np.ndarray)
    assert np.array_equal(np.asarray(points), before)
    shapes = {name: (value.dtype, value.shape) for name, value in vars(found).items()}
    assert shapes == {
        "height": (np.float64, (3,)),
        "normal": (np.float64, (3, 3)),
        "slope": (np.float64, (3,)),
        "level": (np.uint8, (3,)),
        "error": (np.float64, (3,)),
        "state": (np.uint8, (3,)),
    }


@pytest.mark.parametrize("kind", WARP)
def test_warp_arrays_are_answered_with_warp_arrays(
    terrain: ts.Terrain, expected: npt.NDArray[np.float64], kind: str
) -> None:
    points = WARP[kind]()
    found = ts.sample_all(terrain, points)
    assert np.array_equal(found.height.numpy(), expected)
    types = {name: value.dtype for name, value in vars(found).items()}
    assert types == {
        "height": wp.float64,
        "normal": wp.vec3d,
        "slope": wp.float64,
        "level": wp.uint8,
        "error": wp.float64,
        "state": wp.uint8,
    }


@pytest.mark.torch
@pytest.mark.parametrize("kind", ["float64", "float32", "int32", "with gaps", "with gradient"])
def test_torch_tensors_are_answered_with_torch_tensors(
    terrain: ts.Terrain, expected: npt.NDArray[np.float64], kind: str
) -> None:
    torch = pytest.importorskip("torch")
    points = torch.from_numpy(POINTS.repeat(2, axis=0))[::2]
    if kind == "int32":
        points = torch.tensor([[1, 2], [3, 4]], dtype=torch.int32)
        expected = ts.sample(terrain, [[1, 2], [3, 4]]).height
    elif kind == "with gradient":
        points = points.clone().requires_grad_()
    elif kind != "with gaps":
        points = points.clone().to(getattr(torch, kind))
    before = points.clone()
    found = ts.sample_all(terrain, points)
    assert torch.equal(found.height, torch.from_numpy(expected))
    assert torch.equal(points, before)
    types = {name: (value.dtype, value.ndim) for name, value in vars(found).items()}
    assert types == {
        "height": (torch.float64, 1),
        "normal": (torch.float64, 2),
        "slope": (torch.float64, 1),
        "level": (torch.uint8, 1),
        "error": (torch.float64, 1),
        "state": (torch.uint8, 1),
    }


@pytest.mark.torch
def test_a_torch_answer_outlives_the_terrain() -> None:
    torch = pytest.importorskip("torch")
    source = ts.ArraySource(np.arange(400, dtype=np.int32).reshape(20, 20), ts.Grid(20, 20, 1.0))
    points = torch.rand(5000, 2, dtype=torch.float64) * 19.0
    with ts.Terrain(source) as terrain:
        height = ts.sample(terrain, points).height
        kept = height.clone()
        for _ in range(20):
            ts.sample(terrain, points + 0.25)
    del terrain
    assert torch.equal(height, kept)


def test_a_float64_array_of_the_device_is_read_in_place() -> None:
    points: Any = wp.array(POINTS, dtype=wp.float64, device=CPU)
    device = wp.get_device(CPU)
    assert vectors(points, 2, device, "points").ptr == points.ptr
    pairs: Any = wp.array(POINTS, dtype=wp.vec2d, device=CPU)
    assert vectors(pairs, 2, device, "points").ptr == pairs.ptr
    assert vectors(POINTS, 2, device, "points").ptr == POINTS.ctypes.data


def test_points_of_three_coordinates_are_vectors_of_three() -> None:
    found = vectors([[1, 2, 3], [4, 5, 6]], 3, wp.get_device(CPU), "points")
    assert wp.types.types_equal(found.dtype, wp.vec3d)
    assert found.numpy().tolist() == [[1, 2, 3], [4, 5, 6]]


def test_a_kind_is_known_by_its_type() -> None:
    array: Any = wp.zeros(3, dtype=wp.float64, device=CPU)
    assert kind_of(array) == "warp"
    assert kind_of(POINTS) == kind_of([1]) == kind_of(((1,),)) == "numpy"
    assert answer(array, "warp") is array
    assert answer(array, "numpy").tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (POINTS[0], r"points must have shape \(count, 2\), got \(2,\)"),
        (POINTS.reshape(2, 3), r"got \(2, 3\)"),
        (POINTS[None], r"got \(1, 3, 2\)"),
        ([], r"got \(0,\)"),
        (3.0, r"got \(\)"),
        ([[1.0, 2.0], [3.0]], "points must be an array of numbers"),
        ("here", "points must be an array of numbers"),
        ([["a", "b"]], "points must be an array of numbers"),
        ([[1.0 + 2.0j, 3.0]], "points must be an array of numbers"),
        (np.array([[1.0 + 2.0j, 3.0]]), "points must be an array of numbers"),
        (np.array([["2020-01-01", "2020-01-02"]], "M8[D]"), "points must be an array of numbers"),
        ([[{}, 1.0]], "points must be an array of numbers"),
    ],
)
def test_what_is_no_array_of_points_is_refused(
    terrain: ts.Terrain, points: Any, words: str
) -> None:
    with pytest.raises(InputError, match=words):
        ts.sample(terrain, points)


def test_a_warp_array_of_another_shape_or_width_is_refused(terrain: ts.Terrain) -> None:
    triples: Any = wp.zeros(4, dtype=wp.vec3d, device=CPU)
    flat: Any = wp.zeros(4, dtype=wp.float64, device=CPU)
    table: Any = wp.zeros((4, 3), dtype=wp.float64, device=CPU)
    pairs: Any = wp.zeros((4, 2), dtype=wp.vec2d, device=CPU)
    for points in (triples, flat, table, pairs):
        with pytest.raises(InputError, match=r"points must have shape \(count, 2\)"):
            ts.sample(terrain, points)


@pytest.mark.torch
def test_a_tensor_of_another_shape_or_type_is_refused(terrain: ts.Terrain) -> None:
    torch = pytest.importorskip("torch")
    with pytest.raises(InputError, match=r"points must have shape \(count, 2\), got \(4, 3\)"):
        ts.sample(terrain, torch.zeros(4, 3))
    with pytest.raises(InputError, match="points must be an array of numbers"):
        ts.sample(terrain, torch.zeros(4, 2, dtype=torch.complex64))


@pytest.mark.torch
def test_no_tensor_of_points_is_answered_with_no_tensor(terrain: ts.Terrain) -> None:
    torch = pytest.importorskip("torch")
    assert tuple(ts.sample_all(terrain, torch.zeros(0, 2)).normal.shape) == (0, 3)


@pytest.mark.parametrize("call", [ts.sample, ts.sample_all])
def test_no_points_are_answered_with_nothing(terrain: ts.Terrain, call: Any) -> None:
    empty = np.zeros((0, 2))
    for name, value in vars(call(terrain, empty)).items():
        assert value.shape == ((0, 3) if name == "normal" else (0,))
    for dtype in (wp.vec2d, wp.vec2):
        none: Any = wp.zeros(0, dtype=dtype, device=CPU)
        assert call(terrain, none).height.shape == (0,)
