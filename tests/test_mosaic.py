"""Several rasters as one: which sample wins, what is said of the seam, what does not fit."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.counts import HOLE
from terrasim.dem.import_options import ImportOptions
from terrasim.dem.imports import open_input
from terrasim.errors import InputError


def write_tile(
    path: Path,
    samples: npt.ArrayLike,
    *,
    col: float = 0,
    row: float = 0,
    size: float = 10.0,
    crs: str = "EPSG:32611",
    unit: str = "",
    **profile: Any,
) -> Path:
    """A GeoTIFF whose first sample lies so many columns east and rows south of a fixed corner."""
    import rasterio

    array = np.asarray(samples)
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        count=1,
        height=array.shape[0],
        width=array.shape[1],
        dtype=array.dtype,
        crs=crs,
        transform=rasterio.Affine(size, 0.0, 5000.0 + col * size, 0.0, -size, 9000.0 - row * size),
        **profile,
    ) as dataset:
        dataset.write(array, 1)
        dataset.units = (unit,)
    return path


def test_the_real_seam_is_reported_to_the_sample(shared_terrain: Path) -> None:
    """Of the 1,201 samples on 48 N, 502 differ, by up to 31 m."""
    paths = [shared_terrain / "N47W123.hgt", shared_terrain / "N48W123.hgt"]
    seam = open_input(paths, scan=False).provenance["seam"]
    assert (seam["compared"], seam["differ"], seam["largest_m"]) == (1201, 502, 31.0)
    assert "first wins" in seam["rule"]


def test_the_raster_named_first_wins_on_the_real_seam(shared_terrain: Path) -> None:
    """In the files' own degrees, so that no resampling stands between."""
    import rasterio

    from terrasim.dem.mosaic import join, vrt
    from terrasim.dem.raster import read_tile

    paths = [shared_terrain / "N47W123.hgt", shared_terrain / "N48W123.hgt"]
    with rasterio.open(paths[0]) as south, rasterio.open(paths[1]) as north:
        below, above = south.read(1), north.read(1)
    for order, shared in (((0, 1), below[0]), ((1, 0), above[-1])):
        tiles = [read_tile(paths[i], ImportOptions()) for i in order]
        with rasterio.open(vrt(join(tiles))) as dataset:
            whole = dataset.read(1)
        assert whole.shape == (2401, 1201)
        np.testing.assert_array_equal(whole[1200], shared)
        np.testing.assert_array_equal(whole[:1200], above[:1200])
        np.testing.assert_array_equal(whole[1201:], below[1:])


def test_tiles_find_their_places_and_gaps_are_holes(tmp_path: Path) -> None:
    """Two tiles corner to corner, named in either order, of different types and nodata values."""
    one = write_tile(tmp_path / "a.tif", np.full((2, 3), 7, np.int16), col=3, row=0)
    two = write_tile(tmp_path / "b.tif", np.full((2, 3), 9.5, np.float32), col=0, row=2)
    for paths in ((one, two), (two, one)):
        rows = open_input(paths)
        found = rows.read_rows(0, 4)
        np.testing.assert_array_equal(found[:2, :3], 950_000)
        np.testing.assert_array_equal(found[2:, 3:], 700_000)
        assert (found == HOLE).sum() == 12 == rows.provenance["nodata_samples"]
        assert (rows.grid.x, rows.grid.y) == (5005.0, 8965.0)
        assert rows.provenance["seam"]["compared"] == 0


def test_a_hole_of_the_first_is_filled_by_the_second(tmp_path: Path) -> None:
    """And is no mismatch: only samples that both have are compared."""
    first = np.full((3, 3), 10, np.int16)
    first[1, 1] = -32768
    second = np.full((3, 3), 10, np.int16)
    second[1, 1], second[0, 2] = 20, 14
    rows = open_input(
        [
            write_tile(tmp_path / "a.tif", first, nodata=-32768),
            write_tile(tmp_path / "b.tif", second, nodata=0),
        ]
    )
    found = rows.read_rows(0, 3)
    assert found[1, 1] == 2_000_000
    assert found[2, 2] == 1_000_000
    seam = rows.provenance["seam"]
    assert (seam["compared"], seam["differ"], seam["largest_m"]) == (8, 1, 4.0)


def test_seams_are_measured_in_metres(tmp_path: Path) -> None:
    paths = [
        write_tile(tmp_path / "a.tif", np.full((2, 2), 100, np.int16), unit="ft"),
        write_tile(tmp_path / "b.tif", np.full((2, 2), 110, np.int16), unit="ft"),
    ]
    assert open_input(paths).provenance["seam"]["largest_m"] == pytest.approx(3.048)


@pytest.mark.parametrize(
    ("other", "said"),
    [
        ({"col": 2.5}, "0.5 spacings off the lattice"),
        ({"size": 10.1}, "off the lattice"),
        ({"crs": "EPSG:32612"}, "CRS is EPSG:32612"),
        ({"unit": "ft"}, "vertical unit is ft"),
        ({"col": 3e9}, "are they neighbours"),
    ],
)
def test_rasters_that_do_not_fit_are_refused(
    tmp_path: Path, other: dict[str, Any], said: str
) -> None:
    samples = np.zeros((4, 4), np.int16)
    paths = [
        write_tile(tmp_path / "a.tif", samples),
        write_tile(tmp_path / "b.tif", samples, **other),
    ]
    with pytest.raises(InputError) as error:
        open_input(paths)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_odd_file_names_are_found(tmp_path: Path) -> None:
    """Names are quoted where they stand in the joined dataset's description."""
    folder = tmp_path / "a & b <c>"
    folder.mkdir()
    samples = np.full((2, 2), 3, np.int16)
    paths = [write_tile(folder / f"'{i}\" é.tif", samples, col=2 * i) for i in range(2)]
    assert (open_input(paths).read_rows(0, 2) == 300_000).all()
