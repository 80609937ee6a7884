"""The ground that moving things may touch in the coming steps."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from terrasim.cache.needs import Boxes
from terrasim.grid import MAX_INDEX, Grid, Indices
from terrasim.kernels.addressing import BLOCK

SLACK_CELLS = 2.0
"""Cells around each ball that are required beyond what a step needs, so that the same blocks serve
many steps."""


@dataclass(frozen=True)
class Reach:
    """Blocks that serve until something may have come out of them."""

    boxes: Boxes
    """The blocks, a box each."""
    room: float
    """How far anything may still move before they must be looked up again [m]."""
    speed: float
    """No ball is faster than this [m/s]."""


def next_reach(
    grid: Grid,
    cell: Any,
    fastest: Callable[[], float],
    dt: float,
    gravity: float,
    last: Reach | None,
    ground_speed: float = 0.0,
) -> Reach:
    """The ground for one more step.

    Nothing speeds a ball up but gravity and ground that moves, and an impact may turn its whole
    speed any way. So the fastest ball's speed, grown by them, bounds every way in every direction,
    and the arrays are read only when the room that was left in the last reach is used up.

    Args:
        grid: The terrain's grid.
        cell: Level-0 cells (row, col), vec2i Warp array, shape ``(count,)``.
        fastest: The fastest ball's speed, or a bound of it [m/s]; reads the arrays.
        dt: Length of the step [s].
        gravity: Downward acceleration [m/s^2].
        last: What this gave for the step before; None to begin or when a ball was put elsewhere.
        ground_speed: No ground under a ball moves faster in this step [m/s].
    """
    if last is not None:
        way = (last.speed + gravity * dt) * dt
        if way <= last.room:
            return replace(last, room=last.room - way, speed=last.speed + gravity * dt)
    # Off the ground in the ground's own frame, and back in the datum's.
    speed = fastest() + 2.0 * ground_speed
    way = (speed + gravity * dt) * dt
    room = max(way, SLACK_CELLS * grid.spacing)
    boxes = _blocks_around(grid, cell.numpy().astype(np.int64), room)
    return Reach(boxes, room - way, speed + gravity * dt)


def _blocks_around(grid: Grid, cell: Indices, room: float) -> Boxes:
    """Boxes of the blocks that hold the ground within a distance of cells."""
    way = math.ceil(min(room / grid.spacing, 2.0 * MAX_INDEX))
    around = Boxes(cell[:, 0] - way, cell[:, 0] + way, cell[:, 1] - way, cell[:, 1] + way)
    keys = around.blocks(grid, 0)
    row = np.array([key.row for key in keys], dtype=np.int64) * BLOCK
    col = np.array([key.col for key in keys], dtype=np.int64) * BLOCK
    # A block's last cells also read the next block, which has a box of its own where it is needed.
    return Boxes(row, row + BLOCK - 2, col, col + BLOCK - 2)
