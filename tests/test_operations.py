"""Operations as journal rows: back to the bit, equal for equal, and never trusted."""

from __future__ import annotations

import json
import math
import struct
import tracemalloc
from collections.abc import Callable
from contextlib import suppress
from dataclasses import fields
from typing import Any

import numpy as np
import pytest
import zstandard

from terrasim.deform import operations
from terrasim.deform.operations import (
    Operation,
    Relaxing,
    Stamping,
    Undoing,
    decode,
    encode,
    summary,
)
from terrasim.deform.patch import Patch
from terrasim.deform.relaxation import Rect
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
from terrasim.store.codec import StoreCorrupt

POINTS = ((0.0, 0.1), (10.0, 1.0 / 3.0), (12.0, -7.0))
IMAGE = HeightImage(
    np.array([[0.0, 1.0, 0.2], [0.3, 1.0 / 3.0, 0.5]]), np.array([[1.0, 1.0, 0.0], [1.0, 1.0, 1.0]])
)
STAMPS: tuple[Stamp, ...] = (
    Gaussian(1.0 / 3.0, -2e-310, 0.1, 2.7),
    Gaussian(-0.0, 1e9, -0.1, 2.7, mode="dig", z=math.pi, detail=True),
    Crater(1.0, 2.0, 3.0, 4.0, 0.5),
    ConeStamp(1.0, 2.0, 3.0, 4.0, mode="replace", z=-1e-9),
    Paraboloid(1.0, 2.0, 3.0, 4.0, mode="blend", z=7.0),
    SphericalCap(1.0, 2.0, 3.0, 1.0, detail=True),
    HalfCosine(1.0, 2.0, 3.0, 4.0, mode="fill", z=0.1),
    Trench(1.0, 2.0, POINTS, 0.7, 1.0),
    Berm(1.0, 2.0, POINTS[:2], 0.7, 1.0),
    Flatten(1.0, 2.0, size_x=30.0, size_y=20.0, fade=1.0, z=5.0),
    Noise(1.0, 2.0, 1.0, 4.0, seed=12345, radius=9.0),
    Texture(1.0, 2.0, IMAGE, 30.0, 20.0),
)
COUNTS = np.array([[1, -2, 3], [2**30, 0, -(2**30)]], np.int32)
EVERY: dict[str, Operation] = {
    "one stamp": Stamping(STAMPS[:1]),
    "all stamps": Stamping(STAMPS, (-(2**30), 2**30)),
    "no stamps": Stamping(()),
    "patch": Patch(-5, 2**30, COUNTS),
    "detail patch": Patch(7, -9, COUNTS[:1, :1], detail=True),
    "relaxation": Relaxing((Rect(-1, 2, 3, 400), Rect(5, 6, 7, 8)), 100.0 / 3.0, 12),
    "detail relaxation": Relaxing((Rect(0, 1, 0, 1),), 0.0, 1, True),
    "undo of stamps": Undoing(2**39, Stamping((STAMPS[7], STAMPS[0]), (3, 4))),
    "undo of a patch": Undoing(1, Patch(1, 2, COUNTS)),
}
all_of_them = pytest.mark.parametrize("operation", EVERY.values(), ids=EVERY.keys())


any_stamping: Any = Stamping
any_patch: Any = Patch
any_relaxing: Any = Relaxing
any_rect: Any = Rect


def bits(value: Any) -> Any:
    """Everything a value consists of, its floats by their bits."""
    if isinstance(value, float):
        return struct.pack("<d", value)
    if isinstance(value, np.ndarray):
        return (str(value.dtype), value.shape, value.tobytes())
    if hasattr(value, "__dataclass_fields__"):
        return (type(value), [(one.name, bits(getattr(value, one.name))) for one in fields(value)])
    return tuple(bits(one) for one in value) if isinstance(value, tuple | list) else value


def row_of(header: Any, body: bytes = b"", *, packed: bytes | None = None) -> bytes:
    """A row as somebody else might have written it."""
    text = json.dumps(header).encode()
    frame = (zstandard.compress(body) if body else b"") if packed is None else packed
    return b"TSO1" + struct.pack("<I", len(text)) + text + frame


def header_of(operation: Operation) -> Any:
    row = encode(operation)
    return json.loads(row[8 : 8 + struct.unpack_from("<I", row, 4)[0]])


@all_of_them
def test_an_operation_comes_back_to_the_bit(operation: Operation) -> None:
    back = decode(encode(operation))
    assert type(back) is type(operation)
    assert bits(back) == bits(operation)
    assert summary(back) == summary(operation)


def test_every_stamp_is_among_them() -> None:
    assert {type(stamp) for stamp in STAMPS} == set(REGISTRY.values())


@all_of_them
def test_equal_operations_give_equal_bytes(operation: Operation) -> None:
    """Also what was read and written again, so that a key stands for the same thing for ever."""
    row = encode(operation)
    assert encode(decode(row)) == row
    assert sum(row == encode(other) for other in EVERY.values()) == 1


