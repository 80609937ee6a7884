"""Images as heights, read in their own sample type; row 0 is the northern edge."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.counts import Metres
from terrasim.dem.import_options import ImportOptions
from terrasim.dem.input_file import begins_with, check_claim, check_file
from terrasim.errors import InputError

MAX_DECODED = 1 << 30
"""Most bytes of a PNG in memory: its rows can only be decoded from the first on."""
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
EXR_MAGIC = b"\x76\x2f\x31\x01"
TIFF_MAGICS = (b"II*\x00", b"MM\x00*", b"II+\x00", b"MM\x00+")
_CHUNK = 1 << 20
_TYPES = ("uint8", "int8", "uint16", "int16", "uint", "int", "half", "float", "double")

Samples = npt.NDArray[Any]
Rows = Callable[[int, int], Samples]


@dataclass(frozen=True)
class ImageHeights:
    """An open image as a raster of metres."""

    rows: int
    """Number of rows."""
    cols: int
    """Number of columns."""
    driver: str
    """Format and sample type, such as ``png uint16``."""
    samples: Rows
    """Reads rows: first and count to samples, shape ``(count, cols, channels)``."""
    metres: Callable[[Samples], Metres]
    """Turns samples into heights, shape ``(count, cols)``."""

    def read(self, row: int, count: int) -> Metres:
        """Heights [m] of whole rows, shape ``(count, cols)``, float64; NaN: no height."""
        return self.metres(self.samples(row, count))


def read_image(path: str | Path, options: ImportOptions) -> ImageHeights:
    """Open an image: PNG, TIFF or OpenEXR.

    Raises:
        InputError: If it cannot be read, claims more than it can hold, or leaves open which
            channel holds the heights.
    """
    image = open_image(path)
    spec = image.spec()
    begin, end = _channels(path, spec.nchannels, options)
    kind = str(spec.channelformat(begin))
    if options.encoding == "terrarium" and kind != "uint8":
        raise InputError(f"{path}: Terrarium images hold uint8, this one {kind}")
    samples = channel_rows(str(path), image, begin, end)
    if image.format_name() == "png":
        samples = _whole(str(path), samples, spec.height, spec.image_bytes(True))
    return ImageHeights(
        spec.height, spec.width, f"{image.format_name()} {kind}", samples, _decoder(options)
    )


def open_image(path: str | Path) -> Any:
    """Open an image: OpenImageIO's reader, its header held against its file.

    Raises:
        InputError: If it cannot be read, or claims more than the file can hold.
    """
    import OpenImageIO

    file = check_file(path)
    if begins_with(file, PNG_MAGIC):
        # The decoder would print what it finds wrong to the terminal.
        _check_png(path, file)
    config = OpenImageIO.ImageSpec()
    # Or colours, which may be heights, come multiplied by alpha.
    config.attribute("oiio:UnassociatedAlpha", 1)
    image = OpenImageIO.ImageInput.open(str(file), config)
    if image is None:
        raise InputError(
            f"{path}: is no image that can be read ({_one_line(OpenImageIO.geterror())})"
        )
    spec = image.spec()
    if spec.deep or spec.depth > 1:
        raise InputError(f"{path}: is a deep or volume image: heights are one plane")
    sample = max(spec.channelformat(i).size() for i in range(spec.nchannels))
    check_claim(file, spec.height, spec.width, spec.nchannels * sample)
    return image


def _channels(path: str | Path, count: int, options: ImportOptions) -> tuple[int, int]:
    """The half-open range of channels to read."""
    if options.encoding == "terrarium":
        if count not in {3, 4} or options.band is not None:
            raise InputError(
                f"{path}: Terrarium takes red, green and blue together, without --band; this "
                f"image has {count} channels"
            )
        return 0, count
    if options.band is None and count != 1:
        raise InputError(
            f"{path}: has {count} channels and heights are one: choose it with --band, or say "
            "--encoding terrarium"
        )
    band = options.band or 1
    if band > count:
        raise InputError(f"{path}: band {band} does not exist: it has {count}")
    return band - 1, band


def channel_rows(name: str, image: Any, begin: int, end: int) -> Rows:
    """Read rows of some channels in their own type; tiled files by whole rows of tiles."""
    spec = image.spec()
    kind = spec.channelformat(begin)
    if str(kind) not in _TYPES:
        raise InputError(f"{name}: samples of type {kind} are not read; write 16-bit or float")
    if str(kind) == "double" and spec.tile_width:
        # OpenImageIO 3.2 gives noise for them, and no error.
        raise InputError(f"{name}: float64 in tiles is not read; write it in strips or as float32")
    high = spec.tile_height if spec.tile_width else 1

    def read(row: int, count: int) -> Samples:
        first, last = row // high * high, min(-(-(row + count) // high) * high, spec.height)
        y0, y1 = spec.y + first, spec.y + last
        if spec.tile_width:
            x0, x1, z = spec.x, spec.x + spec.width, spec.z
            found = image.read_tiles(x0, x1, y0, y1, z, z + 1, begin, end, kind)
        else:
            found = image.read_scanlines(y0, y1, spec.z, begin, end, kind)
        if found is None:
            raise InputError(f"{name}: truncated or damaged ({_one_line(image.geterror())})")
        whole: Samples = np.asarray(found).reshape(last - first, spec.width, end - begin)
        return whole[row - first : row - first + count]

    return read


def _whole(name: str, samples: Rows, rows: int, size: int) -> Rows:
    """The same from memory, decoded at the first call."""
    if size > MAX_DECODED:
        raise InputError(
            f"{name}: decodes to {size / 2**30:.1f} GiB and a PNG is decoded whole: at most "
            f"{MAX_DECODED >> 30} GiB; convert it to a tiled TIFF"
        )
    decoded: list[Samples] = []

    def read(row: int, count: int) -> Samples:
        if not decoded:
            decoded.append(samples(0, rows))
        return decoded[0][row : row + count]

    return read


def _decoder(options: ImportOptions) -> Callable[[Samples], Metres]:
    """From samples ``(count, cols, channels)`` to metres."""

    def terrarium(samples: Samples) -> Metres:
        red, green, blue = (samples[..., i].astype(np.float64) for i in range(3))
        metres = (red * 256.0 + green + blue / 256.0 - 32768.0) * options.z_scale + options.z_offset
        if samples.shape[2] == 4:
            metres[samples[..., 3] == 0] = np.nan
        return metres

    def plain(samples: Samples) -> Metres:
        return scale_samples(samples[..., 0], options)

    return terrarium if options.encoding == "terrarium" else plain


def scale_samples(samples: Samples, options: ImportOptions) -> Metres:
    """Samples of one channel in metres; those of the nodata value become NaN."""
    metres: Metres = samples.astype(np.float64)
    if options.nodata_value is not None:
        metres[metres == options.nodata_value] = np.nan
    metres *= options.z_scale
    metres += options.z_offset
    return metres


def _check_png(path: str | Path, file: Path) -> None:
    """Walk a PNG's chunks: all there, checksums right, the last one marks the end."""
    with file.open("rb") as png:
        png.seek(len(PNG_MAGIC))
        kind = b""
        while kind != b"IEND":
            head = png.read(8)
            if len(head) < 8:
                raise InputError(f"{path}: truncated: its last chunk is missing")
            left, kind = int.from_bytes(head[:4], "big"), head[4:]
            checksum = zlib.crc32(kind)
            while left:
                part = png.read(min(left, _CHUNK))
                if not part:
                    raise InputError(f"{path}: truncated: chunk {kind!r} lacks {left} bytes")
                checksum = zlib.crc32(part, checksum)
                left -= len(part)
            told = png.read(4)
            if len(told) < 4:
                raise InputError(f"{path}: truncated: chunk {kind!r} lacks its checksum")
            if told != checksum.to_bytes(4, "big"):
                raise InputError(f"{path}: damaged: checksum of chunk {kind!r} is wrong")


def _one_line(text: str) -> str:
    return " ".join(text.split()) or "no reason given"
