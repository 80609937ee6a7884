"""Operations: what is done to the ground, as values that a journal can keep and do again.

A journal row is ``TSO1``, the length of a JSON header (u32), the header, and the arrays it speaks
of as one zstd frame. Everything that decides the result is in it: doing it again on the same ground
gives the same bits.
"""

from __future__ import annotations

import json
import math
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
from terrasim.deform.relaxation import Rect, check_angle, check_iterations
from terrasim.deform.stamp_schema import decode as decode_stamp
from terrasim.deform.stamp_schema import encode as encode_stamp
from terrasim.deform.stamps import Stamp
from terrasim.errors import InputError
from terrasim.grid import MAX_INDEX
from terrasim.store.codec import StoreCorrupt

Array = npt.NDArray[Any]

MAX_ARRAY_BYTES = 1 << 30
"""Bytes of arrays that an operation may hold: nothing larger is allocated on a file's word."""
DENSEST = 1 << 15
"""Bytes that a byte of a zstd frame can stand for at most: a block of 128 KiB takes four."""
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

    def __post_init__(self) -> None:
        """Refuse what are no stamps, and an anchor that is no post."""
        for stamp in self.stamps:
            if not isinstance(stamp, Stamp):
                raise InputError(f"stamps must be stamps, got {_shown(stamp)}")
        anchor = tuple(self.anchor)
        if len(anchor) != 2 or not all(map(_is_index, anchor)):
            raise InputError(
                f"anchor must be two whole numbers within +-{MAX_INDEX}, row and column of a post, "
                f"got {_shown(self.anchor)}"
            )
        object.__setattr__(self, "anchor", (int(anchor[0]), int(anchor[1])))

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

    def __post_init__(self) -> None:
        """Refuse numbers out of their range."""
        if not isinstance(self.angle_deg, int | float | np.floating):
            raise InputError(f"angle_deg must be a number, got {_shown(self.angle_deg)}")
        object.__setattr__(self, "angle_deg", float(self.angle_deg))
        check_angle(self.angle_deg)
        check_iterations(self.iterations)
        for region in self.regions:
            if not all(isinstance(end, int) for end in region):
                raise InputError(f"a region's ends must be whole numbers, got {tuple(region)}")
        if not isinstance(self.detail, bool):
            raise InputError(f"detail must be true or false, got {_shown(self.detail)}")


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
    """An operation as bytes; equal operations give equal bytes.

    Raises:
        InputError: If its arrays are larger than a row may hold.
    """
    arrays: list[Array] = []
    header = _header(operation, arrays)
    total = sum(one.nbytes for one in arrays)
    if total > MAX_ARRAY_BYTES:
        raise InputError(
            f"an operation holds {total} bytes of arrays, at most {MAX_ARRAY_BYTES} fit into the "
            "journal; make several of it"
        )
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
        LookupError,
        TypeError,
        AttributeError,
        RecursionError,
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
        row, col = int(operation.row), int(operation.col)
        place = {"row": row, "col": col, "detail": operation.detail}
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
    if any(type(side) is not int or side < 0 for _, shape in said for side in shape):
        raise ValueError("its arrays have no sizes")
    sizes = [np.dtype(_TYPES[kind]).itemsize * math.prod(shape) for kind, shape in said]
    total = sum(sizes)
    if total > min(MAX_ARRAY_BYTES, DENSEST * len(packed)):
        raise ValueError(f"it claims {total} bytes of arrays")
    body = b""
    if packed:
        if zstandard.frame_content_size(packed) != total:
            raise ValueError(f"its arrays are not the {total} bytes it claims")
        body = zstandard.ZstdDecompressor().decompress(packed, allow_extra_data=False)
    found, first = [], 0
    for (kind, shape), size in zip(said, sizes, strict=True):
        found.append(np.frombuffer(body[first : first + size], dtype=_TYPES[kind]).reshape(shape))
        first += size
    return found


def _stamping(header: dict[str, Any], arrays: list[Array]) -> Stamping:
    stamps, first = [], 0
    for fields, count in header.pop("stamps"):
        if type(count) is not int or not 0 <= count <= len(arrays) - first:
            raise ValueError(f"a stamp of it claims {count} arrays")
        stamps.append(decode_stamp(fields, arrays[first : first + count]))
        first += count
    row, col = header.pop("anchor")
    _require_no_more(header, arrays[first:])
    return Stamping(tuple(stamps), (row, col))


def _patch(header: dict[str, Any], arrays: list[Array]) -> Patch:
    _require_no_more({}, arrays[1:])
    return Patch(counts=arrays[0], **header)


def _relaxing(header: dict[str, Any], arrays: list[Array]) -> Relaxing:
    _require_no_more({}, arrays)
    regions = tuple(Rect(*region) for region in header.pop("regions"))
    return Relaxing(regions, **header)


def _undoing(header: dict[str, Any], arrays: list[Array]) -> Undoing:
    inner, seq = header.pop("of"), header.pop("seq")
    _require_no_more(header, [])
    operation = _READERS[inner.pop("op")](inner, arrays)
    if not isinstance(operation, Stamping | Patch):
        raise TypeError("it undoes what cannot be undone")
    if type(seq) is not int:
        raise TypeError(f"it undoes number {seq!r}")
    return Undoing(seq, operation)


def _require_no_more(header: dict[str, Any], arrays: list[Array]) -> None:
    if header or arrays:
        raise ValueError(f"it says more: {', '.join(header) or f'{len(arrays)} arrays'}")


def _is_index(value: object) -> bool:
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        return False
    return abs(int(value)) <= MAX_INDEX


def _shown(value: object) -> str:
    text = " ".join(repr(value).split())
    return text if len(text) <= 60 else text[:57] + "..."


_READERS: dict[str, Callable[[dict[str, Any], list[Array]], Operation]] = {
    "stamps": _stamping,
    "patch": _patch,
    "relax": _relaxing,
    "undo": _undoing,
}
