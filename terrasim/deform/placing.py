"""Stamps placed on the posts they may change, as the kernels take them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, get_args

import numpy as np
import numpy.typing as npt

from terrasim.deform.anchored import Anchor, cells
from terrasim.deform.shapes.checks import refuse
from terrasim.deform.shapes.stamp import Mode
from terrasim.deform.stamps import Stamp
from terrasim.deform.target import Target
from terrasim.errors import InputError
from terrasim.grid import MAX_INDEX
from terrasim.kernels import stamps as kernels
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT
from terrasim.kernels.shapes import CRATER

Records = npt.NDArray[Any]
"""An array of a kernel's structs."""

MAX_COLUMNS = 2**27
"""Columns of posts of all stamps of a call: 8 bytes each."""
MAX_BLOCKS = 2**21
"""Blocks that all stamps of a call touch, each stamp's counted for itself: about 100 bytes each."""
MAX_DATA = 2**27
"""Numbers that all stamps of a call consist of: 8 bytes each."""
FEW = 16
"""Most stamps that are looked at one by one: more are placed sooner all at once."""
WIDEST = 2.0
"""Widest that a stamp may be, in longest sides of the terrain."""
SLACK = 1e-6
"""Posts that a stamp may lie outside its extent by rounding, at most."""
_MODES = {mode: i for i, mode in enumerate(get_args(Mode))}


@dataclass(frozen=True)
class Placed:
    """Stamps on the posts they may change."""

    records: Records
    """``kernels.stamps.Stamp`` of those that touch the terrain, shape ``(count,)``."""
    numbers: npt.NDArray[np.int64]
    """Where each stands among the stamps given."""
    columns: int
    """Columns of posts of those that come in a part of x and a part of y."""
    data: list[npt.NDArray[np.float64]]
    """What else the stamps consist of, one after another."""
    in_parts: bool
    """Whether all of them come in parts."""


def blank(struct: Any, count: int) -> Records:
    """Records of a kernel's struct, all zero, shape ``(count,)``."""
    return np.zeros(count, dtype=_dtype(struct))


@cache
def _dtype(struct: Any) -> Any:
    """What Warp works out anew each time it is asked, in twenty microseconds."""
    return struct.numpy_dtype()


def place(
    stamps: Sequence[Stamp], numbers: Sequence[int], target: Target, anchor: Anchor
) -> Placed:
    """Find the posts each stamp may change and leave out stamps that touch none.

    Args:
        stamps: Stamps, their places in metres from the anchor.
        numbers: Which of them.
        target: The posts they change.
        anchor: Level-0 post (row, column) that their places start from.

    Raises:
        InputError: If a stamp lies further from the anchor than posts can be numbered, is wider
            than twice the terrain's longest side, or the stamps are too many and wide for one call.
    """
    chosen = [stamps[i] for i in numbers]
    fields = np.array([_fields(stamp) for stamp in chosen], dtype=np.float64).reshape(-1, 13)
    _refuse_wide(chosen, fields, target)
    records = blank(kernels.Stamp, len(chosen))
    origin = target.anchor(anchor)
    spans = ((target.row, target.last_row), (target.col, target.last_col))
    for axis, name, at, (first, last) in (("y", "row", 1, spans[0]), ("x", "col", 0, spans[1])):
        cell, inside = cells(fields[:, 2 + at], origin[1 - at], target.spacing, axis)
        records[f"cell_{name}"], records[axis] = cell, inside
        low = cell + np.ceil((inside + fields[:, 5 + at]) / target.spacing - SLACK)
        high = cell + np.floor((inside + fields[:, 7 + at]) / target.spacing + SLACK)
        records[f"{name}0"] = np.clip(low, first, last + 1)
        records[f"{name}1"] = np.clip(high, first - 1, last)
    records["kind"], records["mode"] = fields[:, 0], fields[:, 1]
    records["base"] = np.where(fields[:, 1] == kernels.ADD, 0.0, target.counts(fields[:, 4]))
    for i, name in enumerate("abcd"):
        records[name] = fields[:, 9 + i]
    touching = np.flatnonzero(
        (records["row0"] <= records["row1"]) & (records["col0"] <= records["col1"])
    )
    data = [chosen[i].data for i in touching.tolist()]
    return _checked(records[touching], np.asarray(numbers, dtype=np.int64)[touching], data)


