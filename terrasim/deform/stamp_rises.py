"""What a stamp would raise a rectangle of posts by, before it is rounded."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.deform.anchored import Anchor, cells
from terrasim.deform.placing import SLACK, place
from terrasim.deform.stamps import Stamp
from terrasim.deform.target import Target
from terrasim.errors import InputError
from terrasim.grid import Span
from terrasim.kernels import stamp_rises as kernels
from terrasim.kernels import stamps as stamp_kernels
from terrasim.launch import launch

Extent = tuple[float, float, float, float]


def posts_within(target: Target, anchor: Anchor, x: float, y: float, extent: Extent) -> Span:
    """Posts of the terrain in a rectangle around a place; empty if there are none.

    Args:
        target: Level 0, or the detail grid.
        anchor: Level-0 post (row, column) that the place is measured from.
        x: The place, metres east of the anchor.
        y: Metres north of it.
        extent: The rectangle's west, south, east and north end [m from the place].
    """
    origin = target.anchor(anchor)
    ends = []
    for axis, at, first, last in (
        ("y", 1, target.row, target.last_row),
        ("x", 0, target.col, target.last_col),
    ):
        place_m = np.array([x if axis == "x" else y])
        [cell], [inside] = cells(place_m, origin[1 - at], target.spacing, axis)
        low = cell + np.ceil((inside + extent[at]) / target.spacing - SLACK)
        high = cell + np.floor((inside + extent[at + 2]) / target.spacing + SLACK)
        ends += [int(np.clip(low, first, last + 1)), int(np.clip(high, first - 1, last)) + 1]
    row0, row1, col0, col1 = ends
    return Span(row0, max(row0, row1), col0, max(col0, col1))


def rises(
    stamp: Stamp,
    target: Target,
    anchor: Anchor,
    span: Span,
    *,
    device: Any = "cpu",
    threads: int = 1,
) -> npt.NDArray[np.float64]:
    """Rises of a rectangle of posts [counts of the target], not rounded.

    Rounded they are what applying the stamp adds, to the bit.

    Args:
        stamp: A stamp of mode add, its place in metres from the anchor.
        target: Level 0, or the detail grid.
        anchor: Level-0 post (row, column) that its place starts from.
        span: The target's posts.
        device: Warp device to compute on.
        threads: CPU threads.

    Returns:
        float64, shape of the span.

    Raises:
        InputError: If the stamp does more than add, or is too large for one call.
    """
    if stamp.mode != "add":
        raise InputError(
            f"{stamp.name}: mode must be add where a stamp changes over time, got {stamp.mode}"
        )
    shape = span.row1 - span.row0, span.col1 - span.col0
    placed = place([stamp], [0], target, anchor)
    if not len(placed.records):
        return np.zeros(shape)

    def sent(values: npt.NDArray[Any], dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device=device)

    out: Any = wp.zeros(shape, dtype=wp.float64, device=device)
    data = placed.data[0] if placed.data else np.empty(0)
    launch(
        kernels.rises,
        shape[0],
        shared=[
            target.posts(undo=False),
            sent(placed.records, stamp_kernels.Stamp),
            sent(data, wp.float64),
            span.col0,
        ],
        items=[sent(np.arange(span.row0, span.row1, dtype=np.int32), wp.int32), out],
        device=wp.get_device(str(device)),
        threads=threads,
    )
    found: npt.NDArray[np.float64] = out.numpy().copy()
    return found
