"""Where posts come to stand, and that resampling is bilinear to the last count."""

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

SECOND = 1.0 / 3600.0
DEGREES = (3 * SECOND, 0.0, -117.0, 0.0, -3 * SECOND, 34.0)


def write_raster(
    path: Path, samples: npt.NDArray[Any], transform: tuple[float, ...], crs: str, **profile: Any
) -> Path:
    """A GeoTIFF of one band."""
    import rasterio

    with rasterio.open(
        path,
        "w",
        driver="GTiff",
        count=1,
        height=samples.shape[0],
        width=samples.shape[1],
        dtype=samples.dtype,
        crs=crs,
        transform=rasterio.Affine(*transform),
        **profile,
    ) as dataset:
        dataset.write(samples, 1)
    return path


def rough(rows: int, cols: int) -> npt.NDArray[np.float64]:
    """Heights without any smoothness, 0 to 1000 m."""
    return np.random.default_rng(7).uniform(0.0, 1000.0, (rows, cols))


def read(path: Path, **options: Any) -> SouthUpRows:
    """Rows of one file."""
    return open_input([path], ImportOptions(**options))


def counts(rows: SouthUpRows) -> Counts:
    """All posts."""
    return rows.read_rows(0, rows.grid.rows)


def bilinear(
    samples: npt.NDArray[np.float64], transform: tuple[float, ...], crs: str, rows: SouthUpRows
) -> npt.NDArray[np.float64]:
    """Heights at the posts straight from the formula; NaN outside the samples' centres."""
    from rasterio.warp import transform as project

    a, _, c, _, e, f = transform
    x, y = np.meshgrid(
        rows.grid.post_x(np.arange(rows.grid.cols)), rows.grid.post_y(np.arange(rows.grid.rows))
    )
    lon, lat = project(rows.grid.crs, crs, x.ravel().tolist(), y.ravel().tolist())
    u, v = (np.array(lon) - c) / a - 0.5, (np.array(lat) - f) / e - 0.5
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    inside = (i >= 0) & (j >= 0) & (i < samples.shape[1] - 1) & (j < samples.shape[0] - 1)
    i, j = np.where(inside, i, 0), np.where(inside, j, 0)
    u, v = u - i, v - j
    south = samples[j + 1, i] * (1 - u) + samples[j + 1, i + 1] * u
    height = (samples[j, i] * (1 - u) + samples[j, i + 1] * u) * (1 - v) + south * v
    return np.where(inside, height, np.nan).reshape(x.shape)


@pytest.mark.parametrize("spacing", [20.0, 75.0, 400.0])
def test_resampling_from_degrees_is_bilinear_at_any_spacing(tmp_path: Path, spacing: float) -> None:
    """Finer, like and coarser than the raster: four samples around each post and no others."""
    samples = rough(120, 90)
    path = write_raster(tmp_path / "a.tif", samples, DEGREES, "EPSG:4326")
    rows = read(path, spacing=spacing)
    expected = bilinear(samples, DEGREES, "EPSG:4326", rows)
    assert not np.isnan(expected).any()
    assert np.abs(counts(rows) - expected * 1e5).max() <= 0.51
    assert rows.grid.x % spacing == rows.grid.y % spacing == 0.0


@pytest.mark.parametrize(
    ("lon", "lat", "crs"),
    [
        (-117.0, 34.0, "EPSG:32611"),
        (-117.0, -34.0, "EPSG:32711"),
        (179.5, 1.0, "EPSG:32660"),
        (-180.0, 1.0, "EPSG:32601"),
        (10.0, 85.0, "EPSG:32661"),
        (10.0, -85.0, "EPSG:32761"),
    ],
)
def test_degrees_become_the_utm_zone_of_the_centre(
    tmp_path: Path, lon: float, lat: float, crs: str
) -> None:
    transform = (SECOND, 0.0, lon, 0.0, -SECOND, lat)
    path = write_raster(tmp_path / "a.tif", rough(30, 300), transform, "EPSG:4326")
    assert read(path).grid.crs == crs


def test_the_default_spacing_is_the_smaller_side_of_a_pixel_in_two_digits(tmp_path: Path) -> None:
    """3 arc-seconds at 34 N are 77 m wide and 92 m high."""
    path = write_raster(tmp_path / "a.tif", rough(40, 40), DEGREES, "EPSG:4326")
    rows = read(path)
    assert rows.grid.spacing == 77.0
    assert "at 77 m" in rows.provenance["posts"]


def test_the_rectangle_inside_holds_no_holes_and_all_of_it_holds_every_sample(
    tmp_path: Path,
) -> None:
    path = write_raster(tmp_path / "a.tif", rough(400, 300), DEGREES, "EPSG:4326")
    inside, everything = read(path), read(path, extent="all")
    assert (counts(inside) == HOLE).sum() == 0
    assert "leaves out" in inside.provenance["posts"]
    assert (counts(everything) == HOLE).sum() > 0
    assert everything.grid.rows > inside.grid.rows
    assert everything.grid.cols > inside.grid.cols


