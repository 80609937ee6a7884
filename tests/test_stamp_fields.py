"""What a stamp refuses: every number, before anything is made of it."""

from __future__ import annotations

import math
import re
import tracemalloc
from collections.abc import Callable
from dataclasses import fields
from typing import Any

import numpy as np
import pytest

from terrasim.deform.shapes.checks import types_of
from terrasim.deform.shapes.polyline import MAX_POINTS
from terrasim.deform.stamps import (
    REGISTRY,
    Berm,
    ConeStamp,
    Crater,
    Flatten,
    Gaussian,
    HalfCosine,
    HeightImage,
    Noise,
    Paraboloid,
    SphericalCap,
    Stamp,
    Texture,
    Trench,
)
from terrasim.errors import InputError

LINE = [(0.0, 0.0), (3.0, 4.0)]
IMAGE = HeightImage(np.eye(3))
GOOD: dict[str, dict[str, Any]] = {
    "gaussian": {"amplitude": 1.0, "sigma": 2.0},
    "crater": {"radius": 3.0, "depth": 1.0, "rim_height": 0.2},
    "cone": {"radius": 3.0, "height": 1.0},
    "paraboloid": {"radius": 3.0, "height": 1.0},
    "spherical_cap": {"radius": 3.0, "height": 1.0},
    "half_cosine": {"radius": 3.0, "height": 1.0},
    "trench": {"points": LINE, "width": 2.0, "depth": 1.0, "section": "box", "side": 0.5},
    "berm": {"points": LINE, "width": 2.0, "height": 1.0, "section": "box", "side": 0.5},
    "flatten": {"z": 3.0, "size_x": 3.0, "size_y": 4.0, "fade": 1.0},
    "noise": {"amplitude": 1.0, "wavelength": 2.0, "radius": 5.0, "fade": 1.0},
    "texture": {"image": IMAGE, "size_x": 3.0, "size_y": 4.0},
}


def good(name: str, **changed: Any) -> Stamp:
    return REGISTRY[name](**{"x": 1.0, "y": -2.0, **GOOD[name], **changed})


NUMBERS = [
    (name, field)
    for name, kind in REGISTRY.items()
    for field, of in types_of(kind).items()
    if of in {float, int} or of == float | None
]


@pytest.mark.parametrize(("name", "field"), NUMBERS)
def test_every_number_of_every_stamp_must_be_one(name: str, field: str) -> None:
    """Not a number, infinite, beyond a float, a word, a flag, nothing: named with its value."""
    good(name)
    mode = {"mode": "dig"} if field == "z" else {}
    for bad in (math.nan, math.inf, -math.inf, 10**400, "7", True, [1.0]):
        with pytest.raises(InputError) as caught:
            good(name, **{field: bad}, **mode)
        message = str(caught.value)
        assert message.startswith(f"{name}: {field} must ")
        shown = str(bad) if bad != 10**400 else "1000000000"
        assert f", got {shown}" in message
        assert "\n" not in message
        assert len(message) < 200


SIZES = [
    (name, field)
    for name, field in NUMBERS
    if field in {"sigma", "radius", "width", "wavelength", "size_x", "size_y"}
]


@pytest.mark.parametrize(("name", "field"), SIZES)
@pytest.mark.parametrize("bad", [0.0, -1.0, -0.0, 1e-300, 1.1e9])
def test_every_size_is_above_nothing_and_has_an_end(name: str, field: str, bad: float) -> None:
    other = {"size_x": None, "size_y": None} if field == "radius" else {"radius": None}
    settings = {**GOOD[name], field: bad}
    if name in {"flatten", "noise"}:
        settings |= {"size_x": 3.0, "size_y": 4.0} | other | {field: bad}
    told = rf"{name}: {field} must lie between 1e-06 and 1e\+09 m, got {re.escape(str(bad))}"
    with pytest.raises(InputError, match=told):
        REGISTRY[name](x=0.0, y=0.0, **settings)


@pytest.mark.parametrize("name", list(REGISTRY))
def test_how_it_meets_the_ground_is_checked(name: str) -> None:
    at_z = {} if name == "flatten" else {"z": None}
    with pytest.raises(InputError, match=rf"{name}: mode must be add or .*, got 'carve'"):
        good(name, mode="carve")
    with pytest.raises(InputError, match=rf"{name}: mode must be add or .*, got 3"):
        good(name, mode=3)
    for mode in ("dig", "fill", "replace", "blend"):
        with pytest.raises(InputError, match=rf"{name}: z must be given for mode {mode}.*None"):
            good(name, **{**at_z, "mode": mode, "z": None})
        assert good(name, mode=mode, z=-7).z == -7.0
    told = "mode must be blend or dig" if name == "flatten" else "z must be left out for mode add"
    with pytest.raises(InputError, match=f"{name}: {told}"):
        good(name, mode="add", z=3.0)
    with pytest.raises(InputError, match=rf"{name}: z must stay within 1e\+09 m, got 2000000000.0"):
        good(name, mode="dig", z=2e9)
    with pytest.raises(InputError, match=rf"{name}: detail must be true or false, got 1"):
        good(name, detail=1)


