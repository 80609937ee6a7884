"""Images as heights: own sample type, one channel, row 0 in the north, no trust in headers."""

from __future__ import annotations

import struct
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.counts import HOLE
from terrasim.dem.height_rows import SouthUpRows
from terrasim.dem.import_options import ImportOptions
from terrasim.dem.imports import open_input
from terrasim.errors import InputError


def write_image(
    path: Path, samples: npt.NDArray[Any], kind: str, *, tile: int = 0, **attributes: Any
) -> Path:
    """An image of samples ``(rows, cols, channels)`` in one of OpenImageIO's types."""
    import OpenImageIO

    spec = OpenImageIO.ImageSpec(samples.shape[1], samples.shape[0], samples.shape[2], kind)
    spec.tile_width = spec.tile_height = tile
    for name, value in attributes.items():
        spec.attribute(name, value)
    out: Any = OpenImageIO.ImageOutput.create(str(path))
    assert out.open(str(path), spec), out.geterror()
    assert out.write_image(samples), out.geterror()
    out.close()
    return path


def heights(rows: int = 40, cols: int = 30) -> npt.NDArray[np.uint16]:
    """Samples that tell every one from every other, one channel."""
    return (np.arange(rows * cols, dtype=np.uint16) * 50).reshape(rows, cols, 1)


def read(path: Path, **options: Any) -> SouthUpRows:
    """Rows of one file."""
    return open_input([path], ImportOptions(**{"spacing": 10.0, **options}))


def test_puget_sounds_highest_post_is_where_it_belongs(shared_terrain: Path) -> None:
    """Mt Rainier, 4379.8 m, at row 529 from the north, column 803."""
    rows = read(shared_terrain / "ps_height_1k.png", spacing=160.0, z_scale=0.1)
    found = rows.read_rows(0, 1025)
    assert divmod(int(found.argmax()), 1025) == (1024 - 529, 803)
    assert found.max() == 437_980_000
    assert found.min() == 0
    assert (rows.grid.rows, rows.grid.cols, rows.grid.spacing) == (1025, 1025, 160.0)


def test_terrarium_colours_are_metres(shared_terrain: Path) -> None:
    """Its first pixel is (135, 4, 32): 135 * 256 + 4 + 32 / 256 - 32768 = 1796.125 m."""
    rows = read(shared_terrain / "terrarium.png", spacing=62.0, encoding="terrarium")
    assert rows.read_rows(255, 1)[0, 0] == 179_612_500
    low, high = rows.provenance["range_m"]
    assert (int(low), int(high)) == (715, 2488)


@pytest.mark.parametrize(
    ("name", "kind", "tile", "compression"),
    [
        ("a.png", "uint16", 0, "none"),
        ("a.tif", "uint16", 0, "zip"),
        ("a.tif", "uint16", 16, "none"),
        ("a.tif", "float", 16, "lzw"),
        ("a.tif", "double", 0, "zip"),
        ("a.exr", "float", 0, "zip"),
        ("a.exr", "float", 16, "piz"),
        ("a.tif", "uint", 0, "zip"),
        ("a.tif", "int", 16, "zip"),
        ("a.exr", "uint", 0, "zip"),
    ],
)
def test_every_format_gives_its_samples_in_any_window(
    tmp_path: Path, name: str, kind: str, tile: int, compression: str
) -> None:
    """In metres from the southern edge: a count of 0.1 m, from -5 m up."""
    path = write_image(
        tmp_path / name,
        heights().astype(
            {"float": "f4", "double": "f8", "uint": "u4", "int": "i4"}.get(kind, kind)
        ),
        kind,
        tile=tile,
        compression=compression,
    )
    expected = np.rint((heights()[::-1, :, 0] * 0.1 - 5.0) * 1e5).astype(np.int32)
    rows = read(path, z_scale=0.1, z_offset=-5.0)
    np.testing.assert_array_equal(rows.read_rows(0, 40), expected)
    np.testing.assert_array_equal(rows.read_rows(17, 9), expected[17:26])


def test_sixteen_bits_are_not_squeezed_through_floats_of_one(tmp_path: Path) -> None:
    """Read without naming a type, 65,535 would come back as 1.0."""
    samples = np.full((2, 2, 1), 65_535, np.uint16)
    rows = read(write_image(tmp_path / "a.png", samples, "uint16"), z_scale=0.1)
    assert (rows.read_rows(0, 2) == 655_350_000).all()


def test_a_moved_data_window_is_the_image(tmp_path: Path) -> None:
    """OpenEXR images may begin anywhere."""
    import OpenImageIO

    spec = OpenImageIO.ImageSpec(30, 40, 1, "float")
    spec.x, spec.y = -7, 11
    out: Any = OpenImageIO.ImageOutput.create("a.exr")
    assert out.open(str(tmp_path / "a.exr"), spec)
    out.write_image(heights().astype(np.float32))
    out.close()
    found = read(tmp_path / "a.exr", z_scale=0.1).read_rows(3, 2)
    np.testing.assert_array_equal(found, heights()[35:37, :, 0][::-1].astype(np.int32) * 10_000)


def test_colours_are_not_multiplied_by_alpha(tmp_path: Path) -> None:
    """Half-transparent Terrarium pixels keep their colours; wholly transparent ones are holes."""
    samples = np.full((2, 2, 4), (135, 4, 32, 128), np.uint8)
    samples[0, 0, 3] = 0
    path = write_image(tmp_path / "a.png", samples, "uint8", **{"oiio:UnassociatedAlpha": 1})
    found = read(path, encoding="terrarium").read_rows(0, 2)
    assert found.tolist() == [[179_612_500, 179_612_500], [HOLE, 179_612_500]]


