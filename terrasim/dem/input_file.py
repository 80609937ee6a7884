"""What must hold of a file before any library opens it."""

from __future__ import annotations

import os
import stat
from pathlib import Path

from terrasim.errors import InputError

MAX_SIDE = 1 << 24
"""Most samples along a side: one row of doubles then takes 128 MiB."""
MAX_SAMPLES = 1 << 36
"""Most samples in all: 262,144 squared."""
_SMALL = 64 << 20
_CHUNK = 1 << 20
_LONGEST_LINE = 4096
_NUMBER_BYTES = b"0123456789+-.,eE \t\r\n" + b"naifNAIF"
_MOST_BYTES_A_BYTE = 4096
"""No lossless image codec shrinks terrain further (Deflate at its very best reaches 1,032)."""


def check_file(path: str | Path) -> Path:
    """The path of a regular file that can be read and is not empty.

    Raises:
        InputError: If there is no such file.
    """
    file = Path(path)
    try:
        info = file.stat()
    except PermissionError:
        raise InputError(f"{path}: no permission to look into its folder") from None
    except (OSError, ValueError):
        raise InputError(f"{path}: no such file; check the name") from None
    if stat.S_ISDIR(info.st_mode):
        raise InputError(f"{path}: is a folder; name the raster files in it") from None
    if not stat.S_ISREG(info.st_mode):
        raise InputError(f"{path}: is no regular file; copy the raster to one")
    if info.st_size == 0:
        raise InputError(f"{path}: is empty (0 bytes)")
    if not os.access(file, os.R_OK):
        raise InputError(f"{path}: no permission to read it")
    return file


def check_claim(path: str | Path, rows: int, cols: int, sample_bytes: int) -> None:
    """Hold the size that a file's header claims against the file, before anything is allocated.

    Args:
        path: The file.
        rows: Rows the header claims.
        cols: Columns the header claims.
        sample_bytes: Bytes of one sample, all channels.

    Raises:
        InputError: If the claim is beyond the limits or cannot be held by such a file.
    """
    claim = f"{path}: header claims {rows} x {cols} samples of {sample_bytes} bytes"
    if rows < 1 or cols < 1:
        raise InputError(f"{claim}: a raster has at least one")
    if max(rows, cols) > MAX_SIDE or rows * cols > MAX_SAMPLES:
        raise InputError(f"{claim}: at most {MAX_SIDE} a side and {MAX_SAMPLES} in all; cut it up")
    size = Path(path).stat().st_size
    total = rows * cols * sample_bytes
    if total > _SMALL and total > _MOST_BYTES_A_BYTE * size:
        raise InputError(
            f"{claim}, {total / 2**30:.1f} GiB, but the file has {size} bytes: more than "
            f"{_MOST_BYTES_A_BYTE} to one is not believed; write it without sparse blocks"
        )


def check_ascii_grid(name: str, file: str | Path) -> None:
    """Hold that an ASCII grid's samples are numbers: the library takes a word for 0.

    Raises:
        InputError: If something else stands among them.
    """
    with Path(file).open("rb") as grid:
        start = 0
        while start < _LONGEST_LINE and grid.readline(_LONGEST_LINE).lstrip()[:1].isalpha():
            start = grid.tell()
        grid.seek(start)
        while part := grid.read(_CHUNK):
            strange = part.translate(None, _NUMBER_BYTES)
            if strange:
                raise InputError(f"{name}: {strange[:1]!r} stands among its samples: write numbers")


def begins_with(path: Path, *magics: bytes) -> bool:
    """Whether the file begins with one of these bytes."""
    with path.open("rb") as file:
        head = file.read(max(len(magic) for magic in magics))
    return head.startswith(magics)
