"""Pieces of level 1 where the ground has detail: cut so that each needs one block of level 0.

A block of level 0 is in the pool with all its detail, of which several blocks may have more than
fits. So posts are sampled first, and what a cell needs of the next block is then read from level 1.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from terrasim.deform.pieces import Piece
from terrasim.grid import Block, Grid
from terrasim.kernels.propagate import QUADRANT


def parted(
    pieces: list[Piece], detail_count: Callable[[Block], int]
) -> tuple[list[Piece], list[Piece]]:
    """Pieces of level 1 whose ground has no detail, and the others."""
    plain: list[Piece] = []
    fine: list[Piece] = []
    for piece in pieces:
        (fine if any(map(detail_count, set(piece.below))) else plain).append(piece)
    return plain, fine


def to_sample(pieces: list[Piece]) -> list[Piece]:
    """What to sample first."""
    return [piece._replace(measure=False) for piece in pieces]


def to_measure(grid: Grid, pieces: list[Piece]) -> list[Piece]:
    """What to compare with the base then; ``below`` names the blocks of level 1 that are read."""
    return [part for piece in pieces for part in _parts(grid, piece)]


def _parts(grid: Grid, piece: Piece) -> Iterator[Piece]:
    """A piece's cells but the quadrant's last row and column, these, and the cell in both."""
    row, rows, col, cols, *rest = piece.place
    own, level = piece.below[0], piece.block.level
    span = grid.blocks(level)
    first_row, first_col = rest[-4:-2]
    next_row = min((first_row // QUADRANT + 1) >> 1, span.row1 - 1)
    next_col = min((first_col // QUADRANT + 1) >> 1, span.col1 - 1)
    for at, count, north in _ends(row, rows):
        for on, wide, east in _ends(col, cols):
            beside = Block(level, piece.block.row, next_col) if east else own
            ahead = Block(level, next_row, piece.block.col) if north else own
            corner = Block(level, next_row, next_col) if east and north else own
            yield piece._replace(
                below=(own, beside, ahead, corner),
                place=(at, count, on, wide, *rest),
                sample=False,
            )


def _ends(first: int, count: int) -> Iterator[tuple[int, int, bool]]:
    """A range of a quadrant's rows cut into those before its last, and that one."""
    inner = min(first + count, QUADRANT - 1) - first
    if inner > 0:
        yield first, inner, False
    if first + count == QUADRANT:
        yield QUADRANT - 1, 1, True
