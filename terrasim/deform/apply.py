"""Applying stamps: every level of the ground changes at once, and a ledger says by how much.

Each stamp's rise is rounded to counts by itself and added, so the result does not depend on the
order of the stamps, on how they are cut into calls, or on which blocks are resident; applying the
negative undoes it exactly. Only where a post meets the end of the range of heights is that not so,
and such posts are counted.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.counts import COUNTS_PER_M, HOLE, MAX_COUNT
from terrasim.deform.anchored import Anchor, cells
from terrasim.deform.binning import Records, blank, groups
from terrasim.deform.ledger import Ledger
from terrasim.deform.stamps import Stamp
from terrasim.errors import InputError
from terrasim.grid import Block, Grid
from terrasim.kernels import stamps as kernels
from terrasim.kernels.addressing import BLOCK
from terrasim.launch import launch
from terrasim.terrain import Terrain

GROUP = 16
"""Blocks changed in one launch on the CPU: scratch of 1 MiB each."""
GROUP_CUDA = 256
"""The same on CUDA, which wants more threads at once."""
MAX_COLUMNS = 2**27
"""Columns of posts of all stamps of a call: 8 bytes each."""


def apply(terrain: Terrain, stamps: Sequence[Stamp], *, anchor: Anchor = (0, 0)) -> Ledger:
    """Add stamps to the ground, at every level.

    The blocks they touch are brought in first, as many at a time as the pool holds, and are written
    back when they leave it.

    Args:
        terrain: The terrain.
        stamps: Stamps, their places in metres from the anchor.
        anchor: Level-0 post (row, column) that the stamps' places start from; it need not lie on
            the terrain. With an anchor nearby, places are as precise far away as at the origin.

    Returns:
        What happened to the posts of level 0.

    Raises:
        InputError: If a stamp lies further from the anchor than posts can be numbered, or the
            stamps are too many and wide for one call.
    """
    placed = locate(terrain, stamps, anchor)
    ledger = Ledger(outside=len(stamps) - len(placed.stamps))
    if not placed.stamps:
        return ledger
    for level in range(terrain.grid.levels):
        # Where a post met the end of the range it changed by less, as no formula says.
        bound = coarse_bounds(terrain.grid, placed, level, clamped=ledger.clamped > 0)
        ledger += _apply_level(terrain, placed, level, bound)
    return ledger


@dataclass(frozen=True)
class Placed:
    """Stamps that touch the terrain, ready for the kernels."""

    stamps: list[Stamp]
    records: Records
    """``kernels.stamps.Stamp``, shape ``(count,)``."""
    device_records: Any
    """The same as a Warp array on the terrain's device."""
    across: Any
    """Parts of x of all stamps, one after another, float64."""
    limits: npt.NDArray[np.float64]
    """Range [m], steepest slope and largest curvature [1/m] of each, shape ``(3, count)``."""


def locate(terrain: Terrain, stamps: Sequence[Stamp], anchor: Anchor) -> Placed:
    """Find the posts each stamp may change and drop stamps that touch none."""
    grid = terrain.grid
    records = blank(kernels.Stamp, len(stamps))
    extent = np.array([stamp.extent for stamp in stamps], dtype=np.float64).reshape(-1, 4)
    for axis, row, first, count, begin in (
        ("y", "row", grid.row, grid.rows, 1),
        ("x", "col", grid.col, grid.cols, 0),
    ):
        metres = np.array([getattr(stamp, axis) for stamp in stamps], dtype=np.float64)
        cell, inside = cells(metres, anchor[axis == "x"], grid.spacing, axis)
        records[f"cell_{row}"], records[axis] = cell, inside
        # Up to a post more on either side than it reaches: rounding there decides nothing.
        low = cell + np.floor((inside + extent[:, begin]) / grid.spacing)
        high = cell + np.ceil((inside + extent[:, begin + 2]) / grid.spacing)
        records[f"{row}0"] = np.clip(low, first, first + count)
        records[f"{row}1"] = np.clip(high, first - 1, first + count - 1)
    records["kind"] = [stamp.kind for stamp in stamps]
    shapes = np.array([stamp.shape for stamp in stamps]).reshape(-1, 4)
    for name, values in zip("abcd", shapes.T, strict=True):
        records[name] = values
    touching = (records["row0"] <= records["row1"]) & (records["col0"] <= records["col1"])
    kept = [stamp for stamp, touches in zip(stamps, touching, strict=True) if touches]
    return _with_parts_of_x(terrain, kept, records[touching])


def _with_parts_of_x(terrain: Terrain, stamps: list[Stamp], records: Records) -> Placed:
    width = records["col1"].astype(np.int64) - records["col0"] + 1
    records["first"] = np.cumsum(width) - width
    total = int(width.sum())
    if total > MAX_COLUMNS:
        raise InputError(
            f"the stamps span {total} columns of posts, at most {MAX_COLUMNS} can be applied at "
            "once; apply fewer stamps at a time"
        )
    device = terrain.device
    device_records: Any = wp.array(records, dtype=kernels.Stamp, device=device)
    across = wp.empty(total, dtype=wp.float64, device=device)
    owner = np.repeat(np.arange(len(records), dtype=np.int32), width)
    launch(
        kernels.parts_of_x,
        total,
        shared=[terrain.grid.spacing, device_records],
        items=[_places(total, device), wp.array(owner, dtype=wp.int32, device=device), across],
        device=device,
        threads=terrain.threads,
    )
    bounds = [stamp.bounds for stamp in stamps]
    limits = np.array([(one.highest - one.lowest, one.slope, one.curvature) for one in bounds])
    return Placed(stamps, records, device_records, across, limits.reshape(-1, 3).T)


