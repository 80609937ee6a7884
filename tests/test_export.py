"""Heights written to GeoTIFF and EXR: where they lie, and that nothing is lost."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from terrasim.counts import HOLE, Counts
from terrasim.dem.export import BAND, export
from terrasim.dem.imports import ImportOptions, import_terrain
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.sources.array_source import ArraySource
from terrasim.store.store import open_store


def terrain(
    rows: int = BAND + 45, cols: int = 70, *, crs: str | None = "EPSG:32611"
) -> ArraySource:
    """Rough heights with a hole, placed where a negative row and column begin."""
    rng = np.random.default_rng(7)
    counts: Counts = rng.integers(-(10**8), 10**8, size=(rows, cols), dtype=np.int32)
    counts[3, 5] = HOLE
    grid = Grid(rows, cols, 0.5, 400_000.0, 3_700_000.0, row=-20, col=-7, datum=123.25, crs=crs)
    return ArraySource(counts, grid)


def all_posts(source: ArraySource) -> Counts:
    grid = source.grid
    rows = np.arange(grid.row, grid.row + grid.rows)
    return source.posts(0, rows, np.arange(grid.col, grid.col + grid.cols))


def test_a_geotiff_read_back_has_the_same_counts_and_place(tmp_path: Path) -> None:
    """Export and import again: every count, the CRS and the place are the same."""
    source = terrain()
    said = export(source, tmp_path / "a.tif")
    assert said["holes"] == 1
    assert said["rounding_m"] == 0.0
    import_terrain([tmp_path / "a.tif"], tmp_path / "a.store", ImportOptions(datum=123.25))
    with open_store(tmp_path / "a.store") as back:
        grid = back.grid
        rows, cols = np.arange(grid.row, grid.row + grid.rows), np.arange(grid.col, grid.col + 70)
        np.testing.assert_array_equal(back.posts(0, rows, cols), all_posts(source))
        assert grid.crs == "EPSG:32611"
        assert grid.spacing == 0.5
        assert grid.post_x(grid.col) == source.grid.post_x(-7)
        assert grid.post_y(grid.row) == source.grid.post_y(-20)


def test_the_first_row_of_the_file_is_the_northern_edge(tmp_path: Path) -> None:
    """A map reader finds the last row of posts first, and pixel centres at the posts."""
    import rasterio

    source = terrain()
    export(source, tmp_path / "a.tiff")
    with rasterio.open(tmp_path / "a.tiff") as file:
        counts = np.rint((file.read(1) - 123.25) * 1e5)
        assert file.xy(0, 0) == (source.grid.post_x(-7), source.grid.post_y(-20 + BAND + 44))
        assert np.isnan(file.nodata)
    np.testing.assert_array_equal(counts[0], all_posts(source)[-1])


def test_an_exr_holds_float32_and_says_what_that_costs(tmp_path: Path) -> None:
    """Every pixel is the nearest float32, and the stated rounding is the largest there is."""
    import OpenImageIO

    source = terrain(crs=None)
    said = export(source, tmp_path / "a.exr")
    image = OpenImageIO.ImageBuf(str(tmp_path / "a.exr")).get_pixels(OpenImageIO.FLOAT)
    assert image is not None
    pixels = image[::-1, :, 0]
    counts = all_posts(source)
    exact = np.where(counts == HOLE, np.nan, counts * 1e-5 + 123.25)
    np.testing.assert_array_equal(pixels, exact.astype(np.float32))
    assert said["rounding_m"] == np.nanmax(np.abs(exact - pixels))
    assert said["rounding_m"] > 0.0


def test_a_wrong_target_is_refused_and_nothing_is_left(tmp_path: Path) -> None:
    """Another ending, a file that is there, a folder that is not: one line each, no file."""
    source = terrain()
    (tmp_path / "there.tif").write_bytes(b"mine")
    with pytest.raises(InputError, match=r"exports are \.tif"):
        export(source, tmp_path / "a.png")
    with pytest.raises(InputError, match="exists; remove it"):
        export(source, tmp_path / "there.tif")
    with pytest.raises(InputError, match="no folder"):
        export(source, tmp_path / "no" / "a.tif")
    assert [path.name for path in tmp_path.iterdir()] == ["there.tif"]
    assert (tmp_path / "there.tif").read_bytes() == b"mine"


def test_an_export_that_fails_leaves_no_file(tmp_path: Path) -> None:
    """A source that breaks in the middle leaves neither the file nor its unfinished half."""

    class Broken(ArraySource):
        def posts(self, level: int, rows: object, cols: object) -> Counts:
            if int(np.min(rows)) < 0:  # type: ignore[call-overload]
                raise InputError("the disk has gone")
            return super().posts(level, rows, cols)  # type: ignore[arg-type]

    whole = terrain()
    source = Broken(all_posts(whole), whole.grid)
    for ending in ("tif", "exr"):
        with pytest.raises(InputError, match="has gone"):
            export(source, tmp_path / f"a.{ending}")
    assert list(tmp_path.iterdir()) == []
