"""Stamps as plain values and arrays, for journals, files and the wire, and back to the bit.

A stamp is ``{"kind": name, "fields": {...}}`` and its arrays, float64: the points of a polyline,
the samples of an image and its weights. Everything else is a number, a word, a flag or None; JSON
keeps each float's bits. What comes back is held against the same rules as any other stamp.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, fields
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.deform.shapes.height_image import HeightImage
from terrasim.deform.stamps import REGISTRY, Stamp
from terrasim.errors import InputError

Arrays = list[npt.NDArray[np.float64]]

POINTS, IMAGE = "points", "image"
"""Fields that travel as arrays."""


def encode(stamp: Stamp) -> tuple[dict[str, Any], Arrays]:
    """A stamp as a table ready for JSON, and its arrays, float64."""
    plain: dict[str, Any] = {}
    arrays: Arrays = []
    for one in fields(stamp):
        value = getattr(stamp, one.name)
        if one.name == POINTS:
            arrays.append(np.asarray(value, dtype=np.float64))
        elif one.name == IMAGE:
            arrays += value.arrays
        else:
            plain[one.name] = value
    return {"kind": stamp.name, "fields": plain}, arrays


def decode(table: Any, arrays: Sequence[npt.NDArray[Any]]) -> Stamp:
    """The stamp of a table and its arrays.

    Args:
        table: ``kind`` and ``fields``, as :func:`encode` gives them; fields with a default may be
            missing.
        arrays: Its arrays.

    Raises:
        InputError: If it is no stamp.
    """
    if not isinstance(table, dict) or set(table) != {"kind", "fields"}:
        raise InputError(f"a stamp must be a table of kind and fields, got {_shown(table)}")
    kind = kind_named(table["kind"])
    plain = table["fields"]
    if not isinstance(plain, dict):
        raise InputError(f"{kind.name}: fields must be a table, got {_shown(plain)}")
    own = _from_arrays(kind, arrays)
    names = {one.name for one in fields(kind)} - set(own)
    for name in plain:
        if name not in names:
            raise InputError(f"{kind.name}: {name} is unknown: it takes {', '.join(sorted(names))}")
    given = plain | own
    for one in fields(kind):
        if one.default is MISSING and one.name not in given:
            raise InputError(f"{kind.name}: {one.name} is missing: add it")
    return kind(**given)


def kind_named(name: Any) -> type[Stamp]:
    """The stamp of a name.

    Raises:
        InputError: If there is none.
    """
    if not isinstance(name, str) or name not in REGISTRY:
        raise InputError(f"kind must be one of {', '.join(REGISTRY)}, got {_shown(name)}")
    return REGISTRY[name]


def _from_arrays(kind: type[Stamp], arrays: Sequence[npt.NDArray[Any]]) -> dict[str, Any]:
    """The fields that travel as arrays."""
    names = {one.name for one in fields(kind)} & {POINTS, IMAGE}
    allowed = {1: (POINTS in names) or (IMAGE in names), 2: IMAGE in names, 0: not names}
    if not allowed.get(len(arrays), False):
        raise InputError(
            f"{kind.name}: its arrays are {' or '.join(names) or 'none'}, got {len(arrays)} of them"
        )
    if POINTS in names:
        return {POINTS: arrays[0]}
    return {IMAGE: HeightImage(*arrays)} if names else {}


def _shown(value: object) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."
