"""Stamps as tables and arrays: the same stamp comes back, and nothing else gets through."""

from __future__ import annotations

import json
import math
from typing import Any

import numpy as np
import pytest
from shape_formulas import FORMULAS

from terrasim.deform.stamp_schema import decode, encode
from terrasim.deform.stamps import Crater, Gaussian, HeightImage, Stamp, Texture, Trench
from terrasim.errors import InputError

STAMPS = [stamp for stamp, _, _ in FORMULAS]
AWKWARD: list[Stamp] = [
    Gaussian(math.pi * 1e9, -0.1, 5e-324, math.nextafter(1.0, 2.0)),
    Gaussian(-0.0, 0.1 + 0.2, 1 / 3, 1e-6, mode="dig", z=-0.0),
]


@pytest.mark.parametrize("stamp", STAMPS + AWKWARD, ids=lambda stamp: stamp.name)
def test_a_stamp_comes_back_to_the_bit(stamp: Stamp) -> None:
    """Through the text of a JSON file."""
    table, arrays = encode(stamp)
    back = decode(json.loads(json.dumps(table, allow_nan=False)), arrays)
    assert back == stamp
    assert repr(back) == repr(stamp)
    assert np.array(back.shape).tobytes() == np.array(stamp.shape).tobytes()
    assert back.data.tobytes() == stamp.data.tobytes()
    assert all(array.dtype == np.float64 for array in arrays)


def test_a_stamp_is_read_with_what_it_leaves_out() -> None:
    table = {"kind": "crater", "fields": {"x": 1, "y": 2, "radius": 3, "depth": 1}}
    assert decode(table, []) == Crater(1.0, 2.0, 3.0, 1.0)


GOOD = {"x": 1.0, "y": 2.0, "radius": 3.0, "depth": 1.0}
BAD: list[tuple[Any, list[Any], str]] = [
    (None, [], "a stamp must be a table of kind and fields, got None"),
    ({"kind": "crater"}, [], "a stamp must be a table of kind and fields"),
    ({"kind": "hat", "fields": {}}, [], "kind must be one of gaussian, crater, .* got 'hat'"),
    ({"kind": ["crater"], "fields": {}}, [], r"kind must be one of .* got \['crater'\]"),
    ({"kind": "crater", "fields": []}, [], r"crater: fields must be a table, got \[\]"),
    ({"kind": "crater", "fields": GOOD | {"hue": 1}}, [], "crater: hue is unknown: it takes bal"),
    ({"kind": "crater", "fields": {"x": 1.0}}, [], "crater: y is missing: add it"),
    ({"kind": "crater", "fields": GOOD | {"x": "1"}}, [], "crater: x must be a finite number"),
    ({"kind": "crater", "fields": GOOD}, [np.zeros((2, 2))], "crater: its arrays are none, got 1"),
    ({"kind": "trench", "fields": {}}, [], "trench: its arrays are points, got 0"),
    ({"kind": "trench", "fields": {}}, [np.zeros((2, 2))] * 2, "trench: its arrays are points"),
    ({"kind": "texture", "fields": {}}, [np.zeros((2, 2))] * 3, "texture: its arrays are image"),
    ({"kind": "texture", "fields": {}}, [np.zeros(2)], "image: samples must be numbers of 2 x 2"),
    (
        {"kind": "trench", "fields": {"points": [[0, 0], [1, 1]]}},
        [np.zeros((2, 2))],
        "trench: points is unknown",
    ),
]


@pytest.mark.parametrize(("table", "arrays", "said"), BAD)
def test_what_is_no_stamp_is_refused(table: Any, arrays: list[Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        decode(table, arrays)


def test_stamps_of_the_same_content_are_equal() -> None:
    """Also those that hold arrays; so they can be kept in a set."""
    image = np.arange(6.0).reshape(2, 3)
    one, other = (Texture(0.0, 0.0, HeightImage(image.copy()), 1.0, 1.0) for _ in range(2))
    assert one == other
    assert len({one, other}) == 1
    assert one != Texture(0.0, 0.0, HeightImage(image + 1.0), 1.0, 1.0)
    assert one != Texture(0.0, 0.0, HeightImage(image, np.ones((2, 3))), 1.0, 1.0)
    line = [(0.0, 0.0), (1.0, 0.0)]
    assert Trench(0.0, 0.0, line, 1.0, 1.0) == Trench(0.0, 0.0, np.array(line), 1.0, 1.0)  # type: ignore[arg-type]
