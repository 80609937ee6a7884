"""Real elevation that comes with a library: no file, no download."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.dem.height_rows import SouthUpRows
from terrasim.dem.import_options import ImportOptions
from terrasim.dem.raster import describe_tile, gdal
from terrasim.dem.raster_rows import tile_rows
from terrasim.errors import InputError

SAMPLES = ("jacksboro_fault_dem",)
"""Names of the samples there are."""
SPACING = 90.0
"""Spacing of a sample by default [m]: that of its 3 arc-seconds."""


def sample_dem(name: str, spacing: float | None = None) -> SouthUpRows:
    """A sample on a metric grid.

    ``jacksboro_fault_dem``: 344 x 403 heights of SRTM at 3 arc-seconds near 36.6 N 84.2 W, from
    matplotlib's sample data, resampled to UTM zone 16 N.

    Args:
        name: One of :data:`SAMPLES`.
        spacing: Distance between posts [m]; 90 by default.

    Raises:
        InputError: If there is no such sample.
    """
    options = ImportOptions(spacing=SPACING if spacing is None else spacing)
    return sample_rows(name, options)


def sample_rows(name: str, options: ImportOptions) -> SouthUpRows:
    """The same with all the options of an import."""
    from rasterio.io import MemoryFile

    heights, transform = _load(name)
    with gdal(name):
        memory = MemoryFile()
        with memory.open(
            driver="GTiff",
            height=heights.shape[0],
            width=heights.shape[1],
            count=1,
            dtype=heights.dtype,
            crs="EPSG:4326",
            transform=transform,
        ) as dataset:
            dataset.write(heights, 1)
        tile = describe_tile(memory.name, name, options, trusted=True)
    return tile_rows([f"matplotlib sample data: {name}"], [tile], options, below=(memory,))


def _load(name: str) -> tuple[npt.NDArray[np.int16], Any]:
    """Heights [m] from the north, and their transform in longitude and latitude."""
    if name not in SAMPLES:
        raise InputError(f"sample {name!r} is unknown: it must be one of {', '.join(SAMPLES)}")
    from matplotlib import cbook
    from rasterio import Affine

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        data: Any = cbook.get_sample_data(f"{name}.npz")
        with data:
            heights = np.asarray(data["elevation"], dtype=np.int16)
            # The file calls the northern edge ymin: rows run from the north.
            west, north = float(data["xmin"]), float(data["ymin"])
            width, height = float(data["dx"]), float(data["dy"])
    return heights, Affine(width, 0.0, west, 0.0, -height, north)
