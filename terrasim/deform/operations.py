"""Operations: what is done to the ground, as values that a journal can keep and do again.

A journal row is ``TSO1``, the length of a JSON header (u32), the header, and the arrays it speaks
of as one zstd frame. Everything that decides the result is in it: doing it again on the same ground
gives the same bits.
"""

from __future__ import annotations

import json
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import zstandard

from terrasim.deform.anchored import Anchor
from terrasim.deform.patch import Patch
from terrasim.deform.relaxation import Rect
from terrasim.deform.stamp_schema import decode as decode_stamp
from terrasim.deform.stamp_schema import encode as encode_stamp
from terrasim.deform.stamps import Stamp
from terrasim.errors import InputError
from terrasim.store.codec import StoreCorrupt

Array = npt.NDArray[Any]

MAX_ARRAY_BYTES = 1 << 30
"""Bytes of arrays that an operation may hold: nothing larger is allocated on a file's word."""
_MAGIC = b"TSO1"
_LENGTH = struct.Struct("<I")
_TYPES = {"int32": np.int32, "float64": np.float64}


@dataclass(frozen=True)
class Stamping:
    """Stamps, made one after another."""

    stamps: tuple[Stamp, ...]
    """The stamps, their places in metres from the anchor."""
    anchor: Anchor = (0, 0)
    """Level-0 post (row, column) that their places start from."""

    @property
    def additive(self) -> bool:
        """Whether it can be taken back exactly, and wait."""
        return all(stamp.mode == "add" for stamp in self.stamps)


@dataclass(frozen=True)
class Relaxing:
    """Ground slumps to its angle of repose."""

    regions: tuple[Rect, ...]
    """Where: rectangles of posts."""
    angle_deg: float
    """Angle of repose [degrees]."""
    iterations: int
    """Most iterations."""
    detail: bool = False
    """Whether the posts are the detail grid's."""


@dataclass(frozen=True)
class Undoing:
    """An earlier operation is taken back."""

    seq: int
    """Its number in the journal."""
    operation: Stamping | Patch
    """The operation itself, so that the row stands alone."""


Operation = Stamping | Patch | Relaxing | Undoing


def summary(operation: Operation) -> str:
    """What an operation does, in a few words for a list."""
    if isinstance(operation, Stamping):
        counts = Counter(f"{stamp.mode} {stamp.name}" for stamp in operation.stamps)
        return ", ".join(f"{count} x {name}" for name, count in counts.items())
    if isinstance(operation, Patch):
        rows, cols = operation.counts.shape
        return f"patch of {rows} x {cols} {'detail ' if operation.detail else ''}posts"
    if isinstance(operation, Relaxing):
        return f"relax to {operation.angle_deg:g} degrees"
    return f"undo {operation.seq}: {summary(operation.operation)}"


def encode(operation: Operation) -> bytes:
    """An operation as bytes; equal operations give equal bytes."""
    arrays: list[Array] = []
    header = _header(operation, arrays)
    header["arrays"] = [[str(one.dtype), list(one.shape)] for one in arrays]
    text = json.dumps(header, allow_nan=False, separators=(",", ":"), sort_keys=True).encode()
    body = b"".join(np.ascontiguousarray(one).tobytes() for one in arrays)
    packed = zstandard.compress(body) if body else b""
    return _MAGIC + _LENGTH.pack(len(text)) + text + packed


def decode(row: bytes) -> Operation:
    """The operation of a journal row.

    Raises:
        StoreCorrupt: If the row is not one that ``encode`` wrote.
    """
    start = len(_MAGIC) + _LENGTH.size
    try:
        if row[: len(_MAGIC)] != _MAGIC:
            raise ValueError("it does not begin as an operation")
        end = start + _LENGTH.unpack_from(row, len(_MAGIC))[0]
        header = json.loads(row[start:end])
        arrays = _arrays(header.pop("arrays"), row[end:])
        return _READERS[header.pop("op")](header, arrays)
    except (
        ValueError,
        KeyError,
        TypeError,
        InputError,
        struct.error,
        zstandard.ZstdError,
    ) as error:
        raise StoreCorrupt(f"a journal row of {len(row)} bytes is no operation: {error}") from None


def _header(operation: Operation, arrays: list[Array]) -> dict[str, Any]:
    """The operation's header; its arrays are added to the list."""
    if isinstance(operation, Stamping):
        stamps = []
        for stamp in operation.stamps:
            fields, own = encode_stamp(stamp)
            stamps.append([fields, len(own)])
            arrays += own
        return {"op": "stamps", "anchor": list(operation.anchor), "stamps": stamps}
    if isinstance(operation, Patch):
        arrays.append(operation.counts)
        place = {"row": operation.row, "col": operation.col, "detail": operation.detail}
        return {"op": "patch", **place}
    if isinstance(operation, Relaxing):
        return {
            "op": "relax",
            "regions": [list(region) for region in operation.regions],
            "angle_deg": operation.angle_deg,
            "iterations": operation.iterations,
            "detail": operation.detail,
        }
    return {"op": "undo", "seq": operation.seq, "of": _header(operation.operation, arrays)}


def _arrays(said: Sequence[tuple[str, list[int]]], packed: bytes) -> list[Array]:
    """The arrays behind a header, each of the type and shape it says."""
    sizes = [np.dtype(_TYPES[kind]).itemsize * int(np.prod(shape)) for kind, shape in said]
    total = sum(sizes)
    if not 0 <= total <= MAX_ARRAY_BYTES or min(sizes, default=0) < 0:
        raise ValueError(f"it claims {total} bytes of arrays")
    body = b""
    if packed or total:
        if zstandard.frame_content_size(packed) != total:
            raise ValueError(f"its arrays are not the {total} bytes it claims")
        body = zstandard.decompress(packed, max_output_size=total)
    starts = np.cumsum([0, *sizes])
    return [
        np.frombuffer(body[starts[i] : starts[i + 1]], dtype=_TYPES[kind]).reshape(shape)
        for i, (kind, shape) in enumerate(said)
    ]


def _stamping(header: dict[str, Any], arrays: list[Array]) -> Stamping:
    stamps, first = [], 0
    for fields, count in header["stamps"]:
        stamps.append(decode_stamp(fields, arrays[first : first + count]))
        first += count
    row, col = header["anchor"]
    return Stamping(tuple(stamps), (row, col))


def _patch(header: dict[str, Any], arrays: list[Array]) -> Patch:
    return Patch(counts=arrays[0], **header)


def _relaxing(header: dict[str, Any], _: list[Array]) -> Relaxing:
    regions = tuple(Rect(*region) for region in header.pop("regions"))
    return Relaxing(regions, **header)


def _undoing(header: dict[str, Any], arrays: list[Array]) -> Undoing:
    inner = header["of"]
    operation = _READERS[inner.pop("op")](inner, arrays)
    if not isinstance(operation, Stamping | Patch):
        raise TypeError("it undoes what cannot be undone")
    return Undoing(header["seq"], operation)


_READERS: dict[str, Callable[[dict[str, Any], list[Array]], Operation]] = {
    "stamps": _stamping,
    "patch": _patch,
    "relax": _relaxing,
    "undo": _undoing,
}