def test_one_channel_is_chosen(tmp_path: Path) -> None:
    samples = np.concatenate([heights(), heights() + 1, heights() + 2], axis=2)
    path = write_image(tmp_path / "a.png", samples, "uint16")
    assert read(path, band=2, z_scale=0.1).read_rows(39, 1)[0, 0] == 10_000
    with pytest.raises(InputError, match=r"has 3 channels and heights are one.*--band"):
        read(path)
    with pytest.raises(InputError, match="band 4 does not exist: it has 3"):
        read(path, band=4)


def test_missing_heights_are_holes(tmp_path: Path) -> None:
    """NaN, and the value the user or the TIFF itself names."""
    floats = heights().astype(np.float32)
    floats[0, 0] = np.nan
    assert (
        read(write_image(tmp_path / "a.exr", floats, "float"), z_scale=0.1).read_rows(39, 1)[0, 0]
        == HOLE
    )
    path = write_image(tmp_path / "a.png", heights(), "uint16")
    rows = read(path, nodata_value=50, z_scale=0.1)
    assert rows.provenance["nodata_samples"] == 1
    assert rows.read_rows(39, 1)[0, 1] == HOLE
    tiff = write_bare_tiff(tmp_path / "a.tif", heights()[:, :, 0], nodata=100)
    assert read(tiff, z_scale=0.1).read_rows(39, 1)[0, 2] == HOLE


def write_bare_tiff(path: Path, samples: npt.NDArray[Any], **profile: Any) -> Path:
    """A TIFF without any georeference."""
    import warnings

    import rasterio

    rows, cols = samples.shape
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with rasterio.open(
            path, "w", "GTiff", cols, rows, 1, dtype=samples.dtype, **profile
        ) as dataset:
            dataset.write(samples, 1)
    return path


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"spacing": None}, "has no scale: give --spacing"),
        ({"crs": "EPSG:32611"}, "has no place in a CRS"),
        ({"z_unit": "ft"}, "use --z-scale"),
        ({"encoding": "terrarium"}, "takes red, green and blue"),
        ({"z_scale": 10.0}, "is out of range"),
    ],
)
def test_what_an_image_cannot_satisfy_is_refused(
    tmp_path: Path, options: dict[str, Any], said: str
) -> None:
    path = write_image(tmp_path / "a.png", heights(), "uint16")
    with pytest.raises(InputError) as error:
        read(path, **options)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_terrarium_needs_eight_bits(tmp_path: Path) -> None:
    samples = np.zeros((4, 4, 3), np.uint16)
    with pytest.raises(InputError, match="Terrarium images hold uint8, this one uint16"):
        read(write_image(tmp_path / "a.png", samples, "uint16"), encoding="terrarium")


def test_an_infinite_sample_is_refused(tmp_path: Path) -> None:
    samples = heights().astype(np.float32)
    samples[3, 4] = np.inf
    with pytest.raises(InputError, match="height inf m at row 3, column 4"):
        read(write_image(tmp_path / "a.exr", samples, "float"), z_scale=0.1)


def png(width: int, height: int, padding: int) -> bytes:
    """A grey 16-bit PNG with right checksums, hardly any pixels, and a long private chunk."""

    def chunk(kind: bytes, body: bytes) -> bytes:
        checksum = struct.pack(">I", zlib.crc32(kind + body))
        return struct.pack(">I", len(body)) + kind + body + checksum

    header = struct.pack(">IIBBBBB", width, height, 16, 0, 0, 0, 0)
    body = chunk(b"prVt", b"\0" * padding) + chunk(b"IDAT", zlib.compress(b"\0" * 100))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + body + chunk(b"IEND", b"")


def test_a_png_claiming_gigabytes_is_refused(tmp_path: Path) -> None:
    """Without any image of that size being made."""
    path = tmp_path / "a.png"
    path.write_bytes(png(100_000, 100_000, 0))
    with pytest.raises(InputError, match=r"19073 MB|header claims 100000 x 100000"):
        read(path)
    path.write_bytes(png(30_000, 30_000, 1 << 22))
    with pytest.raises(InputError, match=r"decodes to 1\.7 GiB .* at most 1 GiB"):
        read(path)


@pytest.mark.parametrize("cut", [20, 60, 4000, -1, -12])
def test_a_truncated_png_is_refused_in_silence(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], cut: int
) -> None:
    """The decoder beneath would write to the terminal."""
    noise = np.random.default_rng(0).integers(0, 65_535, (64, 64, 1), dtype=np.uint16)
    path = write_image(tmp_path / "a.png", noise, "uint16")
    path.write_bytes(path.read_bytes()[:cut])
    with pytest.raises(InputError, match=r"a\.png: truncated"):
        read(path)
    assert capfd.readouterr() == ("", "")


def test_a_damaged_png_is_refused_in_silence(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = write_image(tmp_path / "a.png", heights(), "uint16")
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    with pytest.raises(InputError, match=r"a\.png: (damaged|truncated)"):
        read(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("name", "tile"), [("a.exr", 0), ("a.exr", 16), ("b.tif", 16)])
def test_other_truncated_images_are_refused_in_silence(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, tile: int
) -> None:
    noise = np.random.default_rng(0).uniform(0, 1000, (128, 128, 1)).astype(np.float32)
    path = write_image(tmp_path / name, noise, "float", tile=tile, compression="zip")
    for part in (2, 3):
        path.write_bytes(path.read_bytes()[: -path.stat().st_size // part])
        with pytest.raises(InputError, match=rf"{name}: ") as error:
            read(path)
        assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")