BAD: list[tuple[Callable[[], Stamp], str]] = [
    (lambda: Gaussian(0.0, 0.0, 3e4, 1.0), "gaussian: amplitude must stay within 21475 m, got 30"),
    (lambda: Crater(0.0, 0.0, 1.0, -1.0), "crater: depth must be at least 0 m, got -1.0"),
    (lambda: Crater(0.0, 0.0, 1.0, 1.0, -0.1), "rim_height must be at least 0 m, got -0.1"),
    (
        lambda: Crater(0.0, 0.0, 1.0, 1.0, 0.1, balanced=True),
        "crater: rim_height must be left out of a balanced crater.* got 0.1",
    ),
    (lambda: ConeStamp(0.0, 0.0, 1.0, -3e4), "cone: height must stay within 21475 m, got -30000"),
    (lambda: Paraboloid(0.0, 0.0, 1.0, 3e4), "paraboloid: height must stay within"),
    (lambda: HalfCosine(0.0, 0.0, 1.0, 3e4), "half_cosine: height must stay within"),
    (
        lambda: SphericalCap(0.0, 0.0, 1.0, -1.5),
        r"spherical_cap: height must be at most the radius \(1 m\).* got -1.5",
    ),
    (lambda: Trench(0.0, 0.0, LINE, 1.0, -1.0), "trench: depth must be at least 0 m, got -1.0"),
    (lambda: Berm(0.0, 0.0, LINE, 1.0, -1.0), "berm: height must be at least 0 m, got -1.0"),
    (lambda: Trench(0.0, 0.0, LINE, 1.0, 3e4), "trench: depth must stay within 21475 m"),
    (
        lambda: Trench(0.0, 0.0, LINE, 1.0, 0.6, section="round"),
        r"trench: depth must be at most half the width \(1 m\) .*, got 0.6",
    ),
    (
        lambda: Trench(0.0, 0.0, LINE, 1.0, 1.0, side=0.1),
        "trench: side must be left out of section v, got 0.1",
    ),
    (
        lambda: Berm(0.0, 0.0, LINE, 1.0, 1.0, section="box", side=0.6),
        r"berm: side must be at most half the width \(1 m\), got 0.6",
    ),
    (
        lambda: Trench(0.0, 0.0, LINE, 1.0, 1.0, section="u"),  # type: ignore[arg-type]
        "trench: section must be v or box or round, got 'u'",
    ),
    (
        lambda: Trench(0.0, 0.0, LINE, 1.0, 1.0, ends="open"),  # type: ignore[arg-type]
        "trench: ends must be round or flat, got 'open'",
    ),
    (
        lambda: Flatten(0.0, 0.0, mode="add", radius=1.0),
        "flatten: mode must be blend or dig or fill or replace, got 'add'",
    ),
    (lambda: Flatten(0.0, 0.0, z=1.0), "flatten: size_x must be given.* got None"),
    (lambda: Flatten(0.0, 0.0, z=1.0, size_x=1.0), "flatten: size_y must be given.* got None"),
    (
        lambda: Flatten(0.0, 0.0, z=1.0, radius=1.0, size_y=2.0),
        "flatten: size_y must be left out beside radius, got 2.0",
    ),
    (
        lambda: Flatten(0.0, 0.0, z=1.0, radius=1.0, fade=-1.0),
        "flatten: fade must be at least 0 m, got -1.0",
    ),
    (
        lambda: Flatten(0.0, 0.0, z=1.0, radius=1e6, slope_y=-1.0),
        "flatten: slope_y must keep the plane within 21475 m of z over its footprint, got -1.0",
    ),
    (lambda: Noise(0.0, 0.0, 1.0, 1.0), "noise: size_x must be given"),
    (lambda: Noise(0.0, 0.0, 3e4, 1.0, radius=1.0), "noise: amplitude must stay within"),
    (
        lambda: Noise(0.0, 0.0, 1.0, 1.0, radius=1.0, seed=-1),
        r"noise: seed must lie between 0 and 2\^63 - 1, got -1",
    ),
    (lambda: Noise(0.0, 0.0, 1.0, 1.0, radius=1.0, seed=2**63), "noise: seed must lie between"),
    (
        lambda: Noise(0.0, 0.0, 1.0, 1.0, radius=1.0, octaves=17),
        "noise: octaves must lie between 1 and 16, got 17",
    ),
    (lambda: Noise(0.0, 0.0, 1.0, 1.0, radius=1.0, octaves=0), "noise: octaves must lie"),
    (lambda: Noise(0.0, 0.0, 1.0, 1.0, radius=1.0, gain=0.0), "noise: gain must be above 0"),
    (lambda: Noise(0.0, 0.0, 1.0, 1.0, radius=1.0, gain=1.5), "noise: gain must be above 0"),
    (
        lambda: Noise(1e15, 0.0, 1.0, 1e-3, radius=1.0),
        r"noise: wavelength must be longer, 1e\+15 m from the anchor, for 1 octaves, got 0.001",
    ),
    (
        lambda: Texture(0.0, 0.0, IMAGE, 1.0, 1.0, scale=3e4),
        "texture: scale must keep the image's heights within 21475 m, got 30000.0 for 30000 m",
    ),
    (
        lambda: Texture(0.0, 0.0, IMAGE, 1.0, 1.0, scale=1e300, intensity=1e300),
        "texture: scale must keep the image's heights within",
    ),
]


