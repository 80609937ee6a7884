"""Which operations may touch the same ground."""

from __future__ import annotations

import math
from typing import NamedTuple

from terrasim.deform.operations import Operation, Relaxing, Stamping
from terrasim.deform.patch import Patch
from terrasim.deform.relaxation import REACH
from terrasim.terrain import Terrain


class Box(NamedTuple):
    """A rectangle of level-0 posts, its ends included."""

    row0: int
    row1: int
    col0: int
    col1: int


def overlap(terrain: Terrain, one: Operation, other: Operation) -> bool:
    """Whether two operations may change a post in common, or one read what the other changed."""
    theirs = boxes(terrain, other)
    return any(_meet(mine, its) for mine in boxes(terrain, one) for its in theirs)


def boxes(terrain: Terrain, operation: Operation) -> list[Box]:
    """Rectangles that hold all the posts an operation may change or read, and a post to spare."""
    if isinstance(operation, Stamping):
        row, col = operation.anchor
        spacing = terrain.grid.spacing
        found = []
        for stamp in operation.stamps:
            west, south, east, north = stamp.extent
            found.append(
                Box(
                    row + math.floor((stamp.y + south) / spacing) - 1,
                    row + math.ceil((stamp.y + north) / spacing) + 1,
                    col + math.floor((stamp.x + west) / spacing) - 1,
                    col + math.ceil((stamp.x + east) / spacing) + 1,
                )
            )
        return found
    if isinstance(operation, Patch):
        rows, cols = operation.counts.shape
        ends = (operation.row, operation.row + rows, operation.col, operation.col + cols)
        return [_of_posts(terrain, ends, 0, operation.detail)]
    if isinstance(operation, Relaxing):
        reach = operation.iterations * REACH
        return [
            _of_posts(terrain, (one.row0, one.row1, one.col0, one.col1), reach, operation.detail)
            for one in operation.regions
        ]
    return boxes(terrain, operation.operation)


def _of_posts(terrain: Terrain, ends: tuple[int, int, int, int], wider: int, detail: bool) -> Box:
    """A rectangle of posts, widened, in level-0 posts."""
    row0, row1, col0, col1 = ends
    row0, row1, col0, col1 = row0 - wider, row1 + wider, col0 - wider, col1 + wider
    if detail:
        grid = terrain.detail
        row0, row1 = (math.floor(at / grid.factor) + grid.row0 for at in (row0, row1))
        col0, col1 = (math.floor(at / grid.factor) + grid.col0 for at in (col0, col1))
    return Box(row0 - 1, row1 + 1, col0 - 1, col1 + 1)


def _meet(a: Box, b: Box) -> bool:
    rows = a.row0 <= b.row1 and b.row0 <= a.row1
    return rows and a.col0 <= b.col1 and b.col0 <= a.col1