def test_how_numbers_are_held_does_not_show() -> None:
    """Whole numbers of NumPy, a list for a tuple, columns before rows."""
    stamp = Gaussian(1, 2, 1, 3)
    assert encode(any_stamping((stamp,), (np.int64(3), np.int32(-4)))) == encode(
        Stamping((Gaussian(1.0, 2.0, 1.0, 3.0),), (3, -4))
    )
    patch = any_patch(np.int64(3), 4, np.asfortranarray(COUNTS))
    assert encode(patch) == encode(Patch(3, 4, COUNTS))
    regions = (Rect(0, 9, 0, 9),)
    assert encode(Relaxing(regions, 30, 5)) == encode(Relaxing(regions, np.float64(30.0), 5))


def test_a_summary_is_a_few_words() -> None:
    assert summary(EVERY["patch"]) == "patch of 2 x 3 posts"
    assert summary(EVERY["detail patch"]) == "patch of 1 x 1 detail posts"
    assert summary(EVERY["relaxation"]) == "relax to 33.3333 degrees"
    two = Stamping((STAMPS[0], STAMPS[0], STAMPS[1]))
    assert summary(Undoing(7, two)) == "undo 7: 2 x add gaussian, 1 x dig gaussian"


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: any_stamping((1,)), "stamps must be stamps, got 1"),
        (lambda: any_stamping((), (0.5, 0)), r"anchor must be two whole numbers .* got \(0.5, 0\)"),
        (lambda: any_stamping((), (0, 0, 0)), "anchor must be two whole numbers"),
        (lambda: any_stamping((), (True, 0)), "anchor must be two whole numbers"),
        (lambda: any_stamping((), (2**40, 0)), "anchor must be two whole numbers"),
        (lambda: any_stamping((), (math.nan, 0)), "anchor must be two whole numbers"),
        (lambda: any_patch(0.5, 0, COUNTS), "a patch's row must be a whole number, got 0.5"),
        (lambda: any_patch(0, True, COUNTS), "a patch's col must be a whole number, got True"),
        (lambda: any_patch(0, 0, COUNTS, 1), "a patch's detail must be true or false, got 1"),
        (lambda: any_relaxing((), math.nan, 1), "angle_deg must be from 0 to 89 degrees, got nan"),
        (lambda: any_relaxing((), 90.0, 1), "angle_deg must be from 0 to 89 degrees, got 90.0"),
        (lambda: any_relaxing((), "steep", 1), "angle_deg must be a number, got 'steep'"),
        (lambda: any_relaxing((), 30.0, 0), "iterations must be a whole number, at least 1, got 0"),
        (lambda: any_relaxing((), 30.0, 1.5), "iterations must be a whole number"),
        (lambda: any_relaxing((), 30.0, 1, "no"), "detail must be true or false, got 'no'"),
        (lambda: any_relaxing((any_rect(0, 1, 0, 1.5),), 30.0, 1), "a region's ends must be whole"),
    ],
)
def test_numbers_that_are_none_make_no_operation(make: Callable[[], Any], said: str) -> None:
    with pytest.raises(InputError, match=said):
        make()


