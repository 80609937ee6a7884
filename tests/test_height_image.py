"""Image files as stamps: samples exact, scale and weight by rule, bombs and rubbish refused."""

from __future__ import annotations

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from test_image import png, write_image

from terrasim.counts import COUNT_M
from terrasim.deform.apply import apply
from terrasim.deform.shapes.height_image import MAX_SAMPLES
from terrasim.deform.stamps import HeightImage, Texture
from terrasim.deform.window import read_window
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

Samples = npt.NDArray[Any]


def samples(kind: str, channels: int = 1) -> Samples:
    """Numbers that tell every sample from every other, shape ``(5, 4, channels)``."""
    ramp = np.arange(20.0 * channels).reshape(5, 4, channels)
    if kind.startswith("uint"):
        return (ramp * (3 if kind == "uint8" else 800)).astype(kind)
    if kind == "int16":
        return (ramp * 500 - 5000).astype(kind)
    return (ramp / 7.0 - 1.0).astype({"half": "f2", "float": "f4", "double": "f8"}[kind])


UNITS = {"uint8": 255.0, "uint16": 65535.0}


@pytest.mark.parametrize(
    ("name", "kind", "tile"),
    [
        ("a.png", "uint8", 0),
        ("a.png", "uint16", 0),
        ("a.tif", "uint8", 16),
        ("a.tif", "uint16", 0),
        ("a.tif", "int16", 0),
        ("a.tif", "float", 16),
        ("a.tif", "double", 0),
        ("a.exr", "half", 0),
        ("a.exr", "float", 16),
        ("a.npy", "uint8", 0),
        ("a.npy", "uint16", 0),
        ("a.npy", "int16", 0),
        ("a.npy", "float", 0),
    ],
)
def test_every_format_gives_its_samples(tmp_path: Path, name: str, kind: str, tile: int) -> None:
    """8 and 16 bits without a sign run from 0 to 1, all others are as they are."""
    wanted = samples(kind)
    path = tmp_path / name
    if name == "a.npy":
        np.save(path, wanted[..., 0])
    else:
        write_image(path, wanted, kind, tile=tile)
    image = HeightImage.load(path)
    expected = wanted[..., 0].astype(np.float64) / UNITS.get(kind, 1.0)
    np.testing.assert_array_equal(image.samples, expected)
    assert image.weights is None
    assert not image.samples.flags.writeable


def test_alpha_is_the_weight_if_it_is_wanted(tmp_path: Path) -> None:
    """A grey image with alpha needs no channel: its heights are not multiplied by it."""
    two = samples("uint16", 2)
    path = write_image(tmp_path / "a.png", two, "uint16", **{"oiio:UnassociatedAlpha": 1})
    image = HeightImage.load(path)
    np.testing.assert_array_equal(image.samples, two[..., 0] / 65535)
    assert image.weights is not None
    np.testing.assert_array_equal(image.weights, two[..., 1] / 65535)
    assert HeightImage.load(path, alpha=False).weights is None


def test_one_channel_is_chosen(tmp_path: Path) -> None:
    three = write_image(tmp_path / "a.png", samples("uint8", 3), "uint8")
    found = HeightImage.load(three, channel=2).samples
    np.testing.assert_array_equal(found, samples("uint8", 3)[..., 1] / 255)
    with pytest.raises(InputError, match=r"a\.png: has 3 channels beside alpha.* with channel"):
        HeightImage.load(three)
    for bad in (0, 4, -1):
        with pytest.raises(InputError, match=rf"channel must be one of 1, 2, 3, got {bad}"):
            HeightImage.load(three, channel=bad)
    four = write_image(tmp_path / "b.png", samples("uint8", 4), "uint8")
    with pytest.raises(InputError, match="channel must be one of 1, 2, 3, got 4"):
        HeightImage.load(four, channel=4)
    with pytest.raises(InputError, match="channel must be a whole number, got '1'"):
        HeightImage.load(three, channel="1")  # type: ignore[arg-type]
    np.save(tmp_path / "a.npy", np.eye(3))
    with pytest.raises(InputError, match=r"a\.npy: an array has no channels; leave channel out"):
        HeightImage.load(tmp_path / "a.npy", channel=1)


def header_alone(path: Path, shape: tuple[int, ...], kind: str = "<f8") -> Path:
    """An array file that claims a shape and holds a few bytes."""
    with path.open("wb") as file:
        np.lib.format.write_array_header_1_0(
            file, {"descr": kind, "fortran_order": False, "shape": shape}
        )
        file.write(b"\0" * 64)
    return path


def bombs(folder: Path) -> list[tuple[Path, str]]:
    """Files that claim more than they hold, or more than a stamp may, and what is said of them."""
    (folder / "a.png").write_bytes(png(100_000, 100_000, 0))
    (folder / "b.png").write_bytes(png(6000, 6000, 1 << 20))
    large = write_image(
        folder / "c.tif", np.zeros((4097, 4097, 1), np.uint8), "uint8", compression="zip"
    )
    np.save(folder / "d.npy", np.zeros((4097, 4097), np.uint8))
    return [
        (folder / "a.png", r"19073 MB|header claims"),
        (folder / "b.png", rf"has 6000 x 6000 samples, a stamp at most {MAX_SAMPLES}; make it"),
        (large, "has 4097 x 4097 samples, a stamp at most"),
        (folder / "d.npy", "has 4097 x 4097 samples, a stamp at most"),
        (header_alone(folder / "e.npy", (1_000_000, 1_000_000)), "do not make an array|claims"),
        (header_alone(folder / "f.npy", (2, 2, 2)), "heights are 2-D numbers"),
        (header_alone(folder / "g.npy", (2, 4), "|O"), "do not make an array of numbers"),
        (header_alone(folder / "h.npy", (2, 2), "<c16"), "holds complex128"),
    ]


