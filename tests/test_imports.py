"""What an input is, what is said of it, what it becomes in a store, and what is refused."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.counts import HOLE
from terrasim.dem.import_options import ImportOptions
from terrasim.dem.imports import describe_input, import_terrain, open_input
from terrasim.errors import InputError
from terrasim.store.store import open_store

VRT = (
    b"<VRTDataset rasterXSize='2' rasterYSize='2'>"
    b"<VRTRasterBand dataType='Byte' band='1'/></VRTDataset>"
)


def write_dem(path: Path, samples: npt.NDArray[Any], **profile: Any) -> Path:
    """A GeoTIFF at 30 m in UTM 11 N."""
    import rasterio

    rows, cols = samples.shape
    settings = {
        "crs": "EPSG:32611",
        "transform": rasterio.Affine(30.0, 0.0, 0.0, 0.0, -30.0, 900.0),
        **profile,
    }
    with rasterio.open(
        path, "w", "GTiff", cols, rows, 1, dtype=samples.dtype, **settings
    ) as dataset:
        dataset.write(samples, 1)
    return path


def rough(rows: int = 300, cols: int = 280) -> npt.NDArray[np.int16]:
    """Heights without any smoothness."""
    return np.random.default_rng(3).integers(0, 2000, (rows, cols), dtype=np.int16)


def test_an_imported_store_holds_the_raster_to_the_count(tmp_path: Path) -> None:
    """Every post, and the north-western sample where it belongs: the last row, first column."""
    samples = rough()
    samples[7, 9] = -32768
    dem = write_dem(tmp_path / "a.tif", samples, nodata=-32768)
    report = import_terrain([dem], tmp_path / "a.store")
    source = open_store(tmp_path / "a.store")
    posts = source.posts(0, np.arange(300), np.arange(280))
    expected = np.where(samples == -32768, HOLE, samples.astype(np.int64) * 100_000)[::-1]
    np.testing.assert_array_equal(posts, expected)
    assert posts[299, 0] == int(samples[0, 0]) * 100_000
    assert (source.grid.x, source.grid.y) == (15.0, 900.0 - 299.5 * 30.0)
    assert source.grid.crs == "EPSG:32611"
    assert report["holes"] == report["store"]["holes"] == 1
    json.dumps(report, allow_nan=False)


def test_a_store_remembers_where_it_came_from(tmp_path: Path) -> None:
    """Also what became of the holes, which is known only at the end."""
    samples = rough()
    samples[7:9, 9:12] = -32768
    dem = write_dem(tmp_path / "a.tif", samples, nodata=-32768)
    import_terrain([dem], tmp_path / "a.store", ImportOptions(nodata="fill"))
    said: Any = open_store(tmp_path / "a.store").provenance
    assert (said["nodata_samples"], said["filled"], said["holes"]) == (6, 6, 0)
    assert said["driver"] == "GTiff"
    assert said["files"] == [{"path": str(dem), "rows": 300, "cols": 280}]
    assert said["crs"] == "EPSG:32611"
    assert "pixel centres" in said["posts"]
    assert "filled" in said["nodata"]


def test_progress_runs_from_nothing_to_one(tmp_path: Path) -> None:
    told: list[float] = []
    dem = write_dem(tmp_path / "a.tif", rough())
    import_terrain([dem], tmp_path / "a.store", progress=lambda done, _what: told.append(done))
    assert told == sorted(told)
    assert 0.0 < told[0] <= 0.15
    assert told[-1] == 1.0


def test_bad_heights_leave_no_store_behind(tmp_path: Path) -> None:
    samples = rough().astype(np.float32)
    samples[250, 3] = np.inf
    dem = write_dem(tmp_path / "a.tif", samples)
    with pytest.raises(InputError, match="height inf m at row 250, column 3"):
        import_terrain([dem], tmp_path / "a.store")
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]


def test_a_description_says_what_the_file_and_the_grid_are(shared_terrain: Path) -> None:
    said = describe_input([shared_terrain / "SainteHelens.dem"])
    assert said["driver"] == "USGSDEM"
    assert said["bounds"] == [557805.0, 5107965.0, 567615.0, 5122005.0]
    assert (said["vertical_unit"], said["nodata_value"]) == ("m", "-32767.0")
    assert said["grid"]["rows"] == 468
    assert said["grid"]["spacing_m"] == 30.0
    json.dumps(said, allow_nan=False)


def test_a_huge_raster_is_described_without_being_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dem = write_dem(tmp_path / "a.tif", rough())
    assert "range_m" in describe_input([dem])
    assert "range_m" not in describe_input([dem], scan=False)
    monkeypatch.setattr("terrasim.dem.imports._SCANNED", 1000)
    assert "range_m" not in describe_input([dem])
    assert "range_m" in describe_input([dem], scan=True)


def test_a_tiff_is_a_raster_if_it_is_georeferenced_and_an_image_if_not(tmp_path: Path) -> None:
    samples = rough(5, 6)
    placed = write_dem(tmp_path / "a.tif", samples)
    assert open_input([placed]).provenance["driver"] == "GTiff"
    with pytest.warns(UserWarning, match="no geotransform"):
        bare = write_dem(tmp_path / "b.tif", samples, crs=None, transform=None)
    rows = open_input([bare], ImportOptions(spacing=2.0))
    assert rows.provenance["driver"] == "tiff int16"
    np.testing.assert_array_equal(rows.read_rows(0, 5), open_input([placed]).read_rows(0, 5))


def test_images_do_not_join(tmp_path: Path) -> None:
    for name in ("a.npy", "b.npy"):
        np.save(tmp_path / name, np.zeros((3, 3)))
    paths = [tmp_path / "a.npy", tmp_path / "b.npy"]
    with pytest.raises(InputError, match="only georeferenced rasters make one terrain together"):
        open_input(paths, ImportOptions(spacing=1.0))
    with pytest.raises(InputError, match="name at least one"):
        open_input([])


@pytest.mark.parametrize(
    ("name", "data", "said"),
    [
        ("missing.tif", None, "no such file"),
        ("empty.tif", b"", "is empty (0 bytes)"),
        ("nul\0.tif", None, "no such file"),
        ("text.tif", b"no raster at all\n" * 9, "no raster"),
        ("noise.hgt", bytes(range(256)) * 9, "no raster"),
        ("short.hgt", b"\0\1" * 1000, "no raster"),
        ("zip.npz", b"PK\x03\x04" + b"\0" * 50, "is an archive"),
        ("vrt.vrt", VRT, "format VRT is not read"),
        ("head.tif", b"II*\0\x08\0\0\0", "no raster"),
        ("short.png", b"\x89PNG\r\n\x1a\n\0\0", "truncated"),
        ("short.exr", b"\x76\x2f\x31\x01\2\0", "is no image"),
        ("short.npy", b"\x93NUMPY\1", "do not make an array"),
        (
            "huge.asc",
            b"ncols 1000000\nnrows 1000000\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3\n",
            "header claims 1000000 x 1000000",
        ),
        (
            "short.asc",
            b"ncols 3\nnrows 3\nxllcorner 0\nyllcorner 0\ncellsize 1\n1 2 3\n4 5 6\n",
            "truncated, damaged or no raster",
        ),
    ],
)
def test_what_is_no_raster_is_refused_in_one_line(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, data: bytes | None, said: str
) -> None:
    path = tmp_path / name
    if data is not None:
        path.write_bytes(data)
    for options in (ImportOptions(spacing=1.0), ImportOptions(crs="EPSG:32611", spacing=1.0)):
        with pytest.raises(InputError) as error:
            open_input([path], options)
        if "CRS" not in str(error.value):
            assert said in str(error.value)
        assert name in str(error.value)
        assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_folders_pipes_and_closed_files_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(InputError, match="is a folder"):
        open_input([tmp_path])
    with pytest.raises(InputError, match="is no regular file"):
        open_input([tmp_path / "pipe"])
    dem = write_dem(tmp_path / "a.tif", rough(4, 4))
    # Tests may run as root, who may read everything.
    monkeypatch.setattr(os, "access", lambda *_: False)
    with pytest.raises(InputError, match="no permission to read it"):
        open_input([dem])


def test_a_sparse_file_claiming_gigabytes_is_refused(tmp_path: Path) -> None:
    """GDAL would make up 149 GiB of zeros."""
    import rasterio

    path = tmp_path / "a.tif"
    with rasterio.open(
        path, "w", "GTiff", 200_000, 200_000, 1, dtype="float32", SPARSE_OK=True, tiled=True,
        blockxsize=4096, blockysize=4096, crs="EPSG:32611",
        transform=rasterio.Affine(2.0, 0.0, 0.0, 0.0, -2.0, 0.0),
    ):  # fmt: skip
        pass
    with pytest.raises(InputError, match=r"header claims 200000 x 200000 .* 149\.0 GiB"):
        describe_input([path])


def test_a_truncated_raster_says_so_and_nothing_else(tmp_path: Path) -> None:
    """In a process of its own, so that all that any library prints is seen."""
    dem = write_dem(tmp_path / "a.tif", rough(600, 600), compress="deflate")
    dem.write_bytes(dem.read_bytes()[: dem.stat().st_size // 2])
    code = (
        "import sys; from terrasim.dem.imports import *\n"
        "try: import_terrain([sys.argv[1]], sys.argv[2])\n"
        "except ValueError as error: print(type(error).__name__, error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, dem, tmp_path / "a.store"],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.startswith(f"InputError {dem}: truncated, damaged or no raster (")
    assert done.stdout.count("\n") == 1
    assert done.stderr == ""
    assert [path.name for path in tmp_path.iterdir()] == ["a.tif"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"spacing": 0.0}, "spacing must be positive and finite [m], got 0.0"),
        ({"spacing": float("nan")}, "got nan"),
        ({"spacing": -3.0}, "got -3.0"),
        ({"z_scale": 0.0}, "z_scale must be finite and not zero, got 0.0"),
        ({"z_scale": float("inf")}, "got inf"),
        ({"z_offset": float("nan")}, "z_offset must be finite [m], got nan"),
        ({"datum": float("inf")}, "datum must be finite"),
        ({"nodata": "ignore"}, "nodata must be hole or fill, got 'ignore'"),
        ({"encoding": "mapbox"}, "encoding must be plain or terrarium"),
        ({"extent": "some"}, "extent must be inside or all"),
        ({"band": 0}, "band counts from 1, got 0"),
        ({"fill_distance": 0}, "fill_distance must be 1 to 1000"),
        ({"z_unit": "cubit"}, "vertical unit 'cubit' is unknown"),
    ],
)
def test_options_out_of_range_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(InputError) as error:
        ImportOptions(**options)
    assert said in str(error.value)


def test_an_unknown_crs_is_refused(tmp_path: Path) -> None:
    dem = write_dem(tmp_path / "a.tif", rough(4, 4), crs=None)
    for crs in ("EPSG:0", "EPSG:123456789", "nonsense", ""):
        with pytest.raises(InputError, match=r"CRS '.*' is unknown: write it as EPSG:n or WKT"):
            open_input([dem], ImportOptions(crs=crs))


def test_describing_loads_neither_images_nor_plots(tmp_path: Path) -> None:
    """Importing the module alone loads no raster library at all."""
    code = (
        "import sys, terrasim.dem.imports\n"
        "print([n for n in ('rasterio', 'OpenImageIO', 'matplotlib') if n in sys.modules])\n"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[]\n"
