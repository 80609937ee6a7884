"""A block's posts as bytes: lossless, small, and quick to read back.

A blob is a header of 20 bytes and, unless all its posts are equal, one zstd frame::

    u8 codec, u8 width, u8 holes, u8 zero, u32 rows, u32 cols, i32 first, u32 step
    frame: [one bit a post, set where it is a hole] byte planes of the residual, lowest plane first

Holes are filled by the ground before them. ``(posts - first) / step`` is then whole: ``step`` is
the greatest common divisor, so a terrain in 0.1 m steps costs what it costs in units of 0.1 m. The
residual is what is left of a post when the three posts to its west and south predict it by their
plane; two cumulative sums undo that. All is arithmetic modulo 2^32, so no height is too large.
"""

from __future__ import annotations

import struct
import threading

import numpy as np
import numpy.typing as npt
import zstandard

from terrasim.counts import HOLE, Counts
from terrasim.errors import InputError, RunError

CODEC = 1
"""Id of the format written here; the first byte of every blob."""
MAX_POSTS = 1 << 22
"""Posts a blob may claim: nothing larger is allocated on a file's word."""
_HEADER = struct.Struct("<BBBBIIiI")
_LEVEL = 3
_WIDTHS = (1, 2, 4)
# Added to the residual, so that small ones of either sign share the same upper bytes.
_BIAS = {1: 0, 2: 0x80, 4: 0x808080}

_per_thread = threading.local()


class StoreCorrupt(RunError):  # noqa: N818 the name that the service promises
    """What was read is not what was written; its heights are not to be had."""


