"""Files of heights into a terrain: which reader takes them, what they say, and into a store."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from terrasim.counts import COUNT_M
from terrasim.dem.height_rows import SouthUpRows
from terrasim.dem.image import EXR_MAGIC, PNG_MAGIC, TIFF_MAGICS, ImageHeights, read_image
from terrasim.dem.import_options import ImportOptions
from terrasim.dem.input_file import begins_with, check_file
from terrasim.dem.npy import NPY_MAGIC, ArrayHeights, read_npy
from terrasim.dem.raster import gdal
from terrasim.dem.raster_rows import nodata_note, raster_rows
from terrasim.dem.sample_dem import sample_rows
from terrasim.dem.survey import Progress, survey
from terrasim.errors import InputError
from terrasim.grid import Grid

__all__ = ["ImportOptions", "describe_input", "import_terrain", "open_input"]

SAMPLE = "sample:"
"""Begins the name of a sample that is no file."""
_SCAN_SHARE = 0.15
_SCANNED = 1 << 26
"""Inputs of more samples are described without their range, unless it is asked for."""


def open_input(
    paths: Sequence[str | Path],
    options: ImportOptions | None = None,
    *,
    scan: bool = True,
    progress: Progress | None = None,
) -> SouthUpRows:
    """Open files of heights as one terrain's rows.

    Args:
        paths: Georeferenced rasters (GeoTIFF, SRTM .hgt, USGS .dem, ESRI ASCII), or one image
            (PNG, TIFF, OpenEXR), one .npy array, or ``sample:NAME``.
        options: What the user says about them.
        scan: Read all of it once, so that bad values are refused before anything is written.
        progress: Told the fraction done of that.

    Raises:
        InputError: If a file cannot be read or used.
    """
    options = options or ImportOptions()
    if not paths:
        raise InputError("no file to read: name at least one")
    kinds = {_kind(path) for path in paths}
    if kinds == {"raster"}:
        return raster_rows(paths, options, scan=scan, progress=progress)
    if len(paths) > 1:
        raise InputError(
            f"{len(paths)} files named, of which one is a {min(kinds - {'raster'})}: only "
            "georeferenced rasters make one terrain together"
        )
    name = str(paths[0])
    if kinds == {"sample"}:
        return sample_rows(name.removeprefix(SAMPLE), options)
    heights: ArrayHeights | ImageHeights
    if kinds == {"array"}:
        heights = read_npy(name, options)
    else:
        if options.nodata_value is None and _is_tiff(Path(name)):
            options = replace(options, nodata_value=_tiff_nodata(name, options))
        heights = read_image(name, options)
    return _plain_rows(name, heights, options, scan, progress)


def import_terrain(
    paths: Sequence[str | Path],
    store_path: str | Path,
    options: ImportOptions | None = None,
    *,
    replace_store: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Read files of heights into a new store.

    Args:
        paths: As for :func:`open_input`.
        store_path: The store to make.
        options: What the user says about the files.
        replace_store: Put the new store in the place of one that is there.
        progress: Told the fraction done, and of what.

    Returns:
        What was read, the grid it made, and what was written, ready for JSON.

    Raises:
        InputError: If a file cannot be used.
        RunError: If the store cannot be written.
    """
    from terrasim.store.build import build_store

    tell = progress or _silent

    def looking(fraction: float, message: str, /) -> None:
        tell(_SCAN_SHARE * fraction, message)

    def writing(fraction: float, message: str, /) -> None:
        tell(_SCAN_SHARE + (1.0 - _SCAN_SHARE) * fraction, message)

    rows = open_input(paths, options, progress=looking)
    built = build_store(
        rows,
        rows.grid,
        store_path,
        provenance=rows.history,
        replace=replace_store,
        progress=writing,
    )
    read = rows.history() | {"grid": describe_grid(rows.grid)}
    return read | {"store": asdict(built) | {"path": str(built.path)}}


def _silent(fraction: float, message: str, /) -> None:
    pass


