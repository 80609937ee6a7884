"""Several rasters on one lattice as one: which sample wins, and how they differ where they meet."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any
from xml.sax.saxutils import escape, quoteattr

import numpy as np

from terrasim.counts import Metres
from terrasim.dem.import_options import ImportOptions
from terrasim.dem.input_file import MAX_SAMPLES, MAX_SIDE
from terrasim.dem.raster import Tile, gdal, height_scale
from terrasim.errors import InputError

_LATTICE_TOLERANCE = 0.01
"""How far samples of two rasters may lie from one lattice, in spacings."""
_BAND_SAMPLES = 1 << 20
_GDAL_TYPES = {
    "uint8": "Byte",
    "int8": "Int8",
    "uint16": "UInt16",
    "int16": "Int16",
    "uint32": "UInt32",
    "int32": "Int32",
    "uint64": "UInt64",
    "int64": "Int64",
    "float32": "Float32",
    "float64": "Float64",
}
_HELD_BY_FLOAT32 = {"uint8", "int8", "uint16", "int16", "float32"}
"""Sample types whose every value a float32 holds exactly."""

RULE = "the raster named first wins where samples overlap"


@dataclass(frozen=True)
class Placed:
    """A tile and where it lies in the mosaic."""

    tile: Tile
    """The tile."""
    row: int
    """Mosaic row of its first row, from the north."""
    col: int
    """Mosaic column of its first column."""


@dataclass(frozen=True)
class Mosaic:
    """One lattice with all the tiles on it; one tile alone is a mosaic too."""

    placed: tuple[Placed, ...]
    """The tiles in the order named: the first wins."""
    rows: int
    """Number of rows."""
    cols: int
    """Number of columns."""
    transform: Any
    """Affine transform from ``(column, row)`` of a pixel's corner to coordinates."""
    crs: Any
    """Coordinate reference system, or None."""


@dataclass(frozen=True)
class Seam:
    """How two rasters differ in the samples that both have."""

    first: str
    """The one that wins."""
    second: str
    """The other."""
    compared: int
    """Samples where both have a height."""
    differ: int
    """Of these, samples whose heights differ."""
    largest: float
    """Largest difference [m]."""


def join(tiles: Sequence[Tile]) -> Mosaic:
    """Lay tiles on the lattice of the first.

    Raises:
        InputError: If one has another CRS, unit, scale or lattice, or is not north-up.
    """
    first = tiles[0]
    if len(tiles) == 1:
        alone = Placed(first, 0, 0)
        return Mosaic((alone,), first.rows, first.cols, first.transform, first.crs)
    corners = [_corner(first, tile) for tile in tiles]
    top, left = min(row for row, _ in corners), min(col for _, col in corners)
    placed = tuple(
        Placed(tile, row - top, col - left) for tile, (row, col) in zip(tiles, corners, strict=True)
    )
    rows = max(each.row + each.tile.rows for each in placed)
    cols = max(each.col + each.tile.cols for each in placed)
    if max(rows, cols) > MAX_SIDE or rows * cols > MAX_SAMPLES:
        raise InputError(
            f"the rasters span {rows} x {cols} samples: at most {MAX_SIDE} a side and "
            f"{MAX_SAMPLES} in all; are they neighbours?"
        )
    t = first.transform
    transform = type(t)(t.a, t.b, t.c + left * t.a, t.d, t.e, t.f + top * t.e)
    return Mosaic(placed, rows, cols, transform, first.crs)


def _corner(first: Tile, tile: Tile) -> tuple[int, int]:
    """Row and column of a tile's first sample on the lattice of the first tile."""
    for what, mine, theirs in (
        ("CRS", tile.crs, first.crs),
        ("vertical unit", tile.unit, first.unit),
        ("vertical scale", (tile.scale, tile.offset), (first.scale, first.offset)),
    ):
        if mine != theirs:
            raise InputError(
                f"{tile.path}: {what} is {mine}, that of {first.path} {theirs}: rasters of one "
                "terrain agree; convert one of them"
            )
    a, b = first.transform, tile.transform
    if a.b or a.d or b.b or b.d or a.a < 0 or a.e > 0:
        raise InputError(
            f"{tile.path}: rasters of one terrain must be north-up; resample them with gdalwarp"
        )
    drift = max(tile.cols * abs(b.a - a.a) / abs(a.a), tile.rows * abs(b.e - a.e) / abs(a.e))
    col, row = (b.c - a.c) / a.a, (b.f - a.f) / a.e
    off = max(abs(col - round(col)), abs(row - round(row)), drift)
    if off > _LATTICE_TOLERANCE:
        raise InputError(
            f"{tile.path}: samples lie {off:.3g} spacings off the lattice of {first.path}: rasters "
            f"of one terrain share it to {_LATTICE_TOLERANCE}; resample one with gdalwarp -tap"
        )
    return round(row), round(col)


