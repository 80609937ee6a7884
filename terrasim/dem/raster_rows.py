"""Georeferenced rasters as rows of counts: joined, resampled where needed, with their history."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from terrasim.dem.height_rows import SouthUpRows
from terrasim.dem.import_options import ImportOptions
from terrasim.dem.mosaic import RULE, Mosaic, Seam, join, seams, vrt
from terrasim.dem.placement import Placement, corner_coordinates, place
from terrasim.dem.raster import DatasetHeights, Tile, gdal, height_scale, read_tile
from terrasim.dem.survey import Progress, survey
from terrasim.errors import InputError

_EXACT = 1e-6
"""Tolerance of the resampler's coordinates [samples]: so small that it computes every one."""
_LOCAL = "EPSG:32631"
"""Stands in for the CRS of a raster that has none: never converted, only named on both sides."""
_PAIRS_TOLD = 20


def raster_rows(
    paths: Sequence[str | Path],
    options: ImportOptions,
    *,
    scan: bool = True,
    progress: Progress | None = None,
) -> SouthUpRows:
    """Open one or several georeferenced rasters as one terrain.

    Args:
        paths: The files; where they overlap the first named wins.
        options: What the user says about them.
        scan: Read all of it once for its range, gaps and values to refuse.
        progress: Told how far that is.

    Raises:
        InputError: If a file cannot be used, or they do not fit together.
    """
    if options.encoding != "plain":
        raise InputError(f"{paths[0]}: --encoding {options.encoding} is for images, not rasters")
    tiles = [read_tile(path, options) for path in paths]
    return tile_rows([str(path) for path in paths], tiles, options, scan=scan, progress=progress)


def tile_rows(
    names: Sequence[str],
    tiles: Sequence[Tile],
    options: ImportOptions,
    *,
    scan: bool = True,
    progress: Progress | None = None,
    below: tuple[Any, ...] = (),
) -> SouthUpRows:
    """The same of rasters whose headers were read; ``below`` is kept open with the rows."""
    name = names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
    mosaic = join(tiles)
    placement = place(name, mosaic, options)
    native = _open(name, mosaic, options, below)
    provenance = _provenance(names, mosaic, placement, options)
    if len(tiles) > 1:
        provenance["seam"] = _seam_report(seams(mosaic, options))
    if scan:
        found = survey(name, native, options.datum, progress)
        provenance["range_m"] = [found.lowest, found.highest]
        provenance["nodata_samples"] = found.missing
    heights = native if placement.native else _resample(native, placement)
    fill = options.fill_distance if options.nodata == "fill" else 0
    return SouthUpRows(heights, placement.grid, provenance, fill)


def _open(
    name: str, mosaic: Mosaic, options: ImportOptions, below: tuple[Any, ...]
) -> DatasetHeights:
    import rasterio

    gain, bias = height_scale(mosaic.placed[0].tile, options)
    with gdal(name):
        return DatasetHeights(name, rasterio.open(vrt(mosaic)), gain, bias, below)


def _resample(native: DatasetHeights, placement: Placement) -> DatasetHeights:
    """Bilinear between the four samples around a post, whatever window is read.

    Left alone the resampler widens its kernel by each window's size and moves posts by up to an
    eighth of a sample: scales of 1 and the tolerance switch both off.
    """
    from rasterio.enums import Resampling
    from rasterio.vrt import WarpedVRT

    crs = placement.crs or _LOCAL
    with gdal(native.name):
        warped = WarpedVRT(
            native.dataset,
            src_crs=native.dataset.crs or _LOCAL,
            crs=crs,
            transform=placement.transform,
            height=placement.grid.rows,
            width=placement.grid.cols,
            resampling=Resampling.bilinear,
            tolerance=_EXACT,
            src_nodata=np.nan,
            nodata=np.nan,
            dtype="float64",
            XSCALE="1",
            YSCALE="1",
        )
    return DatasetHeights(native.name, warped, native.gain, native.bias, (native, *native.below))


def _provenance(
    names: Sequence[str], mosaic: Mosaic, placement: Placement, options: ImportOptions
) -> dict[str, Any]:
    first = mosaic.placed[0].tile
    t = mosaic.transform
    corners = corner_coordinates(mosaic, 0.0)
    unit = options.z_unit or first.unit
    gain, bias = height_scale(first, options)
    return {
        "driver": first.driver,
        "files": [
            {"path": name, "rows": placed.tile.rows, "cols": placed.tile.cols}
            for name, placed in zip(names, mosaic.placed, strict=True)
        ],
        "rows": mosaic.rows,
        "cols": mosaic.cols,
        "sample_type": first.dtype,
        "band": first.band,
        "crs": mosaic.crs.to_string() if mosaic.crs else None,
        "transform": list(tuple(t)[:6]),
        "bounds": [*corners.min(axis=1).tolist(), *corners.max(axis=1).tolist()],
        "vertical_unit": unit or "m (assumed: the file names none)",
        "metres_per_count": gain,
        "metres_offset": bias,
        "nodata_value": None if first.nodata is None else str(first.nodata),
        "nodata": nodata_note(options),
        "posts": placement.note,
        "datum_m": options.datum,
    }


def nodata_note(options: ImportOptions) -> str:
    """What becomes of posts without a height, in a few words."""
    if options.nodata == "hole":
        return "kept as holes"
    return f"filled from heights at most {options.fill_distance} posts away, holes beyond"


def _seam_report(found: list[Seam]) -> dict[str, Any]:
    return {
        "rule": RULE,
        "compared": sum(seam.compared for seam in found),
        "differ": sum(seam.differ for seam in found),
        "largest_m": max((seam.largest for seam in found), default=0.0),
        "pairs": [asdict(seam) for seam in found[:_PAIRS_TOLD]],
    }
