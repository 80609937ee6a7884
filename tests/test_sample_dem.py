"""The elevation sample that comes with matplotlib."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from terrasim.counts import HOLE, to_metres
from terrasim.dem.import_options import ImportOptions
from terrasim.dem.imports import open_input
from terrasim.dem.sample_dem import sample_dem
from terrasim.errors import InputError


def test_jacksboro_stands_in_utm_16_without_holes() -> None:
    rows = sample_dem("jacksboro_fault_dem")
    heights = to_metres(rows.read_rows(0, rows.grid.rows))
    assert (rows.grid.spacing, rows.grid.crs) == (90.0, "EPSG:32616")
    assert not np.isnan(heights).any()
    assert heights.min() >= 236.0
    assert heights.max() <= 1076.0
    assert rows.provenance["range_m"] == [236.0, 1076.0]


def test_its_first_row_is_the_northern_one() -> None:
    """The sample at 36.70 N 84.30 W, well inside, by hand from the array."""
    from matplotlib import cbook
    from rasterio.warp import transform

    data: Any = cbook.get_sample_data("jacksboro_fault_dem.npz")
    row, col = 39, 136
    lon = float(data["xmin"]) + (col + 0.5) * float(data["dx"])
    lat = float(data["ymin"]) - (row + 0.5) * float(data["dy"])
    (x,), (y,) = transform("EPSG:4326", "EPSG:32616", [lon], [lat])
    rows = sample_dem("jacksboro_fault_dem", spacing=10.0)
    grid = rows.grid
    post = rows.read_rows(round((y - grid.y) / 10.0), 1)[0, round((x - grid.x) / 10.0)]
    around = data["elevation"][row - 1 : row + 2, col - 1 : col + 2]
    slope = np.ptp(around) / 75.0
    assert lat == pytest.approx(36.70, abs=1e-3)
    assert post * 1e-5 == pytest.approx(float(data["elevation"][row, col]), abs=7.1 * slope + 0.01)


def test_an_import_takes_a_sample_by_name() -> None:
    rows = open_input(["sample:jacksboro_fault_dem"], ImportOptions(spacing=300.0, extent="all"))
    assert rows.grid.spacing == 300.0
    assert (rows.read_rows(0, rows.grid.rows) == HOLE).any()


def test_an_unknown_sample_is_refused() -> None:
    with pytest.raises(InputError, match="sample 'everest' is unknown: it must be one of jacks"):
        sample_dem("everest")