def seams(mosaic: Mosaic, options: ImportOptions) -> list[Seam]:
    """Compare every two tiles that overlap, sample by sample.

    Raises:
        InputError: If a file cannot be read.
    """
    found = (_seam(one, other, options) for one, other in combinations(mosaic.placed, 2))
    return [seam for seam in found if seam is not None]


def _seam(one: Placed, other: Placed, options: ImportOptions) -> Seam | None:
    row0, row1 = max(one.row, other.row), min(_end(one)[0], _end(other)[0])
    col0, col1 = max(one.col, other.col), min(_end(one)[1], _end(other)[1])
    if row0 >= row1 or col0 >= col1:
        return None
    compared, differ, largest = 0, 0, 0.0
    step = max(1, _BAND_SAMPLES // (col1 - col0))
    for row in range(row0, row1, step):
        window = (row, min(row + step, row1), col0, col1)
        gap = np.abs(_window(one, window, options) - _window(other, window, options))
        gap = gap[~np.isnan(gap)]
        compared += gap.size
        differ += int(np.count_nonzero(gap))
        largest = max(largest, float(gap.max(initial=0.0)))
    return Seam(one.tile.path, other.tile.path, compared, differ, largest)


def _end(placed: Placed) -> tuple[int, int]:
    return placed.row + placed.tile.rows, placed.col + placed.tile.cols


def _window(placed: Placed, window: tuple[int, int, int, int], options: ImportOptions) -> Metres:
    """Heights [m] of one tile in rows and columns of the mosaic."""
    import rasterio

    row0, row1, col0, col1 = window
    alone = Mosaic(
        (Placed(placed.tile, 0, 0),),
        placed.tile.rows,
        placed.tile.cols,
        placed.tile.transform,
        None,
    )
    gain, bias = height_scale(placed.tile, options)
    with gdal(placed.tile.path), rasterio.open(vrt(alone)) as dataset:
        rows = (row0 - placed.row, row1 - placed.row)
        samples = dataset.read(1, window=(rows, (col0 - placed.col, col1 - placed.col)))
    return np.asarray(samples, dtype=np.float64) * gain + bias


def vrt(mosaic: Mosaic) -> str:
    """The mosaic as the raster library's virtual dataset: one float band, NaN what is missing."""
    exact = all(placed.tile.dtype in _HELD_BY_FLOAT32 for placed in mosaic.placed)
    t = mosaic.transform
    numbers = ", ".join(repr(float(number)) for number in (t.c, t.a, t.b, t.f, t.d, t.e))
    srs = f"<SRS>{escape(mosaic.crs.to_wkt())}</SRS>" if mosaic.crs else ""
    # What comes later is laid over what came before, so the first named is written last.
    sources = "".join(_vrt_source(placed) for placed in reversed(mosaic.placed))
    return (
        f'<VRTDataset rasterXSize="{mosaic.cols}" rasterYSize="{mosaic.rows}">{srs}'
        f"<GeoTransform>{numbers}</GeoTransform>"
        f'<VRTRasterBand dataType="{"Float32" if exact else "Float64"}" band="1">'
        f"<NoDataValue>nan</NoDataValue>{sources}</VRTRasterBand></VRTDataset>"
    )


def _vrt_source(placed: Placed) -> str:
    tile = placed.tile
    size = f'xSize="{tile.cols}" ySize="{tile.rows}"'
    # Unless told, the library guesses an ASCII grid's type from its beginning.
    ascii_type = '<OpenOptions><OOI key="DATATYPE">Float64</OOI></OpenOptions>'
    missing = "<UseMaskBand>true</UseMaskBand>" if tile.masked else ""
    if tile.nodata is not None:
        missing = f"<NODATA>{tile.nodata!r}</NODATA>"
    return (
        f'<ComplexSource><SourceFilename relativeToVRT="0" shared="0">{escape(tile.path)}'
        f"</SourceFilename>{ascii_type if tile.driver == 'AAIGrid' else ''}"
        f"<SourceBand>{tile.band}</SourceBand>"
        f'<SourceProperties RasterXSize="{tile.cols}" RasterYSize="{tile.rows}" '
        f"DataType={quoteattr(_GDAL_TYPES[tile.dtype])}/>"
        f'<SrcRect xOff="0" yOff="0" {size}/>'
        f'<DstRect xOff="{placed.col}" yOff="{placed.row}" {size}/>'
        f"{missing}</ComplexSource>"
    )
