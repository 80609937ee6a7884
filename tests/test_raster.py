"""Georeferenced rasters: corners, units, missing heights, resampling."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.counts import HOLE, Counts
from terrasim.dem.height_rows import SouthUpRows
from terrasim.dem.import_options import ImportOptions
from terrasim.dem.imports import open_input
from terrasim.errors import InputError

UTM = "EPSG:32611"


def write_tiff(
    path: Path,
    samples: npt.ArrayLike,
    *,
    transform: tuple[float, ...] = (30.0, 0.0, 500_000.0, 0.0, -30.0, 3_800_000.0),
    crs: str | None = UTM,
    unit: str = "",
    **profile: Any,
) -> Path:
    """A GeoTIFF of one or several bands."""
    import rasterio

    bands = np.atleast_3d(np.asarray(samples)) if np.ndim(samples) == 2 else np.asarray(samples)
    if np.ndim(samples) == 2:
        bands = bands.transpose(2, 0, 1)
    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        count=bands.shape[0],
        height=bands.shape[1],
        width=bands.shape[2],
        dtype=bands.dtype,
        crs=crs,
        transform=rasterio.Affine(*transform),
        **profile,
    ) as dataset:
        dataset.write(bands)
        if unit:
            dataset.units = (unit,) * bands.shape[0]
    return path


def heights(rows: int = 5, cols: int = 7) -> npt.NDArray[np.int16]:
    """Heights that tell every sample from every other."""
    return (np.arange(rows * cols, dtype=np.int16) * 3).reshape(rows, cols)


def read(path: Path | str, **options: Any) -> SouthUpRows:
    """Rows of one file."""
    return open_input([path], ImportOptions(**options))


def all_counts(rows: SouthUpRows, step: int = 1000) -> Counts:
    """All posts, read in windows of so many rows."""
    whole = rows.grid.rows
    return np.vstack([rows.read_rows(r, min(step, whole - r)) for r in range(0, whole, step)])


def test_a_raster_runs_from_the_north_and_the_grid_from_the_south(tmp_path: Path) -> None:
    rows = read(write_tiff(tmp_path / "a.tif", heights()))
    np.testing.assert_array_equal(all_counts(rows), heights()[::-1].astype(np.int32) * 100_000)


def test_posts_stand_at_pixel_centres(tmp_path: Path) -> None:
    """The southern edge of 5 rows of 30 m lies 150 m below the northern one."""
    grid = read(write_tiff(tmp_path / "a.tif", heights())).grid
    assert (grid.x, grid.y) == (500_015.0, 3_799_865.0)
    assert (grid.rows, grid.cols, grid.spacing, grid.crs) == (5, 7, 30.0, UTM)


def test_known_corners_of_real_files(shared_terrain: Path) -> None:
    """Corner and highest samples as GDAL tells them by their place in the file."""
    tiff = read(shared_terrain / "srtm_bigtujunga30m_utm11.tif")
    dem = read(shared_terrain / "SainteHelens.dem")
    asc = read(shared_terrain / "bijou_gully_subset_5m.asc", spacing=4.988744589)
    assert (tiff.grid.rows, tiff.grid.cols) == (643, 1197)
    assert tiff.grid.x == pytest.approx(376_328.655, abs=1e-3)
    assert tiff.grid.y == pytest.approx(3_788_642.828, abs=1e-3)
    assert (dem.grid.x, dem.grid.y, dem.grid.crs) == (557_820.0, 5_107_980.0, "EPSG:26710")
    assert dem.provenance["nodata_samples"] == 4151
    assert dem.provenance["range_m"] == [682.0, 2543.0]
    # The first number in the file is the north-western one.
    assert asc.read_rows(76, 1)[0, 0] == round(1.726645996093750e3 * 1e5)
    assert (asc.grid.spacing, asc.grid.crs) == (4.988744589, None)


def test_any_window_of_rows_equals_the_whole(shared_terrain: Path) -> None:
    """Also where posts are resampled, and where holes are filled."""
    for name, options in (
        ("N47W123.hgt", {"spacing": 200.0}),
        ("SainteHelens.dem", {"nodata": "fill", "fill_distance": 20}),
    ):
        path = shared_terrain / name
        whole = all_counts(read(path, **options))
        np.testing.assert_array_equal(all_counts(read(path, **options), 37), whole)
        np.testing.assert_array_equal(read(path, **options).read_rows(101, 3), whole[101:104])


@pytest.mark.parametrize(
    ("unit", "option", "metres"),
    [
        ("", None, 1.0),
        ("m", None, 1.0),
        ("ft", None, 0.3048),
        ("US survey foot", None, 1200 / 3937),
        ("m", "ft", 0.3048),
        ("parsec", "ft", 0.3048),
    ],
)
def test_vertical_units_become_metres(
    tmp_path: Path, unit: str, option: str | None, metres: float
) -> None:
    """The band's unit holds unless the user names another."""
    rows = read(write_tiff(tmp_path / "a.tif", heights(), unit=unit), z_unit=option)
    assert rows.read_rows(0, 1)[0, 6] == round(int(heights()[4, 6]) * metres * 1e5)
    assert rows.provenance["metres_per_count"] == pytest.approx(metres)


