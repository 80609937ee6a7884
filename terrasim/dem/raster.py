"""Georeferenced rasters: what a file says of itself, and its heights in metres."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from terrasim.counts import Metres
from terrasim.dem.import_options import ImportOptions, unit_metres
from terrasim.dem.input_file import check_ascii_grid, check_claim, check_file
from terrasim.errors import InputError

DRIVERS = ("GTiff", "SRTMHGT", "USGSDEM", "AAIGrid", "DTED", "EHdr", "HFA")
"""The formats read here: elevation in one file each."""
_CACHE_MB = 128


@contextmanager
def gdal(name: str) -> Iterator[None]:
    """Run calls of the raster library: its errors become one line, it prints nothing.

    Args:
        name: What to call the input in an error.

    Raises:
        InputError: If the library cannot do what it was asked.
    """
    import warnings

    import rasterio
    from rasterio._err import CPLE_BaseError  # the library's own root of what GDAL raises
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    try:
        with rasterio.Env(GDAL_CACHEMAX=_CACHE_MB), warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            yield
    except (RasterioError, CPLE_BaseError) as error:
        cause = error.__cause__ or error
        reason = " ".join(str(cause).split())
        raise InputError(f"{name}: truncated, damaged or no raster ({reason})") from None


@dataclass(frozen=True)
class Tile:
    """One file of heights as it describes itself."""

    path: str
    """Where the library finds it."""
    driver: str
    """The library's name of its format."""
    rows: int
    """Number of rows."""
    cols: int
    """Number of columns."""
    transform: Any
    """Affine transform from ``(column, row)`` of a pixel's corner to coordinates."""
    crs: Any
    """Coordinate reference system, or None."""
    dtype: str
    """Type of its samples."""
    band: int
    """The band that is read, from 1."""
    nodata: float | None
    """Value that marks a missing height."""
    masked: bool
    """Whether a mask besides the value marks missing heights."""
    unit: str
    """Vertical unit, empty where the file names none."""
    scale: float
    """Vertical units in one step of a sample."""
    offset: float
    """Vertical units of sample 0."""


@dataclass(frozen=True)
class DatasetHeights:
    """An open one-band dataset as a raster of metres."""

    name: str
    """What to call it in an error."""
    dataset: Any
    """The dataset; NaN marks what is missing."""
    gain: float
    """Metres in one step of a sample."""
    bias: float
    """Metres of sample 0."""
    below: tuple[Any, ...] = ()
    """What has to stay open beneath it."""

    @property
    def rows(self) -> int:
        """Number of rows."""
        return int(self.dataset.height)

    @property
    def cols(self) -> int:
        """Number of columns."""
        return int(self.dataset.width)

    def read(self, row: int, count: int) -> Metres:
        """Heights [m] of whole rows, shape ``(count, cols)``, float64; NaN: no height."""
        with gdal(self.name):
            samples = self.dataset.read(1, window=((row, row + count), (0, self.cols)))
        return np.asarray(samples, dtype=np.float64) * self.gain + self.bias


def read_tile(path: str | Path, options: ImportOptions) -> Tile:
    """Open a raster file, check its header and take down what it says.

    Raises:
        InputError: If it cannot be read, is no raster of a known format, claims what it cannot
            hold, or leaves open which band holds the heights.
    """
    file = check_file(path)
    with gdal(str(path)):
        return describe_tile(str(file.absolute()), str(path), options)


def describe_tile(
    location: str, name: str, options: ImportOptions, *, trusted: bool = False
) -> Tile:
    """Take down what a raster says; call it within :func:`gdal`.

    Args:
        location: Where the library finds it.
        name: What to call it in an error.
        options: The user's word on band, nodata value and CRS.
        trusted: Whether it is no file of the user's, so that its header needs no check.
    """
    import rasterio

    with rasterio.open(location) as dataset:
        if dataset.driver not in DRIVERS:
            raise InputError(
                f"{name}: format {dataset.driver} is not read: convert it to one of "
                f"{', '.join(DRIVERS)}"
            )
        band = choose_band(name, dataset.count, options.band)
        dtype = np.dtype(dataset.dtypes[band - 1])
        if dtype.kind not in "iuf":
            raise InputError(f"{name}: band {band} holds {dtype}: heights are integers or floats")
        if not trusted:
            sample_bytes = sum(np.dtype(kind).itemsize for kind in dataset.dtypes)
            check_claim(location, dataset.height, dataset.width, sample_bytes)
            if dataset.driver == "AAIGrid":
                check_ascii_grid(name, location)
        _check_transform(name, dataset.transform)
        declared = dataset.nodatavals[band - 1]
        flags = dataset.mask_flag_enums[band - 1]
        return Tile(
            location,
            dataset.driver,
            dataset.height,
            dataset.width,
            dataset.transform,
            choose_crs(name, dataset.crs, options.crs),
            "float64" if dataset.driver == "AAIGrid" else str(dtype),
            band,
            declared if options.nodata_value is None else options.nodata_value,
            declared is None and rasterio.enums.MaskFlags.per_dataset in flags,
            dataset.units[band - 1] or "",
            dataset.scales[band - 1],
            dataset.offsets[band - 1],
        )


def choose_band(name: str, count: int, wanted: int | None) -> int:
    """The band that holds the heights: the only one, or the one the user names.

    Raises:
        InputError: If there is no such band, or several and the user names none.
    """
    if wanted is None and count != 1:
        raise InputError(f"{name}: has {count} bands and heights are one: choose it with --band")
    if wanted is not None and wanted > count:
        raise InputError(f"{name}: band {wanted} does not exist: it has {count}")
    return wanted or 1


def choose_crs(name: str, own: Any, wanted: str | None) -> Any:
    """The raster's own coordinate reference system, or the user's where it has none.

    Raises:
        InputError: If the user's contradicts the raster's, or is none.
    """
    if wanted is None:
        return own or None
    said = parse_crs(wanted)
    if own and own != said:
        raise InputError(
            f"{name}: is in {own.to_string()[:60]}, so --crs {wanted} cannot hold; "
            "--to-crs resamples it to another"
        )
    return said


def parse_crs(text: str) -> Any:
    """A coordinate reference system from ``EPSG:n``, WKT or PROJ text.

    Raises:
        InputError: If it is unknown.
    """
    import rasterio
    from rasterio.crs import CRS
    from rasterio.errors import CRSError

    try:
        with rasterio.Env():
            crs = CRS.from_user_input(text)
    except (CRSError, ValueError):
        crs = None
    if not crs:
        raise InputError(f"CRS {text[:60]!r} is unknown: write it as EPSG:n or WKT")
    return crs


def height_scale(tile: Tile, options: ImportOptions) -> tuple[float, float]:
    """Gain and bias that turn a tile's samples into metres."""
    factor = unit_metres(options.z_unit or tile.unit or "m") * options.z_scale
    return tile.scale * factor, tile.offset * factor + options.z_offset


def _check_transform(name: str, transform: Any) -> None:
    numbers = tuple(transform)[:6]
    if not all(math.isfinite(number) for number in numbers):
        raise InputError(f"{name}: geotransform {numbers} is not finite; georeference it anew")
    if transform.determinant == 0.0:
        raise InputError(
            f"{name}: pixel size is {transform.a:g} x {transform.e:g}: spacing must not be zero"
        )