def describe_input(
    paths: Sequence[str | Path], options: ImportOptions | None = None, *, scan: bool | None = None
) -> dict[str, Any]:
    """What files of heights say of themselves and the grid they would make, ready for JSON.

    Args:
        paths: As for :func:`open_input`.
        options: What the user says about them.
        scan: Whether to read everything for the range; by default if it is not huge.

    Raises:
        InputError: If a file cannot be read or used.
    """
    rows = open_input(paths, options, scan=False)
    size = int(rows.provenance["rows"]) * int(rows.provenance["cols"])
    if scan or (scan is None and size <= _SCANNED):
        rows = open_input(paths, options)
    return rows.provenance | {"grid": describe_grid(rows.grid)}


def describe_grid(grid: Grid) -> dict[str, Any]:
    """A grid's fields with their units in their names, ready for JSON."""
    return {
        "rows": grid.rows,
        "cols": grid.cols,
        "spacing_m": grid.spacing,
        "x_m": grid.x,
        "y_m": grid.y,
        "datum_m": grid.datum,
        "count_m": COUNT_M,
        "crs": grid.crs,
        "levels": grid.levels,
    }


def _kind(path: str | Path) -> str:
    """Which reader takes an input: sample, array, image or raster, by what it begins with."""
    if str(path).startswith(SAMPLE):
        return "sample"
    file = check_file(path)
    if begins_with(file, NPY_MAGIC):
        return "array"
    if begins_with(file, PNG_MAGIC, EXR_MAGIC):
        return "image"
    if begins_with(file, b"PK\x03\x04"):
        raise InputError(f"{path}: is an archive; unpack it and name the raster or .npy in it")
    return "image" if _is_tiff(file) and not _georeferenced(file) else "raster"


def _is_tiff(file: Path) -> bool:
    return begins_with(file, *TIFF_MAGICS)


def _georeferenced(file: Path) -> bool:
    import rasterio

    with gdal(str(file)), rasterio.open(file, driver="GTiff") as dataset:
        return bool(dataset.crs) or not dataset.transform.is_identity


def _tiff_nodata(name: str, options: ImportOptions) -> float | None:
    """The nodata value of a TIFF, which the image library does not tell."""
    import rasterio

    with gdal(name), rasterio.open(name, driver="GTiff") as dataset:
        band = min(options.band or 1, dataset.count)
        value = dataset.nodatavals[band - 1]
        return None if value is None else float(value)


def _plain_rows(
    name: str,
    heights: ArrayHeights | ImageHeights,
    options: ImportOptions,
    scan: bool,
    progress: Progress | None,
) -> SouthUpRows:
    """Rows of an input that has no place in the world: its south-western post is the origin."""
    if options.spacing is None:
        raise InputError(f"{name}: an image or array has no scale: give --spacing in metres")
    if options.crs is not None or options.to_crs is not None:
        raise InputError(f"{name}: an image or array has no place in a CRS: leave --crs out")
    if options.z_unit is not None:
        raise InputError(f"{name}: an image or array has no unit: use --z-scale, metres a count")
    provenance: dict[str, Any] = {
        "driver": heights.driver,
        "files": [{"path": name, "rows": heights.rows, "cols": heights.cols}],
        "rows": heights.rows,
        "cols": heights.cols,
        "crs": None,
        "encoding": options.encoding,
        "metres_per_count": options.z_scale,
        "metres_offset": options.z_offset,
        "nodata_value": None if options.nodata_value is None else str(options.nodata_value),
        "nodata": nodata_note(options),
        "posts": "posts are the samples; row 0 of the file is the northern edge",
        "datum_m": options.datum,
    }
    grid = Grid(heights.rows, heights.cols, float(options.spacing), datum=options.datum)
    if scan:
        found = survey(name, heights, options.datum, progress)
        provenance["range_m"] = [found.lowest, found.highest]
        provenance["nodata_samples"] = found.missing
    fill = options.fill_distance if options.nodata == "fill" else 0
    return SouthUpRows(heights, grid, provenance, fill)