@pytest.mark.parametrize(("make", "said"), BAD)
def test_a_bad_stamp_is_refused(make: Callable[[], Stamp], said: str) -> None:
    """The message names stamp, field, rule and value."""
    with pytest.raises(InputError, match=said):
        make()


POINTS: list[tuple[Any, str]] = [
    ([(0.0, 0.0)], r"points must hold 2 to 1000000 places, got 1"),
    ([], r"points must hold 2 to 1000000 places, got 0"),
    (7, r"points must be a list of pairs, got 7"),
    ([(0.0, 0.0), (1.0,)], r"points must be pairs of numbers, got"),
    ([(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)], r"points must be pairs of numbers, got"),
    ([("0", "0"), ("1", "1")], r"points must be pairs of numbers, got"),
    ([(True, False), (False, True)], r"points must be pairs of numbers, got"),
    ([(0.0, 0.0), (10**400, 1.0)], r"points must be pairs of numbers, got"),
    ([(0.0, 0.0), (math.nan, 1.0)], r"points\[2\] must be finite numbers within .*\[nan, 1.0\]"),
    ([(0.0, math.inf), (1.0, 1.0)], r"points\[1\] must be finite numbers within .*\[0.0, inf\]"),
    ([(0.0, 0.0), (1e10, 0.0)], r"points\[2\] must be finite numbers within 1e\+09 m"),
    ([(0.0, 0.0), (1.0, 1.0), (1.0, 1.0)], r"points\[3\] must lie at least 1e-06 m from the poi"),
]


@pytest.mark.parametrize(("points", "said"), POINTS)
@pytest.mark.parametrize("kind", [Trench, Berm])
def test_what_is_no_polyline_is_refused(kind: Any, points: Any, said: str) -> None:
    with pytest.raises(InputError, match=f"{kind.name}: {said}"):
        kind(0.0, 0.0, points, 1.0, 1.0)


def test_too_many_points_are_refused_before_they_are_copied() -> None:
    points = np.broadcast_to(np.zeros(2), (50_000_000, 2))
    tracemalloc.start()
    with pytest.raises(InputError, match=f"hold 2 to {MAX_POINTS} places, got 50000000"):
        Trench(0.0, 0.0, points, 1.0, 1.0)  # type: ignore[arg-type]
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 1 << 20


def test_whole_numbers_may_stand_for_any_and_lists_and_arrays_for_points() -> None:
    """The same stamp, its fields floats and pairs."""
    plain = Trench(1.0, 2.0, ((0.0, 0.0), (3.0, 4.0)), 1.0, 1.0)
    assert Trench(1, 2, [[0, 0], [3, 4]], 1, 1) == plain  # type: ignore[list-item]
    assert Trench(1, 2, np.array(LINE), 1, 1) == plain  # type: ignore[arg-type]
    assert Trench(np.float64(1), 2, LINE, 1, 1) == plain
    assert all(type(getattr(plain, one.name)) is not int for one in fields(plain))


def test_only_what_all_stamps_have_must_be_named() -> None:
    """Places and shapes may be given in order, the rest by name."""
    with pytest.raises(TypeError, match="positional"):
        Gaussian(0.0, 0.0, 1.0, 1.0, "add")  # type: ignore[call-arg]
