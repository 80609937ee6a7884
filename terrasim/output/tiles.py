"""Which tiles a mesh of the terrain is made of: fine near what happens, coarser elsewhere."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from typing import NamedTuple

from terrasim.errors import InputError
from terrasim.grid import Grid, Span

TILE_SHIFT = 6
TILE = 1 << TILE_SHIFT
"""Cells along a tile's side."""


class Tile(NamedTuple):
    """A square of ``TILE`` by ``TILE`` cells of one level.

    Its (x-, y-) post is the level's post ``(row * TILE, col * TILE)``.
    """

    level: int
    row: int
    col: int

    @property
    def shift(self) -> int:
        """A side is two to this power level-0 cells."""
        return self.level + TILE_SHIFT

    @property
    def box(self) -> Span:
        """Level-0 cells it covers."""
        return Span(
            self.row << self.shift,
            (self.row + 1) << self.shift,
            self.col << self.shift,
            (self.col + 1) << self.shift,
        )


@dataclass(frozen=True)
class Choice:
    """Tiles that cover a terrain without overlap."""

    tiles: tuple[Tile, ...]
    """The tiles, in order."""
    finest: int
    """Level inside the focus."""
    room: int = 0
    """Cells that may be added where there is detail."""


def choose_tiles(
    grid: Grid, focus: Sequence[Span], *, most_cells: int, detail: float = 0.5
) -> Choice:
    """Cover a terrain with tiles: the finest level inside the focus, coarser with the distance.

    A tile is divided while it is nearer to the focus than ``detail`` times its own side. The
    finest level is the lowest at which the cells do not pass ``most_cells``.

    Args:
        grid: The terrain's grid.
        focus: Rectangles of level-0 cells that are to be shown finest; where there are none, the
            whole terrain is shown at one level.
        most_cells: Most cells of all tiles together.
        detail: How far detail reaches beyond the focus; smaller makes fewer cells.

    Raises:
        InputError: If not even the coarsest level keeps to ``most_cells``.
    """
    focus = focus or [Span(grid.row, grid.row + grid.rows, grid.col, grid.col + grid.cols)]
    most_tiles = most_cells >> (2 * TILE_SHIFT)
    for finest in range(grid.top + 1):
        tiles: list[Tile] = []
        for tile in _cover(grid, focus, finest, detail):
            tiles.append(tile)
            if len(tiles) > most_tiles:
                break
        else:
            room = most_cells - (len(tiles) << (2 * TILE_SHIFT))
            return Choice(tuple(sorted(tiles)), finest, room)
    raise InputError(
        f"a mesh of {most_cells} cells cannot show this terrain: its coarsest level has "
        f"{len(roots(grid)) << (2 * TILE_SHIFT)}; allow more"
    )


def roots(grid: Grid) -> list[Tile]:
    """Tiles of the coarsest level that cover the terrain."""
    shift = grid.top + TILE_SHIFT
    return [
        Tile(grid.top, row, col)
        for row in range(grid.row >> shift, ((grid.row + grid.rows - 2) >> shift) + 1)
        for col in range(grid.col >> shift, ((grid.col + grid.cols - 2) >> shift) + 1)
    ]


def leaf_at(tiles: Collection[Tile], row: int, col: int, top: int) -> Tile | None:
    """The tile that covers a level-0 cell, if any does."""
    for level in range(top + 1):
        shift = level + TILE_SHIFT
        tile = Tile(level, row >> shift, col >> shift)
        if tile in tiles:
            return tile
    return None


def _cover(grid: Grid, focus: Sequence[Span], finest: int, detail: float) -> Iterator[Tile]:
    waiting = roots(grid)
    while waiting:
        tile = waiting.pop()
        reach = detail * (1 << tile.shift)
        if tile.level <= finest or all(_gap(tile.box, box) >= reach for box in focus):
            yield tile
            continue
        waiting += [child for child in _children(tile) if _touches(grid, child)]


def _children(tile: Tile) -> list[Tile]:
    return [
        Tile(tile.level - 1, 2 * tile.row + down, 2 * tile.col + right)
        for down in (0, 1)
        for right in (0, 1)
    ]


def _touches(grid: Grid, tile: Tile) -> bool:
    """Whether a cell of the terrain lies in the tile."""
    box = tile.box
    return (
        box.row0 < grid.row + grid.rows - 1
        and box.row1 > grid.row
        and box.col0 < grid.col + grid.cols - 1
        and box.col1 > grid.col
    )


def _gap(a: Span, b: Span) -> int:
    """Distance between two rectangles along the axis where it is larger [level-0 cells]."""
    return max(b.row0 - a.row1, a.row0 - b.row1, b.col0 - a.col1, a.col0 - b.col1, 0)