def test_an_unknown_vertical_unit_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"'parsec' is unknown: .*--z-unit"):
        read(write_tiff(tmp_path / "a.tif", heights(), unit="parsec"))


def test_a_bands_scale_and_offset_hold(tmp_path: Path) -> None:
    """A raster in tenths of a metre from -100 m up, further scaled and moved by the user."""
    import rasterio

    path = write_tiff(tmp_path / "a.tif", heights())
    with rasterio.open(path, "r+") as dataset:
        dataset.scales, dataset.offsets = (0.1,), (-100.0,)
    assert read(path).read_rows(4, 1)[0, 1] == round((0.3 - 100.0) * 1e5)
    scaled = read(path, z_scale=2.0, z_offset=7.0, datum=10.0)
    assert scaled.read_rows(4, 1)[0, 1] == round(((0.3 - 100.0) * 2.0 + 7.0 - 10.0) * 1e5)


def test_nodata_nan_and_masked_samples_are_holes_and_counted(tmp_path: Path) -> None:
    import rasterio

    samples = heights().astype(np.float32)
    samples[0, 0], samples[4, 6] = -9999.0, np.nan
    declared = read(write_tiff(tmp_path / "a.tif", samples, nodata=-9999.0))
    found = all_counts(declared)
    assert found[4, 0] == found[0, 6] == HOLE
    assert (found == HOLE).sum() == declared.holes == declared.provenance["nodata_samples"] == 2

    with rasterio.open(write_tiff(tmp_path / "b.tif", heights()), "r+") as dataset:
        mask = np.full((5, 7), 255, np.uint8)
        mask[2, 3] = 0
        dataset.write_mask(mask)
    assert np.argwhere(all_counts(read(tmp_path / "b.tif")) == HOLE).tolist() == [[2, 3]]

    said = read(write_tiff(tmp_path / "c.tif", heights()), nodata_value=0.0)
    assert np.argwhere(all_counts(said) == HOLE).tolist() == [[4, 0]]


def test_the_lowest_float32_as_nodata_is_a_hole(tmp_path: Path) -> None:
    """Its decimal text must come back as the same number."""
    samples = heights().astype(np.float32)
    lowest = float(np.finfo(np.float32).min)
    samples[1, 1] = lowest
    rows = read(write_tiff(tmp_path / "a.tif", samples, nodata=lowest))
    assert rows.provenance["nodata_samples"] == 1


def test_filling_takes_neighbours_and_counts_what_is_left(tmp_path: Path) -> None:
    """On level ground a hole two wide is filled level; beyond the distance holes stay."""
    samples = np.full((40, 40), 12.5, np.float32)
    samples[5:7, 5:7] = samples[20:40, 20:40] = np.nan
    path = write_tiff(tmp_path / "a.tif", samples)
    rows = read(path, nodata="fill", fill_distance=3)
    found = all_counts(rows)
    assert set(np.unique(found)) == {HOLE, 1_250_000}
    assert rows.holes == (found == HOLE).sum() > 0
    assert rows.filled == 404 - rows.holes >= 4
    assert rows.history()["filled"] == rows.filled
    assert (found[33:35, 5:7] == 1_250_000).all()


def test_known_heights_are_not_touched_by_filling(tmp_path: Path) -> None:
    samples = np.random.default_rng(1).uniform(4000, 4001, (30, 30))
    samples[10, 10] = np.nan
    path = write_tiff(tmp_path / "a.tif", samples)
    holes, filled = all_counts(read(path)), all_counts(read(path, nodata="fill"))
    assert (holes != filled).sum() == 1