def coarse_bounds(
    grid: Grid, placed: Placed, level: int, *, clamped: bool = False
) -> npt.NDArray[np.int64]:
    """How far a level's surface can be from what each stamp adds at level 0 [counts].

    A level interpolates between the corners of right triangles with legs ``H``. At a post ``p``
    with weights ``w_i`` of the corners ``v_i``, the spread ``sum w_i |v_i - p|^2`` is at most
    ``H^2 / 2``, reached halfway along the diagonal. So a stamp is missed by no more than its
    range, its slope times ``H / sqrt(2)``, or its curvature times ``H^2 / 4`` if it has no kink;
    the terrain's edge is one where it runs through a level's cells. Rounding adds half a count at
    the post and half on the interpolated side.

    Args:
        grid: The terrain's grid.
        placed: The stamps.
        level: Level.
        clamped: Count on their range alone.

    Returns:
        Bounds [counts], int64, shape ``(len(placed.stamps),)``; 0 at level 0.
    """
    if level == 0:
        return np.zeros(len(placed.stamps), dtype=np.int64)
    leg = grid.spacing * (1 << level)
    missed, slope, curvature = placed.limits
    if not clamped:
        missed = np.minimum(missed, slope * (leg * math.sqrt(0.5)))
        bent = np.where(_kinked(grid, placed.records, level), np.inf, curvature)
        missed = np.minimum(missed, bent * (leg * leg / 4.0))
    counts: npt.NDArray[np.int64] = np.ceil(missed * (COUNTS_PER_M * (1.0 + 1e-9))).astype(np.int64)
    return counts + 1


def _kinked(grid: Grid, records: Records, level: int) -> npt.NDArray[np.bool_]:
    """Stamps that reach an edge of the terrain that is no post of the level."""
    mask = (1 << level) - 1
    kinked = np.zeros(len(records), dtype=np.bool_)
    for name, first, count in (("row", grid.row, grid.rows), ("col", grid.col, grid.cols)):
        last = first + count - 1
        kinked |= (records[f"{name}0"] <= first) & bool(first & mask)
        kinked |= (records[f"{name}1"] >= last) & bool(last & mask)
    return kinked


def _apply_level(
    terrain: Terrain, placed: Placed, level: int, bound: npt.NDArray[np.int64]
) -> Ledger:
    device = terrain.device
    device_bound: Any = wp.array(bound, dtype=wp.int64, device=device)
    most = GROUP_CUDA if device.is_cuda else GROUP
    if level < terrain.grid.top:
        most = max(1, min(most, terrain.cache.capacity))
    ledger = Ledger()
    for keys, work, listed in groups(terrain.grid, placed.records, level, most):
        work["layer"] = terrain.cache.hold(keys)
        rows = len(keys) * BLOCK
        tally: Any = wp.empty(rows, dtype=kernels.RowTally, device=device)
        scratch = [wp.empty(rows * BLOCK, dtype=wp.int64, device=device)]
        scratch.append(wp.empty_like(scratch[0]) if level else scratch[0])
        stamps = [placed.device_records, placed.across, device_bound]
        blocks: Any = wp.array(work, dtype=kernels.BlockStamps, device=device)
        members: Any = wp.array(listed, dtype=wp.int32, device=device)
        launch(
            kernels.apply_stamps,
            rows,
            shared=[terrain.pool, terrain.lattice, level, *stamps, blocks, members, *scratch],
            items=[_places(rows, device), tally],
            device=device,
            threads=terrain.threads,
        )
        ledger += _note(terrain, keys, tally.numpy())
    return ledger


def _note(terrain: Terrain, keys: list[Block], tally: Records) -> Ledger:
    """Tell the cache the blocks' new bounds and add up what happened to them."""
    rows = tally.reshape(len(keys), BLOCK)
    lowest, highest = rows["lowest"].min(axis=1), rows["highest"].max(axis=1)
    lowest = np.where(highest == HOLE, HOLE, lowest)
    missed = rows["error"].max(axis=1)
    for i, key in enumerate(keys):
        error = min(terrain.cache.describe(key)[2] + int(missed[i]), MAX_COUNT)
        terrain.cache.edited(key, int(lowest[i]), int(highest[i]), error)
    names = ("removed", "added", "changed", "clamped", "holes")
    return Ledger(*(int(rows[name].sum(dtype=np.int64)) for name in names))


def _places(count: int, device: Any) -> Any:
    """0, 1, 2 ...: where an item stands, whichever part of a launch it falls into."""
    return wp.array(np.arange(count, dtype=np.int32), dtype=wp.int32, device=device)