def test_arrays_that_no_row_holds_are_refused_before_they_are_written(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What could not be read again is not acknowledged."""
    monkeypatch.setattr(operations, "MAX_ARRAY_BYTES", COUNTS.nbytes)
    assert bits(decode(encode(Patch(0, 0, COUNTS)))) == bits(Patch(0, 0, COUNTS))
    with pytest.raises(InputError, match="holds 28 bytes of arrays, at most 24 fit"):
        encode(Patch(0, 0, np.zeros((1, 7), np.int32)))


@all_of_them
def test_a_row_cut_short_or_grown_is_damaged(operation: Operation) -> None:
    row = encode(operation)
    for end in range(len(row)):
        with pytest.raises(StoreCorrupt, match=r"^a journal row of \d+ bytes is no operation: "):
            decode(row[:end])
    for more in (b"\0", row, zstandard.compress(b"more")):
        with pytest.raises(StoreCorrupt):
            decode(row + more)


@all_of_them
def test_a_flipped_bit_is_no_surprise(operation: Operation) -> None:
    """It is damaged, or some other operation; the hash of the journal tells the second."""
    row = encode(operation)
    rng = np.random.default_rng(3)
    for at in rng.integers(0, 8 * len(row), 400).tolist():
        flipped = bytearray(row)
        flipped[at >> 3] ^= 1 << (at & 7)
        with suppress(StoreCorrupt):
            decode(bytes(flipped))


_PATCH = {"op": "patch", "row": 0, "col": 0, "detail": False, "arrays": [["int32", [1, 2]]]}
_RELAX = header_of(EVERY["relaxation"])
_STAMP = header_of(Stamping(STAMPS[:1]))
_TRENCH = header_of(Stamping((STAMPS[7],)))
_UNDO = header_of(EVERY["undo of a patch"])


@pytest.mark.parametrize(
    ("header", "body"),
    [
        (None, b""),
        (3, b""),
        ([], b""),
        ("op", b""),
        ({}, b""),
        ({"op": "patch"}, b""),
        ({"op": "rise", "arrays": []}, b""),
        ({"op": [], "arrays": []}, b""),
        (_PATCH | {"row": 0.5}, bytes(8)),
        (_PATCH | {"more": 1}, bytes(8)),
        (_PATCH | {"detail": 1}, bytes(8)),
        (_PATCH | {"arrays": []}, b""),
        (_PATCH | {"arrays": [["int32", [2]]]}, bytes(8)),
        (_PATCH | {"arrays": [["float64", [1, 1]]]}, bytes(8)),
        (_PATCH | {"arrays": [["int64", [1, 1]]]}, bytes(8)),
        (_PATCH | {"arrays": [["int32", [1, 2]], ["int32", [0, 0]]]}, bytes(8)),
        (_PATCH | {"arrays": [["int32", [-1, -2]]]}, bytes(8)),
        (_PATCH | {"arrays": [["int32", [1.0, 2]]]}, bytes(8)),
        (_PATCH | {"arrays": [["int32", [True, 2]]]}, bytes(8)),
        (_PATCH | {"arrays": [["int32", [2**40, 2**40]]]}, bytes(8)),
        (_PATCH | {"arrays": [["int32", [1, 2], 3]]}, bytes(8)),
        (_PATCH | {"arrays": [["int32", 2]]}, bytes(8)),
        (_PATCH, bytes(12)),
        (_PATCH, bytes(4)),
        (_PATCH, np.array([0, -(2**31)], np.int32).tobytes()),
        (_RELAX | {"angle_deg": math.nan}, b""),
        (_RELAX | {"angle_deg": "1"}, b""),
        (_RELAX | {"iterations": 0}, b""),
        (_RELAX | {"regions": [[1, 2, 3]]}, b""),
        (_RELAX | {"regions": [[0.0, 2, 3, 4]]}, b""),
        (_RELAX | {"regions": 5}, b""),
        (_RELAX | {"arrays": [["int32", [2]]]}, bytes(8)),
        (_STAMP | {"anchor": [0]}, b""),
        (_STAMP | {"anchor": [0, 1e9]}, b""),
        (_STAMP | {"more": 0}, b""),
        (_STAMP | {"stamps": [[_STAMP["stamps"][0][0], 1]]}, b""),
        (_STAMP | {"stamps": [[_STAMP["stamps"][0][0], -1]]}, b""),
        (_STAMP | {"stamps": [[{"kind": "gaussian", "fields": {}}, 0]]}, b""),
        (_STAMP | {"stamps": [["gaussian", 0]]}, b""),
        (_STAMP | {"arrays": [["int32", [2]]]}, bytes(8)),
        (_TRENCH | {"arrays": [["float64", [1, 2]]]}, bytes(16)),
        (_TRENCH | {"arrays": [["float64", [2, 3]]]}, bytes(48)),
        (_TRENCH | {"arrays": [["float64", [3, 2]]]}, np.full(6, math.nan).tobytes()),
        (_UNDO | {"seq": "1"}, COUNTS.tobytes()),
        (_UNDO | {"more": 1}, COUNTS.tobytes()),
        (_UNDO | {"of": {"op": "relax"}}, COUNTS.tobytes()),
        (_UNDO | {"of": dict(_UNDO["of"], op="undo")}, COUNTS.tobytes()),
    ],
)
def test_a_row_that_says_what_cannot_be_is_damaged(header: Any, body: bytes) -> None:
    with pytest.raises(StoreCorrupt, match="is no operation"):
        decode(row_of(header, body))


def test_the_rows_they_are_made_from_are_sound() -> None:
    decode(row_of(_PATCH, bytes(8)))
    decode(row_of(_RELAX))
    decode(row_of(_STAMP))
    decode(row_of(_TRENCH, np.array(POINTS).tobytes()))
    decode(row_of(_UNDO, COUNTS.tobytes()))


def test_a_row_nested_without_end_is_damaged() -> None:
    text = b"[" * 100_000
    with pytest.raises(StoreCorrupt, match="is no operation"):
        decode(b"TSO1" + struct.pack("<I", len(text)) + text)


def test_nothing_is_allocated_on_the_word_of_a_row() -> None:
    """Neither the header's, nor the frame's, nor both together; 256 MiB are claimed."""
    size = 1 << 26
    header = _PATCH | {"arrays": [["int32", [1, size]]]}
    real = zstandard.compress(bytes(4 * size))
    # Magic and descriptor of a frame of one segment whose content size takes 8 bytes, no blocks.
    claims = b"\x28\xb5\x2f\xfd\xe0" + struct.pack("<Q", 4 * size)
    tracemalloc.start()
    try:
        for packed in (b"", zstandard.compress(bytes(8)), claims, claims + b"\x01\0\0", real[:50]):
            with pytest.raises(StoreCorrupt):
                decode(row_of(header, packed=packed))
        with pytest.raises(StoreCorrupt):
            decode(row_of(_PATCH, packed=real))
        assert tracemalloc.get_traced_memory()[1] < 1 << 20
    finally:
        tracemalloc.stop()