def test_integers_beyond_float32_stay_exact(tmp_path: Path) -> None:
    """An int32 raster in tenths of a millimetre needs 28 bits."""
    samples = np.array([[134_217_729, 1], [2, 3]], np.int32)
    rows = read(write_tiff(tmp_path / "a.tif", samples), z_scale=1e-4)
    assert rows.read_rows(1, 1)[0, 0] == 1_342_177_290


@pytest.mark.parametrize(
    ("samples", "options", "said"),
    [
        (np.array([[1.0, np.inf], [0.0, 0.0]]), {}, "height inf m at row 0, column 1"),
        (np.array([[1.0, 0.0], [-30_000.0, 0.0]]), {}, "height -30000 m at row 1, column 0"),
        (np.array([[1.0, np.inf], [0.0, 0.0]]), {"spacing": 15.0}, "height inf m at row 0"),
        (np.full((2, 2), np.nan), {}, "none of its 4 samples has a height"),
        (np.zeros((3, 2, 2), np.int16), {}, "has 3 bands and heights are one"),
        (np.zeros((3, 2, 2), np.int16), {"band": 4}, "band 4 does not exist: it has 3"),
        (np.zeros((2, 2), np.complex64), {}, "band 1 holds complex64"),
        (np.zeros((2, 2), np.int16), {"crs": "EPSG:32612"}, "so --crs EPSG:32612 cannot hold"),
        (np.zeros((2, 2), np.int16), {"to_crs": "EPSG:4326"}, "not in ground metres"),
        (np.zeros((2, 2), np.int16), {"to_crs": "EPSG:999999"}, "'EPSG:999999' is unknown"),
        (np.zeros((2, 2), np.int16), {"spacing": 500.0}, "1 x 1 posts"),
        (np.zeros((2, 2), np.int16), {"spacing": 1e-7}, "choose another --spacing"),
        (np.zeros((2, 2), np.int16), {"encoding": "terrarium"}, "terrarium is for images"),
    ],
)
def test_what_a_raster_must_not_hold_is_refused(
    tmp_path: Path, samples: npt.NDArray[Any], options: dict[str, Any], said: str
) -> None:
    with pytest.raises(InputError) as error:
        read(write_tiff(tmp_path / "a.tif", samples), **options)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_one_band_of_several_is_read(tmp_path: Path) -> None:
    samples = np.stack([heights(), heights() + 1, heights() + 2])
    rows = read(write_tiff(tmp_path / "a.tif", samples), band=2)
    assert rows.read_rows(4, 1)[0, 0] == 100_000


def test_a_raster_without_crs_needs_the_users_word(tmp_path: Path) -> None:
    path = write_tiff(tmp_path / "a.tif", heights(), crs=None)
    with pytest.raises(InputError, match=r"names no CRS.*--crs, or --spacing"):
        read(path)
    assert read(path, crs=UTM).grid.crs == UTM
    local = read(path, spacing=30.0)
    assert (local.grid.crs, local.grid.spacing) == (None, 30.0)
    np.testing.assert_array_equal(all_counts(local), all_counts(read(path, crs=UTM)))
    halved = read(path, spacing=15.0)
    np.testing.assert_array_equal(all_counts(halved)[::2, ::2], all_counts(local))


def test_ascii_words_and_late_fractions_are_not_misread(tmp_path: Path) -> None:
    """GDAL takes a word for 0 and a grid that begins with integers for one of integers."""
    head = "ncols 3\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize 1\n"
    grid = tmp_path / "a.asc"
    grid.write_text(f"{head}1 2 3\n4 5 x\n")
    with pytest.raises(InputError, match="b'x' stands among its samples"):
        read(grid, spacing=1.0)
    grid.write_text(f"{head}1 2 3\n4 5.25 nan\n")
    assert read(grid, spacing=1.0).read_rows(0, 1).tolist() == [[400_000, 525_000, HOLE]]
    lines = "1 " * 60_000 + "0.125"
    grid.write_text(f"{head.replace('3', '60001', 1).replace('2', '1', 1)}{lines}\n")
    with pytest.raises(InputError, match="at least 2 x 2"):
        read(grid, spacing=1.0)
    grid.write_text(f"{head.replace('3', '60001', 1)}{lines}\n{lines}\n")
    assert read(grid, spacing=1.0).read_rows(0, 1)[0, -1] == 12_500