def test_holes_stay_where_the_nearest_sample_is_missing(tmp_path: Path) -> None:
    """Around a hole the rest of the four samples carries the height."""
    samples = np.full((60, 60), 100.0)
    samples[20:30, 20:30] = np.nan
    path = write_raster(tmp_path / "a.tif", samples, DEGREES, "EPSG:4326")
    rows = read(path, spacing=20.0)
    found = counts(rows)
    assert set(np.unique(found)) == {HOLE, 10_000_000}
    area = (found == HOLE).sum() * 20.0**2
    assert area == pytest.approx(10 * 10 * 77.0 * 92.4, rel=0.03)


def test_feet_and_web_mercator_become_ground_metres(tmp_path: Path) -> None:
    """Neither's unit is a metre on the ground: EPSG:2229 counts US survey feet."""
    transform = (100.0, 0.0, 6_500_000.0, 0.0, -100.0, 1_900_000.0)
    feet = read(write_raster(tmp_path / "a.tif", rough(50, 50), transform, "EPSG:2229"))
    assert (feet.grid.crs, feet.grid.spacing) == ("EPSG:32611", 30.0)
    transform = (120.0, 0.0, -13_024_380.0, 0.0, -120.0, 4_028_802.0)
    web = read(write_raster(tmp_path / "b.tif", rough(50, 50), transform, "EPSG:3857"))
    assert web.grid.crs == "EPSG:32611"
    assert web.grid.spacing == pytest.approx(120.0 * np.cos(np.radians(34.0)), rel=0.02)


def test_to_crs_names_the_target(tmp_path: Path) -> None:
    path = write_raster(tmp_path / "a.tif", rough(50, 50), DEGREES, "EPSG:4326")
    assert read(path, to_crs="EPSG:32612").grid.crs == "EPSG:32612"
    with pytest.raises(InputError, match=r"lies outside EPSG:32611.*--to-crs"):
        read(
            write_raster(
                tmp_path / "b.tif", rough(5, 5), (1.0, 0.0, 400.0, 0.0, -1.0, 95.0), "EPSG:4326"
            ),
            to_crs="EPSG:32611",
        )


def test_pixels_that_are_not_square_become_square(tmp_path: Path) -> None:
    """20 m by 40 m: the south-western sample stays, every other row is a sample."""
    samples = rough(10, 12)
    transform = (20.0, 0.0, 1000.0, 0.0, -40.0, 5000.0)
    rows = read(write_raster(tmp_path / "a.tif", samples, transform, "EPSG:32611"))
    grid = rows.grid
    assert (grid.rows, grid.cols, grid.spacing, grid.x, grid.y) == (19, 12, 20.0, 1010.0, 4620.0)
    found = counts(rows)
    np.testing.assert_allclose(found[::2], samples[::-1] * 1e5, atol=0.51)
    np.testing.assert_allclose(
        found[1::2], (samples[::-1][1:] + samples[::-1][:-1]) * 5e4, atol=0.51
    )


def test_a_raster_from_the_south_is_turned(tmp_path: Path) -> None:
    samples = rough(6, 5)
    transform = (10.0, 0.0, 0.0, 0.0, 10.0, 100.0)
    rows = read(write_raster(tmp_path / "a.tif", samples, transform, "EPSG:32611"))
    assert (rows.grid.x, rows.grid.y) == (5.0, 105.0)
    np.testing.assert_allclose(counts(rows), samples * 1e5, atol=0.51)


def test_a_rotated_raster_is_resampled_upright(tmp_path: Path) -> None:
    """Turned by the 3-4-5 angle, a plane stays the plane it was."""
    cos, sin, s = 0.8, 0.6, 10.0
    transform = (s * cos, s * sin, 1000.0, s * sin, -s * cos, 2000.0)
    col, row = np.meshgrid(np.arange(60) + 0.5, np.arange(50) + 0.5)
    x = transform[0] * col + transform[1] * row + transform[2]
    y = transform[3] * col + transform[4] * row + transform[5]
    path = write_raster(tmp_path / "a.tif", 0.5 * x + 0.25 * y, transform, "EPSG:32611")
    rows = read(path)
    found = counts(rows)
    inner = found[30:45, 30:45]
    assert rows.grid.spacing == 10.0
    x, y = np.meshgrid(rows.grid.post_x(np.arange(30, 45)), rows.grid.post_y(np.arange(30, 45)))
    np.testing.assert_allclose(inner, (0.5 * x + 0.25 * y) * 1e5, atol=0.51)
    assert (found == HOLE).sum() > 0


@pytest.mark.parametrize(
    ("size", "said"), [("0", "spacing must not be zero"), ("nan", "is not finite")]
)
def test_a_geotransform_without_size_is_refused(tmp_path: Path, size: str, said: str) -> None:
    grid = tmp_path / "a.asc"
    grid.write_text(f"ncols 2\nnrows 2\nxllcorner 0\nyllcorner 0\ncellsize {size}\n1 2\n3 4\n")
    with pytest.raises(InputError, match=said):
        read(grid, spacing=1.0)
