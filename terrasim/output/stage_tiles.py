"""The ground of a stage: tiles as they are at the start and as deformations change them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from terrasim.cache.needs import region_blocks
from terrasim.counts import COUNT_M, Counts
from terrasim.deform.stamps import Stamp
from terrasim.grid import Span
from terrasim.output.colours import ramp, tinted
from terrasim.output.mesh import (
    Floats,
    TileMesh,
    outline,
    tile_counts,
    tile_mesh,
    tile_origin,
    tile_points,
)
from terrasim.output.tiles import TILE, Choice, Tile
from terrasim.output.usd import MeshPrim, prim_name, sampled
from terrasim.output.window import read_window
from terrasim.sources.source import Source
from terrasim.terrain import Terrain


@dataclass
class _Shown:
    """A tile, and each state of it that a stage will show."""

    mesh: TileMesh
    origin: tuple[float, float, float]
    before: Counts
    """Heights of the outline's points before anything deformed them [counts]."""
    rest: Counts
    """The same at first [counts]."""
    changes: list[tuple[float, Counts]] = field(default_factory=list)
    """Time code and heights from then on."""


class StageTiles:
    """Tiles of a terrain, followed through its deformations."""

    def __init__(self, terrain: Terrain, choice: Choice, struck: Sequence[Span]) -> None:
        """Read all tiles as they are now.

        Args:
            terrain: The terrain.
            choice: Tiles that cover it.
            struck: Rectangles of level-0 posts that are or will be deformed.
        """
        self._terrain = terrain
        self.finest = choice.finest
        """Level of the finest tiles."""
        self.error = 0
        """Bound of the distance of the finest tiles from level 0 [counts]."""
        grid = terrain.grid
        tiles = frozenset(choice.tiles)
        self._posts = {tile: self._read(tile) for tile in choice.tiles}
        known = {
            tile: _source_posts(terrain.source, tile) if _touch_any(tile, struck) else posts
            for tile, posts in self._posts.items()
        }
        self._shown: dict[Tile, _Shown] = {}
        for tile in choice.tiles:
            shape = outline(grid, tiles, tile)
            counts = tile_counts(shape, self._posts)
            mesh = tile_mesh(grid, shape, counts)
            if len(mesh.triangles):
                before = tile_counts(shape, known)
                self._shown[tile] = _Shown(mesh, tile_origin(grid, mesh), before, counts)

    @property
    def cells(self) -> int:
        """Triangles at the start, in cells."""
        return sum(len(shown.mesh.triangles) for shown in self._shown.values()) // 2

    def changed(self, time: float, boxes: Sequence[Span]) -> None:
        """Look again at all tiles that touch rectangles of level-0 posts.

        Args:
            time: Time code from which they are as they are now.
            boxes: Posts that may have changed, half-open.
        """
        again = {tile for tile in self._posts if _touch_any(tile, boxes)}
        for tile in sorted(again):
            self._posts[tile] = self._read(tile)
        # A neighbour's post on a common edge is touched only where this tile is too.
        for tile in sorted(again & self._shown.keys()):
            shown = self._shown[tile]
            counts = tile_counts(shown.mesh.shape, self._posts)
            last = shown.changes[-1][1] if shown.changes else shown.rest
            if not np.array_equal(counts, last):
                shown.changes.append((time, counts))

    def prims(self, start: float, step: float) -> list[MeshPrim]:
        """All tiles as prims.

        Args:
            start: The stage's first time code.
            step: Time codes over which a change comes about.
        """
        scale = (*self._range(), self._largest_change())
        return [self._prim(shown, scale, (start, step)) for shown in self._shown.values()]

    def _prim(
        self, shown: _Shown, scale: tuple[float, float, float], clock: tuple[float, float]
    ) -> MeshPrim:
        mesh, grid = shown.mesh, self._terrain.grid

        def points(counts: Counts) -> Floats:
            return tile_points(grid, mesh.shape, counts, mesh.used, mesh.base)

        def colours(counts: Counts) -> Floats:
            return _colours(counts[mesh.used], shown.before[mesh.used], scale)

        moved = [(time, points(counts)) for time, counts in shown.changes]
        dyed = [(time, colours(counts)) for time, counts in shown.changes]
        return MeshPrim(
            prim_name(*mesh.shape.tile),
            shown.origin,
            mesh.triangles,
            sampled(mesh.points, moved, *clock),
            sampled(colours(shown.rest), dyed, *clock),
        )

    def _read(self, tile: Tile) -> Counts:
        window = _window(tile)
        posts = read_window(self._terrain, tile.level, window)
        if tile.level == self.finest:
            # Of the blocks just read.
            keys = region_blocks(self._terrain.grid, window, tile.level)
            describe = self._terrain.cache.describe
            self.error = max(self.error, *(describe(key)[2] for key in keys))
        return posts

    def _range(self) -> tuple[float, float]:
        """Lowest and highest height of all tiles [counts]."""
        known = [shown.rest[shown.mesh.used] for shown in self._shown.values()]
        if not known:
            return 0.0, 1.0
        return float(min(k.min() for k in known)), float(max(k.max() for k in known))

    def _largest_change(self) -> float:
        """Largest difference from the undeformed ground at any time [m]."""
        found = [
            float(np.abs(_change(state[shown.mesh.used], shown.before[shown.mesh.used])).max())
            for shown in self._shown.values()
            for state in (shown.rest, *(counts for _, counts in shown.changes))
        ]
        return max(found, default=0.0)


def _window(tile: Tile) -> Span:
    """Posts of a tile at its level."""
    row, col = tile.row * TILE, tile.col * TILE
    return Span(row, row + TILE + 1, col, col + TILE + 1)


def _source_posts(source: Source, tile: Tile) -> Counts:
    """A tile's posts before anything deformed them."""
    window = _window(tile)
    return source.posts(
        tile.level, np.arange(window.row0, window.row1), np.arange(window.col0, window.col1)
    )


def _touch_any(tile: Tile, boxes: Sequence[Span]) -> bool:
    """Whether a post of the tile lies in one of some rectangles of level-0 posts."""
    own = tile.box
    return any(
        own.row0 < box.row1 and own.row1 >= box.row0
        and own.col0 < box.col1 and own.col1 >= box.col0
        for box in boxes
    )  # fmt: skip


def _change(after: Counts, before: Counts) -> npt.NDArray[np.float64]:
    """What was added to points that are no holes [m]."""
    return (after.astype(np.int64) - before).astype(np.float64) * COUNT_M


def _colours(after: Counts, before: Counts, scale: tuple[float, float, float]) -> Floats:
    """Colours of points by height, tinted where they were deformed."""
    low, high, most = scale
    part = (before.astype(np.float64) - low) / max(high - low, 1.0)
    return tinted(ramp(part), _change(after, before), most).astype(np.float32)


def stamp_boxes(stamps: Sequence[Stamp], anchor: tuple[int, int], spacing: float) -> list[Span]:
    """Level-0 posts that stamps may change, half-open."""
    boxes = []
    for stamp in stamps:
        west, south, east, north = stamp.extent
        row = anchor[0] + np.array([stamp.y + south, stamp.y + north]) / spacing
        col = anchor[1] + np.array([stamp.x + west, stamp.x + east]) / spacing
        boxes.append(
            Span(
                int(np.floor(row[0])) - 1,
                int(np.ceil(row[1])) + 2,
                int(np.floor(col[0])) - 1,
                int(np.ceil(col[1])) + 2,
            )
        )
    return boxes