def pack(posts: Counts) -> bytes:
    """Compress posts without loss; equal posts give equal bytes.

    Args:
        posts: Counts, shape ``(rows, cols)``, int32, at most ``MAX_POSTS`` of them.

    Raises:
        InputError: If the posts are not a 2-D int32 array of 1 to ``MAX_POSTS`` posts.
    """
    if posts.ndim != 2 or posts.dtype != np.int32 or not 0 < posts.size <= MAX_POSTS:
        raise InputError(
            f"a block is a 2-D int32 array of 1 to {MAX_POSTS} posts, "
            f"got {posts.dtype} of shape {posts.shape}"
        )
    holes = posts == HOLE
    some = bool(holes.any())
    filled = _fill(posts, holes) if some else posts
    first = int(filled[0, 0])
    offset = filled.astype(np.int64) - first
    step = common_factor(offset)
    rows, cols = posts.shape
    if step == 0 and (not some or first == HOLE):
        return _HEADER.pack(CODEC, 0, 0, 0, rows, cols, first, 1)
    step = max(step, 1)
    residual = _difference((offset // step if step > 1 else offset).astype(np.uint32))
    planes, width = _planes(residual.view(np.int32))
    mask = np.packbits(holes).tobytes() if some else b""
    head = _HEADER.pack(CODEC, width, some, 0, rows, cols, first, step)
    return head + _compressor().compress(mask + planes)


def unpack(blob: bytes) -> Counts:
    """Posts of a blob.

    Returns:
        Counts, shape ``(rows, cols)``, int32, a new array.

    Raises:
        StoreCorrupt: If the blob is not one that ``pack`` wrote. Damage that keeps the form is not
            seen here: the store compares a hash.
    """
    if len(blob) < _HEADER.size or blob[0] != CODEC:
        raise StoreCorrupt(f"a block of {len(blob)} bytes has no header of codec {CODEC}")
    _, width, some, _, rows, cols, first, step = _HEADER.unpack_from(blob)
    size = rows * cols
    if not 0 < size <= MAX_POSTS or some > 1 or step == 0 or (width and width not in _WIDTHS):
        raise StoreCorrupt(f"a block claims {rows} x {cols} posts of {width} bytes, step {step}")
    if width == 0:
        return np.full((rows, cols), first, dtype=np.int32)
    masked = (size + 7) // 8 if some else 0
    raw = _decompress(memoryview(blob)[_HEADER.size :], masked + size * width)
    posts = _sum(_residual(raw[masked:], width).reshape(rows, cols), first, step)
    if some:
        mask = np.unpackbits(raw[:masked], count=size).view(np.bool_).reshape(rows, cols)
        posts[mask] = HOLE
    return posts


def common_factor(values: npt.NDArray[np.int64]) -> int:
    """Greatest common divisor of all values; 0 if all are zero."""
    flat = values.reshape(-1)
    # A few values nearly always say it; the rest only have to agree.
    factor = int(np.gcd.reduce(flat[:: max(1, flat.size // 256)]))
    if factor == 1 or (factor and not (flat % factor).any()):
        return factor
    return int(np.gcd.reduce(flat))


def _fill(posts: Counts, holes: npt.NDArray[np.bool_]) -> Counts:
    """Holes take the last ground before them in reading order, those at the start the first."""
    flat = posts.reshape(-1)
    here = np.where(holes.reshape(-1), -1, np.arange(flat.size))
    before = np.maximum.accumulate(here)
    first = int(np.argmax(before >= 0))
    before[before < 0] = first
    filled: Counts = flat[before].reshape(posts.shape)
    return filled


def _difference(values: npt.NDArray[np.uint32]) -> npt.NDArray[np.uint32]:
    along = values.copy()
    along[:, 1:] -= values[:, :-1]
    across = along.copy()
    across[1:] -= along[:-1]
    return across


def _planes(residual: Counts) -> tuple[bytes, int]:
    low, high = int(residual.min()), int(residual.max())
    width = next(w for w in _WIDTHS if -(1 << 8 * w - 1) <= low <= high < 1 << 8 * w - 1)
    biased = (residual.astype(np.int64) + _BIAS[width]).astype(f"<u{width}")
    return biased.reshape(-1, 1).view(np.uint8).T.tobytes(), width


def _residual(raw: npt.NDArray[np.uint8], width: int) -> Counts:
    if width == 1:
        return raw.view(np.int8).astype(np.int32)
    planes = raw.reshape(width, -1)
    words = np.empty((planes.shape[1], width), dtype=np.uint8)
    for k in range(width):
        words[:, k] = planes[k]
    biased = words.view(f"<u{width}").reshape(-1)
    biased -= biased.dtype.type(_BIAS[width])
    return biased.view(f"<i{width}").astype(np.int32, copy=False)


def _sum(residual: Counts, first: int, step: int) -> Counts:
    if step > 1:
        unsigned = residual.view(np.uint32)
        unsigned *= np.uint32(step)
    residual[0, 0] = first
    # A prefix sum by doubling: numpy's cumsum down the columns takes twice as long.
    reach = 1
    while reach < residual.shape[0]:
        residual[reach:] += residual[:-reach]
        reach *= 2
    return np.cumsum(residual, axis=1, out=residual)


def _decompress(frame: memoryview, size: int) -> npt.NDArray[np.uint8]:
    try:
        # The frame's own word is what zstd would allocate by.
        claimed = zstandard.frame_content_size(frame)
        if claimed != size:
            raise StoreCorrupt(f"a block's frame claims {claimed} bytes, its header {size}")
        raw = _decompressor().decompress(frame, max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise StoreCorrupt(f"a block does not decompress: {error}") from None
    return np.frombuffer(raw, dtype=np.uint8)


def _compressor() -> zstandard.ZstdCompressor:
    # One a thread: sharing one between threads is undefined.
    if not hasattr(_per_thread, "compressor"):
        _per_thread.compressor = zstandard.ZstdCompressor(level=_LEVEL)
    found: zstandard.ZstdCompressor = _per_thread.compressor
    return found


def _decompressor() -> zstandard.ZstdDecompressor:
    if not hasattr(_per_thread, "decompressor"):
        _per_thread.decompressor = zstandard.ZstdDecompressor()
    found: zstandard.ZstdDecompressor = _per_thread.decompressor
    return found
