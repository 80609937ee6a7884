"""What a stamp is at a place: each formula against one written down again in NumPy."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from shape_formulas import BEND, FORMULAS, PICTURE, WANDERING, Formula, kernel_at, lattice

from terrasim.deform.shapes.footprint import turn_of
from terrasim.deform.stamps import Berm, Flatten, Gaussian, Noise, Stamp, Texture, Trench
from terrasim.detail.grid import MAX_FACTOR


def names() -> list[str]:
    return [f"{i} {stamp.name} {stamp.mode}" for i, (stamp, _, _) in enumerate(FORMULAS)]


@pytest.mark.parametrize(("stamp", "formula", "error"), FORMULAS, ids=names())
def test_a_shape_is_its_formula(stamp: Stamp, formula: Formula, error: float) -> None:
    """Heights and weights, relative to the largest; off the ends, where a last bit decides."""
    dx, dy = lattice(stamp, 41)
    height, weight = kernel_at(stamp, dx, dy)
    expected_height, expected_weight = formula(dx, dy)
    scale = max(1.0, float(np.abs(expected_height).max()))
    np.testing.assert_allclose(weight, expected_weight, atol=2 * error, rtol=0.0)
    height = np.where(weight > 0.0, height, 0.0)
    expected_height = np.where(weight > 0.0, expected_height, 0.0)
    np.testing.assert_allclose(height, expected_height, atol=2 * error * scale, rtol=0.0)
    assert (weight > 0.0).sum() > 20
    assert (weight == 0.0).sum() > 20


@pytest.mark.parametrize(("stamp", "formula", "error"), FORMULAS, ids=names())
def test_a_shape_is_nothing_beyond_its_extent_and_reaches_it(
    stamp: Stamp, formula: Formula, error: float
) -> None:
    """On the sides of its box it has ended; a hundredth within, it has not, on every side."""
    west, south, east, north = stamp.extent
    along = np.linspace(0.0, 1.0, 2001)
    size_x, size_y = east - west, north - south
    for out, seen in ((1e-9, False), (-1e-2, True)):
        edges = [
            (np.full(2001, west - out * size_x), south + along * size_y),
            (np.full(2001, east + out * size_x), south + along * size_y),
            (west + along * size_x, np.full(2001, south - out * size_y)),
            (west + along * size_x, np.full(2001, north + out * size_y)),
        ]
        flat_ends = isinstance(stamp, Trench) and stamp.ends == "flat"
        for dx, dy in edges:
            _, weight = kernel_at(stamp, dx, dy)
            assert (weight > 0.0).any() == seen or (seen and flat_ends)


@pytest.mark.parametrize(("stamp", "formula", "error"), FORMULAS, ids=names())
def test_a_shape_is_no_wilder_than_its_bounds(stamp: Stamp, formula: Formula, error: float) -> None:
    """Heights within, and between places a thousandth apart no more than the slope allows."""
    rng = np.random.default_rng(3)
    west, south, east, north = stamp.extent
    dx, dy = rng.uniform(west, east, 20_000), rng.uniform(south, north, 20_000)
    step = 1e-3 * (east - west)
    turn = rng.uniform(0.0, 2 * np.pi, 20_000)
    height, weight = kernel_at(stamp, dx, dy)
    beside, also = kernel_at(stamp, dx + step * np.cos(turn), dy + step * np.sin(turn))
    height, beside = height * (weight > 0.0), beside * (also > 0.0)
    bounds = stamp.bounds
    room = 1e-12 * (bounds.highest - bounds.lowest)
    assert bounds.lowest - room <= height.min()
    assert height.max() <= bounds.highest + room
    if stamp.mode == "add":
        slope = np.abs(beside - height).max() / step
        assert slope <= bounds.slope * (1 + 1e-9)


ROUND = [stamp for stamp, _, _ in FORMULAS[:9]]


@pytest.mark.parametrize("stamp", ROUND, ids=lambda stamp: stamp.name)
def test_a_round_shape_is_the_same_to_the_bit_when_turned_or_reflected(stamp: Stamp) -> None:
    dx, dy = lattice(stamp, 40)
    found = kernel_at(stamp, dx, dy)
    for x, y in ((-dx, dy), (dy, dx), (-dy, dx), (-dx, -dy), (dy, -dx)):
        np.testing.assert_array_equal(kernel_at(stamp, x, y), found)


Turn = Callable[[Any, Any], tuple[Any, Any]]
TURNS: list[tuple[float, Turn]] = [
    (90.0, lambda x, y: (-y, x)),
    (180.0, lambda x, y: (-x, -y)),
    (-90.0, lambda x, y: (y, -x)),
    (450.0, lambda x, y: (-y, x)),
]


@pytest.mark.parametrize(("degrees", "turn"), TURNS)
def test_what_is_turned_by_right_angles_is_the_same_to_the_bit(degrees: float, turn: Turn) -> None:
    """Footprints, images and polylines: the shape turned, looked at from where it was turned to."""
    line = [turn(x, y) for x, y in BEND]
    fade: dict[str, Any] = {"size_x": 5.0, "size_y": 2.0, "fade": 1.0, "z": 1.0}
    image = PICTURE.image
    turned: list[tuple[Stamp, Stamp]] = [
        (Trench(0.0, 0.0, BEND, 4.0, 0.5), Trench(0.0, 0.0, line, 4.0, 0.5)),
        (Flatten(0.0, 0.0, **fade), Flatten(0.0, 0.0, **fade, turn_deg=degrees)),
        (
            Texture(0.0, 0.0, image, 5.0, 2.0),
            Texture(0.0, 0.0, image, 5.0, 2.0, turn_deg=degrees),
        ),
    ]
    for before, after in turned:
        dx, dy = lattice(before)
        np.testing.assert_array_equal(kernel_at(after, *turn(dx, dy)), kernel_at(before, dx, dy))


def test_a_turn_is_its_cosine_and_sine() -> None:
    for degrees in (0.0, 30.0, 100.0, 134.9, 170.0, 200.0, 300.0, -20.0, -100.0, 1e4, -1e4):
        expected = (np.cos(np.radians(degrees)), np.sin(np.radians(degrees)))
        assert turn_of(degrees) == pytest.approx(expected, abs=2e-14)
    assert [turn_of(90.0 * i) for i in range(4)] == [(1, 0), (0, 1), (-1, 0), (0, -1)]


def test_an_added_gaussian_ends_where_rounding_ends_it() -> None:
    """At half a count; on the detail grid at half of the finest there may be."""
    for detail, count in ((False, 1e-5), (True, 1e-5 / MAX_FACTOR)):
        stamp = Gaussian(0.0, 0.0, 0.7, 2.0, detail=detail)
        assert 0.7 * np.exp(-(stamp.cut**2) / 8.0) == pytest.approx(count / 2, rel=1e-9)
    assert Gaussian(0.0, 0.0, 4e-6, 2.0).extent == (0.0, 0.0, 0.0, 0.0)


def test_a_polyline_is_the_same_from_either_end() -> None:
    for ends in ("round", "flat"):
        there = Berm(0.0, 0.0, WANDERING, 6.0, 2.0, ends=ends)
        back = Berm(0.0, 0.0, WANDERING[::-1], 6.0, 2.0, ends=ends)
        dx, dy = lattice(there, 80)
        found, expected = kernel_at(back, dx, dy), kernel_at(there, dx, dy)
        np.testing.assert_allclose(found, expected, atol=1e-14, rtol=0.0)


def test_noise_of_one_seed_continues_in_the_stamp_beside_it() -> None:
    """The pattern is fixed to the anchor, and another seed gives another."""
    size: dict[str, Any] = {"size_x": 8.0, "size_y": 8.0}
    left = Noise(0.0, 0.0, 1.0, 3.0, seed=5, octaves=3, **size)
    right = Noise(8.0, 0.0, 1.0, 3.0, seed=5, octaves=3, **size)
    other = Noise(0.0, 0.0, 1.0, 3.0, seed=6, octaves=3, **size)
    y = np.linspace(-4.0, 4.0, 33)
    edge = kernel_at(left, np.full(33, 4.0), y)[0]
    np.testing.assert_array_equal(kernel_at(right, np.full(33, -4.0), y)[0], edge)
    assert np.abs(edge).max() > 0.05
    assert not np.array_equal(kernel_at(other, np.full(33, 4.0), y)[0], edge)


def test_noise_is_nowhere_bent_abruptly() -> None:
    """Second differences shrink with the square of the step across a lattice line."""
    stamp = Noise(0.0, 0.0, 1.0, 1.0, seed=2, radius=4.0)
    x = np.linspace(-0.001, 0.001, 401)
    height = kernel_at(stamp, x, np.full(401, 0.3))[0]
    second = np.diff(height, 2) / (x[1] - x[0]) ** 2
    assert np.abs(np.diff(second)).max() < 0.1
    assert np.abs(second).max() < 60.0


def test_a_fine_polyline_costs_what_is_near() -> None:
    """A million points of a circle: every place finds the circle's distance."""
    turn = np.linspace(0.0, 2 * np.pi, 1_000_000)
    points: Any = np.stack((100 * np.cos(turn), 100 * np.sin(turn)), axis=1)
    points[-1] = points[0]
    stamp = Trench(0.0, 0.0, points, 10.0, 1.0)
    dx, dy = lattice(stamp, 40)
    height, _ = kernel_at(stamp, dx, dy)
    s = np.abs(np.hypot(dx, dy) - 100.0)
    np.testing.assert_allclose(height, -np.maximum(0.0, 1 - s / 5), atol=1e-8)
    assert stamp.volume == pytest.approx(-5.0 * 2 * np.pi * 100, rel=1e-6)
