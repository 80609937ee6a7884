"""Tiles through time: their heights at the start, and after each change."""

from __future__ import annotations

from collections.abc import Collection, Iterable

import numpy as np

from terrasim.cache.needs import region_blocks
from terrasim.grid import Span
from terrasim.output.outline import Cover
from terrasim.output.tile_ground import Mask, TileGround, detailed, fine_cells, most_parts
from terrasim.output.tiles import TILE, Choice, Tile
from terrasim.output.window import detail_posts, read_window
from terrasim.terrain import Terrain

START = float("-inf")
"""Time code of what was there at first."""


class TileHistory:
    """Heights of all tiles of a mesh, and when they changed.

    Detail is shown in as many parts of a cell as there is room for. What comes to be fine later
    may need that room: then all of it is shown in fewer parts.
    """

    def __init__(self, terrain: Terrain, choice: Choice) -> None:
        """Read all tiles as they are now.

        Args:
            terrain: The terrain.
            choice: Its tiles, and room for detail.
        """
        self._terrain = terrain
        self._choice = choice
        self.factor = terrain.detail.factor
        """Detail cells along a base cell's side."""
        self._most = self.factor
        self._fine: dict[Tile, Mask] = {}
        self._range = (0, 0)
        self._error = 0
        self._states: dict[Tile, list[tuple[float, TileGround]]] = {
            tile: [] for tile in choice.tiles
        }
        self.read(START, choice.tiles)

    @property
    def parts(self) -> int:
        """Parts of a fine cell's side that are shown."""
        return self._most if self._fine else 1

    @property
    def error(self) -> int:
        """Bound of the distance of the finest tiles from the ground [counts]."""
        low, high = self._range
        # Detail and what is shown of it have the same values at some posts of every cell.
        missed = -(-(high - low) // self.factor) if self.parts < self.factor else 0
        return self._error + missed

    def cover(self) -> Cover:
        """The tiles, with all cells that are fine at any time."""
        return Cover(frozenset(self._states), self._fine, self.parts)

    def read(self, time: float, tiles: Collection[Tile]) -> None:
        """Look at some tiles, and keep what changed.

        Args:
            time: Time code from which they are as they are now.
            tiles: Which to look at.
        """
        fine = {tile: self._look(tile) for tile in tiles}
        self._make_room()
        for tile in sorted(tiles):
            ground = self._ground(tile, fine[tile])
            states = self._states[tile]
            if not states or not ground.same(states[-1][1]):
                states.append((time, ground))

    def times(self, tiles: Iterable[Tile]) -> list[float]:
        """Time codes at which any of some tiles changed, in order, the start not among them."""
        found = {time for tile in tiles for time, _ in self._states[tile]}
        return sorted(found - {START})

    def at(self, tile: Tile, time: float) -> TileGround:
        """A tile as it is from a time code on."""
        last = [ground for since, ground in self._states[tile] if since <= time][-1]
        return last.coarsened(self.parts)

    def _look(self, tile: Tile) -> Mask:
        """A tile's fine cells; they count as fine at all times."""
        fine = np.zeros((TILE, TILE), bool)
        if tile.level > 0:
            return fine
        for part in detail_posts(self._terrain, tile.box):
            fine |= fine_cells(part, self.factor)
            low, high = self._range
            self._range = min(low, int(part.counts.min())), max(high, int(part.counts.max()))
        fine &= self._inside(tile)
        if fine.any():
            self._fine[tile] = self._fine.get(tile, False) | fine
        return fine

    def _make_room(self) -> None:
        """Show detail in fewer parts if there is more of it than room."""
        cells = sum(int(np.count_nonzero(fine)) for fine in self._fine.values())
        parts = most_parts(self._most, cells, self._choice.room)
        if parts < self._most:
            self._most = parts
            for states in self._states.values():
                states[:] = [(time, ground.coarsened(parts)) for time, ground in states]

    def _ground(self, tile: Tile, fine: Mask) -> TileGround:
        window = tile_window(tile)
        counts = read_window(self._terrain, tile.level, window)
        if tile.level == self._choice.finest:
            # Of the blocks just read.
            keys = region_blocks(self._terrain.grid, window, tile.level)
            describe = self._terrain.cache.describe
            self._error = max(self._error, *(describe(key)[2] for key in keys))
        posts = detail_posts(self._terrain, tile.box) if fine.any() else []
        return detailed(counts, fine, posts, self.factor, self._most)

    def _inside(self, tile: Tile) -> Mask:
        """Cells of a tile of level 0 that lie on the terrain."""
        grid, box = self._terrain.grid, tile.box
        rows, cols = np.arange(box.row0, box.row1), np.arange(box.col0, box.col1)
        on_row = (rows >= grid.row) & (rows < grid.row + grid.rows - 1)
        on_col = (cols >= grid.col) & (cols < grid.col + grid.cols - 1)
        return on_row[:, None] & on_col[None, :]


def tile_window(tile: Tile) -> Span:
    """Posts of a tile at its level."""
    row, col = tile.row * TILE, tile.col * TILE
    return Span(row, row + TILE + 1, col, col + TILE + 1)
