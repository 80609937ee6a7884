"""The ground of a stage: tiles as they are at the start and as deformations change them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from terrasim.counts import COUNT_M
from terrasim.grid import Span
from terrasim.output.colours import ramp, tinted
from terrasim.output.footprint import Footprint
from terrasim.output.mesh import (
    Floats,
    TileMesh,
    tile_heights,
    tile_mesh,
    tile_origin,
    tile_points,
)
from terrasim.output.outline import Cover, outline
from terrasim.output.tile_ground import Heights, TileGround, plain_ground
from terrasim.output.tile_history import START, TileHistory, tile_window
from terrasim.output.tiles import Choice, Tile
from terrasim.output.usd import MeshPrim, prim_name, sampled
from terrasim.sources.source import Source
from terrasim.terrain import Terrain

Metres = npt.NDArray[np.float64]


@dataclass
class _Shown:
    """A tile, and each state of it that a stage will show."""

    mesh: TileMesh
    before: Heights
    """Heights of the mesh's outline before anything deformed them [counts / factor]."""
    rest: Heights
    """The same at first."""
    changes: list[tuple[float, Heights]] = field(default_factory=list)
    """Time code and heights from then on."""


class StageTiles:
    """Tiles of a terrain, followed through its deformations.

    A tile's triangles stay the same through a stage: where there is detail at any time, there are
    its cells at all times.
    """

    def __init__(self, terrain: Terrain, choice: Choice, struck: Sequence[Span]) -> None:
        """Read all tiles as they are now.

        Args:
            terrain: The terrain.
            choice: Tiles that cover it.
            struck: Rectangles of level-0 posts that are or will be deformed.
        """
        self._terrain = terrain
        self._tiles = choice.tiles
        self._struck = struck
        self._history = TileHistory(terrain, choice)
        self._found: dict[Tile, _Shown] | None = None
        self.finest = choice.finest
        """Level of the finest tiles."""

    @property
    def error(self) -> int:
        """Bound of the distance of the finest tiles from the ground [counts]."""
        return self._history.error

    @property
    def parts(self) -> tuple[int, int] | None:
        """Cells shown along the side of a cell with detail, and how many it has; None without."""
        history = self._history
        return (history.parts, history.factor) if history.cover().fine else None

    @property
    def cells(self) -> int:
        """Triangles, in cells."""
        return sum(len(shown.mesh.triangles) for shown in self._shown().values()) // 2

    def changed(self, time: float, boxes: Sequence[Span]) -> None:
        """Look again at all tiles that touch rectangles of level-0 posts.

        Args:
            time: Time code from which they are as they are now.
            boxes: Posts that may have changed, half-open.
        """
        self._history.read(time, [tile for tile in self._tiles if _touch_any(tile, boxes)])
        self._found = None

    def prims(self, start: float, step: float) -> list[MeshPrim]:
        """All tiles as prims.

        Args:
            start: The stage's first time code.
            step: Time codes over which a change comes about.
        """
        all_shown = self._shown().values()
        scale = (*self._range(), max(map(_largest_change, all_shown), default=0.0))
        return [self._prim(shown, scale, (start, step)) for shown in all_shown]

    def _prim(
        self, shown: _Shown, scale: tuple[float, float, float], clock: tuple[float, float]
    ) -> MeshPrim:
        mesh, grid = shown.mesh, self._terrain.grid

        def colours(heights: Heights) -> Floats:
            before = shown.before[mesh.used] / mesh.factor
            change = _change(heights[mesh.used], shown.before[mesh.used], mesh.factor)
            return _colours(before, change, scale)

        moved = [(time, tile_points(grid, mesh, heights)) for time, heights in shown.changes]
        dyed = [(time, colours(heights)) for time, heights in shown.changes]
        return MeshPrim(
            prim_name(*mesh.shape.tile),
            tile_origin(grid, mesh),
            mesh.triangles,
            sampled(mesh.points, moved, *clock),
            sampled(colours(shown.rest), dyed, *clock),
        )

    def _shown(self) -> dict[Tile, _Shown]:
        """Every tile that has triangles, through all changes known by now."""
        if self._found is None:
            cover = self._history.cover()
            ground = {tile: self._history.at(tile, START) for tile in self._tiles}
            known = ground | {
                tile: _source_ground(self._terrain.source, tile, ground[tile])
                for tile in self._tiles
                if _touch_any(tile, self._struck)
            }
            every = ((tile, self._show(tile, cover, ground, known)) for tile in self._tiles)
            self._found = {tile: shown for tile, shown in every if len(shown.mesh.triangles)}
        return self._found

    def _show(
        self,
        tile: Tile,
        cover: Cover,
        ground: Mapping[Tile, TileGround],
        known: Mapping[Tile, TileGround],
    ) -> _Shown:
        shape = outline(self._terrain.grid, cover, tile)
        rest = tile_heights(shape, ground)
        mesh = tile_mesh(self._terrain.grid, shape, rest, self._history.factor)
        shown = _Shown(mesh, tile_heights(shape, known), rest)
        seen = {tile, *(leaf for leaf, *_ in shape.extra), *(leaf for leaf, *_ in shape.exact)}
        last = rest
        for time in self._history.times(seen):
            heights = tile_heights(shape, {one: self._history.at(one, time) for one in seen})
            if not np.array_equal(heights, last):
                shown.changes.append((time, heights))
                last = heights
        return shown

    def _range(self) -> tuple[float, float]:
        """Lowest and highest height of all tiles [counts]."""
        known = [
            shown.rest[shown.mesh.used] / shown.mesh.factor for shown in self._shown().values()
        ]
        if not known:
            return 0.0, 1.0
        return float(min(k.min() for k in known)), float(max(k.max() for k in known))


def _source_ground(source: Source, tile: Tile, like: TileGround) -> TileGround:
    """A tile before anything deformed it, in as many parts as it is shown in."""
    window = tile_window(tile)
    posts = source.posts(
        tile.level, np.arange(window.row0, window.row1), np.arange(window.col0, window.col1)
    )
    return plain_ground(posts, like.factor, like.parts)


def _touch_any(tile: Tile, boxes: Sequence[Span]) -> bool:
    """Whether a post of the tile lies in one of some rectangles of level-0 posts."""
    own = tile.box
    return any(
        own.row0 < box.row1 and own.row1 >= box.row0
        and own.col0 < box.col1 and own.col1 >= box.col0
        for box in boxes
    )  # fmt: skip


def _largest_change(shown: _Shown) -> float:
    """Largest difference from the undeformed ground at any time [m]."""
    used, before = shown.mesh.used, shown.before[shown.mesh.used]
    states = (shown.rest, *(heights for _, heights in shown.changes))
    return max(
        float(np.abs(_change(state[used], before, shown.mesh.factor)).max()) for state in states
    )


def _change(after: Heights, before: Heights, factor: int) -> Metres:
    """What was added to points that are no holes [m]."""
    return (after - before).astype(np.float64) * COUNT_M / factor


def _colours(before: Metres, change: Metres, scale: tuple[float, float, float]) -> Floats:
    """Colours of points by height [counts], tinted where they were deformed."""
    low, high, most = scale
    part = (before - low) / max(high - low, 1.0)
    return tinted(ramp(part), change, most).astype(np.float32)


def stamp_boxes(stamps: Sequence[Footprint], anchor: tuple[int, int], spacing: float) -> list[Span]:
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
