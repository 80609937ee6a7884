"""From a raster that is read from the north to rows of counts that are read from the south."""

from __future__ import annotations

import threading
from typing import Any, Protocol

import numpy as np

from terrasim.counts import HOLE, Counts, Metres, to_counts
from terrasim.errors import InputError
from terrasim.grid import Grid

_BAND_POSTS = 1 << 21
_MOST_BAND_ROWS = 256


class Heights(Protocol):
    """A raster of heights in metres, row 0 in the north."""

    @property
    def rows(self) -> int:
        """Number of rows."""
        ...

    @property
    def cols(self) -> int:
        """Number of columns."""
        ...

    def read(self, row: int, count: int) -> Metres:
        """Heights [m] of whole rows, shape ``(count, cols)``, float64; NaN: no height."""
        ...


class SouthUpRows:
    """Rows of counts over a raster in metres; holes are filled on the way if asked for.

    It reads bands that lie fixed in the raster and keeps the last, so that no height depends on
    which rows were asked for together, and memory on the width alone.
    """

    def __init__(
        self, heights: Heights, grid: Grid, provenance: dict[str, Any], fill_distance: int = 0
    ) -> None:
        """Wrap a raster.

        Args:
            heights: The raster, of the grid's rows and columns.
            grid: Placement of the posts.
            provenance: Where the heights come from, ready for JSON.
            fill_distance: How far a filled post may lie from a height [posts]; 0 keeps all holes.
        """
        self._heights = heights
        self._grid = grid
        self.provenance = provenance
        self._fill = fill_distance
        self._band_rows = min(max(_BAND_POSTS // grid.cols, 1), _MOST_BAND_ROWS, grid.rows)
        self._band: tuple[int, Counts] | None = None
        self._seen: dict[int, tuple[int, int]] = {}
        self._lock = threading.Lock()

    @property
    def grid(self) -> Grid:
        """Placement of the level-0 posts."""
        return self._grid

    @property
    def holes(self) -> int:
        """Holes in what was read so far."""
        return sum(holes for holes, _ in self._seen.values())

    @property
    def filled(self) -> int:
        """Posts filled in what was read so far."""
        return sum(filled for _, filled in self._seen.values())

    def history(self) -> dict[str, Any]:
        """The provenance with what became of posts without a height in the rows read so far."""
        return self.provenance | {"holes": self.holes, "filled": self.filled}

    def read_rows(self, row: int, count: int) -> Counts:
        """Rows ``row`` to ``row + count - 1``, counted from 0 at the southern edge.

        Returns:
            Counts, shape ``(count, grid.cols)``, int32.

        Raises:
            InputError: If the rows are not the grid's, or the file turns out damaged.
        """
        rows = self._grid.rows
        if not 0 <= row < row + count <= rows:
            raise InputError(f"rows {row} to {row + count - 1} asked for, the terrain has {rows}")
        north, south = rows - row - count, rows - row
        posts = np.empty((count, self._grid.cols), np.int32)
        with self._lock:
            # From the south: the next rows asked for begin in the last band of these.
            for band in range((south - 1) // self._band_rows, north // self._band_rows - 1, -1):
                first = band * self._band_rows
                counts = self._read_band(band)
                top, bottom = max(north, first), min(south, first + len(counts))
                posts[top - north : bottom - north] = counts[top - first : bottom - first]
        return posts[::-1]

    def _read_band(self, band: int) -> Counts:
        if self._band is None or self._band[0] != band:
            first = band * self._band_rows
            count = min(self._band_rows, self._grid.rows - first)
            metres = self._heights.read(first, count)
            missing = int(np.count_nonzero(np.isnan(metres)))
            if missing and self._fill:
                metres = _fill(self._heights, first, count, self._fill)
            counts = to_counts(metres, self._grid.datum)
            holes = int(np.count_nonzero(counts == HOLE)) if missing else 0
            self._seen[band] = (holes, missing - holes)
            self._band = (band, counts)
        return self._band[1]


def _fill(heights: Heights, row: int, count: int, distance: int) -> Metres:
    """Rows whose holes are interpolated from the heights around, as far as ``distance`` posts.

    A post depends on posts within the distance alone, so rows filled in bands equal rows filled at
    once.
    """
    from rasterio.fill import fillnodata

    first, last = max(0, row - distance), min(heights.rows, row + count + distance)
    metres = heights.read(first, last - first)
    known = ~np.isnan(metres)
    if not known.any():
        return metres[row - first : row - first + count]
    filled = fillnodata(
        metres.astype(np.float32),
        mask=known,
        max_search_distance=distance,
        TEMP_FILE_DRIVER="MEM",
    )
    part = slice(row - first, row - first + count)
    # The library computes in float32; what was known keeps its own digits.
    return np.where(known[part], metres[part], filled[part].astype(np.float64))
