"""Heights of a terrain as an image file: GeoTIFF with its place in the world, or EXR.

A GeoTIFF holds float64 metres, so reading it back gives the same counts. EXR has no float64: its
float32 is off by up to half a unit in the last place, which the answer states.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.counts import HOLE, Counts, to_metres
from terrasim.errors import InputError, RunError
from terrasim.grid import Grid
from terrasim.sources.source import Source
from terrasim.store.unfinished import unfinished

Metres = npt.NDArray[np.float64]
Progress = Callable[[float, str], None]
Put = Callable[[int, Metres], None]
"""Takes the number of a band's first row, counted from the north, and its heights."""

BAND = 256
"""Rows of posts read and written at a time."""
EXPORTING = ".exporting"
"""Ends the name of a file whose export has not ended."""


def export(source: Source, path: str | Path, *, progress: Progress | None = None) -> dict[str, Any]:
    """Write a terrain's level-0 heights into a new file, north up; holes become NaN.

    Args:
        source: The terrain, or one of its snapshots.
        path: File to make; its ending says what: ``.tif`` or ``.tiff``, or ``.exr``.
        progress: Told the fraction done and what is being done.

    Returns:
        What was written, ready for JSON.

    Raises:
        InputError: If the ending is neither, the file exists, or none can be made there.
        RunError: If the disk is full or fails.
    """
    path = Path(path)
    open_file = _writers().get(path.suffix.lower())
    if open_file is None:
        raise InputError(f"{path}: exports are .tif, .tiff or .exr, got {path.suffix or 'none'!r}")
    if path.exists():
        raise InputError(f"{path} exists; remove it or choose another name")
    if not path.parent.is_dir():
        raise InputError(f"there is no folder {path.parent} for {path.name}; make it first")
    tell = progress or _silent
    grid, holes, rounding = source.grid, 0, 0.0
    with unfinished(path, EXPORTING) as growing, open_file(growing, grid) as put:
        for first, counts in _bands(source):
            metres = to_metres(counts, grid.datum)
            gone = counts == HOLE
            metres[gone] = np.nan
            holes += int(np.count_nonzero(gone))
            if path.suffix.lower() == ".exr":
                rounding = max(rounding, _rounding(metres))
            put(first, metres)
            tell((first + len(metres)) / grid.rows, f"writing {path.name}")
    return {
        "file": str(path),
        "rows": grid.rows,
        "cols": grid.cols,
        "spacing_m": grid.spacing,
        "crs": grid.crs,
        "holes": holes,
        "bytes": path.stat().st_size,
        "rounding_m": rounding,
    }


def _silent(fraction: float, message: str, /) -> None:
    pass


def _bands(source: Source) -> Iterator[tuple[int, Counts]]:
    """Bands of rows from the north, with the number of their first row from there."""
    grid = source.grid
    cols = np.arange(grid.col, grid.col + grid.cols, dtype=np.int64)
    for first in range(0, grid.rows, BAND):
        last = min(first + BAND, grid.rows)
        north = grid.row + grid.rows - 1
        yield first, source.posts(0, np.arange(north - first, north - last, -1), cols)


def _rounding(metres: Metres) -> float:
    """Largest distance of heights from their float32 [m]."""
    apart = np.abs(metres - metres.astype(np.float32))
    return float(np.nanmax(apart, initial=0.0))


def _writers() -> dict[str, Callable[[Path, Grid], AbstractContextManager[Put]]]:
    return {".tif": _geotiff, ".tiff": _geotiff, ".exr": _exr}


@contextmanager
def _geotiff(path: Path, grid: Grid) -> Iterator[Put]:
    import rasterio
    from rasterio.errors import RasterioError
    from rasterio.windows import Window

    s = grid.spacing
    west, north = float(grid.post_x(grid.col)), float(grid.post_y(grid.row + grid.rows - 1))
    options: dict[str, Any] = {
        "driver": "GTiff",
        "width": grid.cols,
        "height": grid.rows,
        "count": 1,
        "dtype": "float64",
        "nodata": float("nan"),
        "crs": grid.crs,
        # Posts are pixel centres.
        "transform": rasterio.Affine(s, 0.0, west - s / 2, 0.0, -s, north + s / 2),
        "tiled": True,
        "blockxsize": 256,
        "blockysize": 256,
        "compress": "deflate",
        "predictor": 3,
        "BIGTIFF": "IF_SAFER",
    }
    try:
        with rasterio.Env(), rasterio.open(path, "w", **options) as file:
            file.update_tags(AREA_OR_POINT="Point")

            def put(first: int, metres: Metres) -> None:
                file.write(metres, 1, window=Window(0, first, grid.cols, len(metres)))

            yield put
    except RasterioError as error:
        raise RunError(f"{path} cannot be written: {error}; make room") from None


@contextmanager
def _exr(path: Path, grid: Grid) -> Iterator[Put]:
    import OpenImageIO

    spec = OpenImageIO.ImageSpec(grid.cols, grid.rows, 1, OpenImageIO.FLOAT)
    spec.channelnames = ("Z",)
    spec.attribute("compression", "zip")
    spec.attribute("terrasim:spacing_m", float(grid.spacing))
    spec.attribute("terrasim:west_m", str(float(grid.post_x(grid.col))))
    spec.attribute("terrasim:south_m", str(float(grid.post_y(grid.row))))
    if grid.crs:
        spec.attribute("terrasim:crs", grid.crs)
    file = OpenImageIO.ImageOutput.create("openexr")
    if file is None or not file.open(str(path), spec):
        raise RunError(f"{path} cannot be written: {OpenImageIO.geterror()}")

    def put(first: int, metres: Metres) -> None:
        pixels = np.ascontiguousarray(metres, dtype=np.float32)[:, :, None]
        if not file.write_scanlines(first, first + len(metres), 0, pixels):
            raise RunError(f"{path} cannot be written: {file.geterror()}; make room")

    try:
        yield put
        if not file.close():
            raise RunError(f"{path} cannot be written: {file.geterror()}; make room")
    finally:
        file.close()