def surely_fit(
    stamps: Sequence[Stamp], numbers: Sequence[int], target: Target, anchor: Anchor
) -> bool:
    """Whether :func:`place` would certainly take a few small stamps, told without placing them.

    What is acknowledged a thousand times a second cannot wait for arrays. False says nothing.
    """
    if len(numbers) > FEW:
        return False
    widest = WIDEST * _longest(target)
    # Half of what can be numbered: rounding cannot lead beyond.
    farthest = MAX_INDEX / 2 * target.spacing
    nearby = max(map(abs, target.anchor(anchor))) <= MAX_INDEX / 2
    columns = blocks = 0.0
    for i in numbers:
        stamp = stamps[i]
        west, south, east, north = stamp.extent
        width, height = east - west, north - south
        near = abs(stamp.x) < farthest and abs(stamp.y) < farthest
        # What has data of its own is rare and not small.
        if not (near and max(width, height) <= widest and type(stamp).data is Stamp.data):
            return False
        across, along = width / target.spacing + 2.0, height / target.spacing + 2.0
        columns += across
        blocks += (across / BLOCK + 2.0) * (along / BLOCK + 2.0)
    return nearby and columns <= MAX_COLUMNS and blocks <= MAX_BLOCKS


def _refuse_wide(stamps: Sequence[Stamp], fields: Records, target: Target) -> None:
    """Refuse what is mistaken for a stamp of this terrain, before anything of its size is taken."""
    width = np.maximum(fields[:, 7] - fields[:, 5], fields[:, 8] - fields[:, 6])
    most = WIDEST * _longest(target)
    for i in np.flatnonzero(~(width <= most)).tolist():
        rule = f"be at most {most:.9g} m wide, twice the terrain's longest side"
        refuse(stamps[i].name, "extent", rule, f"{width[i]:.9g} m")


def _longest(target: Target) -> float:
    """Longest side of the terrain [m]."""
    return max(target.last_row - target.row, target.last_col - target.col) * target.spacing


def _fields(stamp: Stamp) -> tuple[float, ...]:
    """Kind, mode, x, y and z of a stamp, its extent and its shape."""
    z = 0.0 if stamp.z is None else stamp.z
    return (
        stamp.kind,
        _MODES[stamp.mode],
        stamp.x,
        stamp.y,
        z,
        *stamp.extent,
        *stamp.shape,
    )


def _checked(
    records: Records,
    numbers: npt.NDArray[np.int64],
    data: list[npt.NDArray[np.float64]],
) -> Placed:
    """Refuse what would take too much memory, before it is taken."""
    parts = (records["mode"] == kernels.ADD) & (records["kind"] <= CRATER)
    width = np.where(parts, records["col1"].astype(np.int64) - records["col0"] + 1, 0)
    size = np.array([one.size for one in data], dtype=np.int64)
    blocks = np.ones(len(records), dtype=np.int64)
    for name in ("row", "col"):
        low = records[f"{name}0"].astype(np.int64) >> BLOCK_SHIFT
        blocks *= (records[f"{name}1"].astype(np.int64) >> BLOCK_SHIFT) - low + 1
    for what, total, most in (
        ("span {} columns of posts", int(width.sum()), MAX_COLUMNS),
        ("touch {} blocks", int(blocks.sum(dtype=np.float64)), MAX_BLOCKS),
        ("consist of {} numbers", int(size.sum()), MAX_DATA),
    ):
        if total > most:
            raise InputError(
                f"the stamps {what.format(total)}, at most {most} can be applied at once; "
                "apply fewer stamps at a time"
            )
    records["across"] = np.cumsum(width) - width
    records["count"] = size
    records["first"] = np.cumsum(size) - size
    return Placed(records, numbers, int(width.sum()), data, bool(parts.all()))