def test_bombs_are_refused_before_anything_is_allocated(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    for path, said in bombs(tmp_path):
        tracemalloc.start()
        with pytest.raises(InputError, match=said) as error:
            HeightImage.load(path)
        _, peak = tracemalloc.get_traced_memory()
        tracemalloc.stop()
        assert str(error.value).startswith(f"{path}: ")
        assert "\n" not in str(error.value)
        assert peak < 16 << 20, path
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(
    ("name", "content", "said"),
    [
        ("a.png", b"", r"a\.png: is empty"),
        ("a.png", b"hello", r"a\.png: is no image that can be read"),
        ("a.png", b"\x89PNG\r\n\x1a\n", r"a\.png: truncated"),
        ("a.tif", b"II*\0\xff\xff\xff\xff", r"a\.tif: is no image that can be read"),
        ("a.exr", b"\x76\x2f\x31\x01rubbish", r"a\.exr: is no image that can be read"),
        ("a.npy", b"\x93NUMPY\1\0\xff\xff{", r"a\.npy: header and file do not make an array"),
    ],
)
def test_what_is_no_image_is_refused_in_silence(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, content: bytes, said: str
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(InputError, match=said) as error:
        Texture.load(tmp_path / name, 0.0, 0.0, 1.0, 1.0)
    assert "\n" not in str(error.value)
    assert capfd.readouterr() == ("", "")


def test_a_missing_file_or_a_folder_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file"):
        HeightImage.load(tmp_path / "none.png")
    with pytest.raises(InputError, match="is a folder"):
        HeightImage.load(tmp_path)


def test_samples_that_are_no_heights_are_refused_with_their_place(tmp_path: Path) -> None:
    floats = samples("float")
    floats[3, 1] = np.nan
    path = write_image(tmp_path / "a.exr", floats, "float")
    told = r"a\.exr: image: samples must be finite, got nan in row 3, column 1; leave places out"
    with pytest.raises(InputError, match=told):
        HeightImage.load(path)
    with pytest.raises(InputError, match="must be numbers of 2 x 2 or more, got float32 of"):
        HeightImage.load(write_image(tmp_path / "b.exr", floats[:1], "float"))


@pytest.mark.parametrize(
    ("heights", "weights", "said"),
    [
        (np.zeros(4), None, r"samples must be numbers of 2 x 2 or more, got float64 of \(4,\)"),
        (np.zeros((1, 4)), None, r"samples must be .* \(1, 4\)"),
        (np.zeros((2, 2), bool), None, "samples must be numbers .* got bool"),
        (np.array([["a", "b"]] * 2), None, "samples must be numbers"),
        (np.zeros((2, 2)), np.zeros((2, 3)), r"weights must have the shape of the samples \(2, 2"),
        (np.zeros((2, 2)), np.full((2, 2), 1.5), "weights must lie between 0 and 1, got 1.5"),
        (np.zeros((2, 2)), np.full((2, 2), -0.5), "weights must lie between 0 and 1, got -0.5"),
        (np.zeros((2, 2)), np.full((2, 2), np.inf), "weights must be finite, got inf"),
        (np.broadcast_to(0.0, (5000, 5000)), None, "image: has 5000 x 5000 samples"),
    ],
)
def test_arrays_that_are_no_image_are_refused(
    heights: Samples, weights: Samples | None, said: str
) -> None:
    with pytest.raises(InputError, match=said):
        HeightImage(heights, weights)


def test_an_image_is_a_copy_that_nobody_changes() -> None:
    array = np.eye(3)
    stamp = Texture(0.0, 0.0, array, 1.0, 1.0)  # type: ignore[arg-type]
    array[0, 0] = 9.0
    assert stamp.image.samples[0, 0] == 1.0
    with pytest.raises(ValueError, match="read-only"):
        stamp.image.samples[0, 0] = 2.0


def test_a_loaded_image_lies_on_the_ground_with_its_first_row_in_the_north(tmp_path: Path) -> None:
    """A sample a post: the posts are the samples, in metres, from the north down."""
    wanted = samples("uint16")
    path = write_image(tmp_path / "a.png", wanted, "uint16")
    stamp = Texture.load(path, 4.5, 6.0, size_x=3.0, size_y=4.0, scale=2.0, offset=-0.25)
    grid = Grid(12, 12, 1.0)
    with Terrain(ArraySource(np.zeros((12, 12), np.int32), grid)) as terrain:
        ledger = apply(terrain, [stamp])
        found = read_window(terrain, 0, 0, 12, 12)
    expected = np.zeros((12, 12))
    expected[4:9, 3:7] = (wanted[::-1, :, 0] / 65535 * 2.0 - 0.25) / COUNT_M
    assert np.abs(found - expected).max() <= 0.5 + 1e-6
    assert ledger.posts == 20


def test_float64_in_tiles_is_refused(tmp_path: Path) -> None:
    """The library that reads images gives noise there and says nothing."""
    path = write_image(tmp_path / "a.tif", samples("double"), "double", tile=16)
    with pytest.raises(InputError, match="float64 in tiles is not read; write it in strips"):
        HeightImage.load(path)
