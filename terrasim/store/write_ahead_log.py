"""The write-ahead log before SQLite recovers it: is something missing from its middle?

SQLite takes a log up to the first frame that is not right and silently drops the rest: one flipped
bit can drop hundreds of transactions that were on the disk. A torn end is different: the last
transaction may be there in part when the power fails, because its sync had not returned. So the log
is damaged if a frame is not right and a *later* transaction than that frame's has left a trace, or
if fewer frames are right than were acknowledged (``acknowledged.py``). A log that is cut off
cleanly is an earlier acknowledged state.

Format and checksum: https://www.sqlite.org/fileformat2.html#the_write_ahead_log
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import numpy.typing as npt

from terrasim.store.codec import StoreCorrupt
from terrasim.store.store_file import REMEDY
from terrasim.store.unfinished import beside

Words = npt.NDArray[np.uint32]

HEADER = 32
"""Bytes before the first frame."""
FRAME_HEADER = 24
"""Bytes of a frame before its page."""
_MAGIC = 0x377F0682
_AT_ONCE = 1024
_PAGE_SIZES = frozenset(1 << bits for bits in range(9, 17))


@dataclass(frozen=True)
class Log:
    """What a write-ahead log holds."""

    salts: bytes
    """Eight random bytes that change when the log begins anew."""
    page_size: int
    """Bytes of a page."""
    frames: int
    """Frames up to the end of the last transaction that SQLite will take."""


@dataclass(frozen=True)
class _Frames:
    """What the frames say, and what is right about it; one element a frame."""

    commits: npt.NDArray[np.bool_]
    """Whether it says that it ends a transaction."""
    salted: npt.NDArray[np.bool_]
    """Whether its salts are the log's."""
    summed: npt.NDArray[np.bool_]
    """Whether its checksum goes on from the one that the frame before it says."""


def read_log(path: Path) -> Log | None:
    """What the write-ahead log beside a store holds; None if there is nothing in it.

    Raises:
        StoreCorrupt: If something is missing from its middle.
        OSError: If it cannot be read.
    """
    try:
        data = beside(path, "-wal").read_bytes()
    except FileNotFoundError:
        return None
    if len(data) < HEADER or not any(data):
        return None
    log = _header(data)
    if log is None:
        raise StoreCorrupt(f"{path}: the head of the write-ahead log is damaged; {REMEDY}")
    frames = _frames(data, log)
    right = frames.salted & frames.summed
    bad = int(np.argmin(right)) if not right.all() else right.size
    if bad < right.size and _later_transaction(frames, bad):
        raise StoreCorrupt(
            f"{path}: frame {bad + 1} of {right.size} in the write-ahead log is damaged, and what "
            f"was written after it was acknowledged; {REMEDY}"
        )
    ends = np.flatnonzero(frames.commits[:bad])
    return Log(log.salts, log.page_size, int(ends[-1]) + 1 if ends.size else 0)


def _later_transaction(frames: _Frames, bad: int) -> bool:
    """Whether a transaction after that of the first bad frame was written."""
    if frames.summed[bad]:
        # Its content fits what is before it, so only its salts were changed.
        return True
    after = slice(bad + 1, None)
    ends = np.count_nonzero((frames.commits & frames.salted & frames.summed)[after])
    # One end may be that of the bad frame's own transaction, whose sync had not returned; unless
    # the bad frame ended it.
    return bool(ends + (frames.salted[bad] and frames.commits[bad]) > 1)


def _header(data: bytes) -> Log | None:
    magic, version, page_size, _, salts, *said = struct.unpack(">IIII8sII", data[:HEADER])
    if magic & ~1 != _MAGIC or version != 3007000:
        return None
    words = np.frombuffer(data, _order(data), 6).astype(np.uint32).reshape(1, 6)
    total = _sums(words)[0]
    if total.tolist() != said or page_size not in _PAGE_SIZES:
        return None
    return Log(salts, page_size, 0)


def _order(data: bytes) -> str:
    """How the checksum reads its words."""
    return ">u4" if data[3] & 1 else "<u4"


def _frames(data: bytes, log: Log) -> _Frames:
    size = FRAME_HEADER + log.page_size
    count = (len(data) - HEADER) // size
    raw = np.frombuffer(data, np.uint8, count * size, HEADER).reshape(count, size)
    said = raw[:, 16:24].copy().view(">u4").astype(np.uint32)
    before = np.concatenate([np.frombuffer(data, ">u4", 2, 24).astype(np.uint32)[None], said[:-1]])
    totals = np.empty_like(said)
    for first in range(0, count, _AT_ONCE):
        part = raw[first : first + _AT_ONCE]
        summed = np.concatenate([part[:, :8], part[:, FRAME_HEADER:]], axis=1)
        words = summed.view(_order(data)).astype(np.uint32)
        totals[first : first + _AT_ONCE] = _sums(words)
    _, carry = _weights((8 + log.page_size) // 4)
    totals += (before[:, None, :] * carry[None]).sum(axis=2, dtype=np.uint32)
    return _Frames(
        commits=(raw[:, 4:8] != 0).any(axis=1),
        salted=(raw[:, 8:16] == np.frombuffer(log.salts, np.uint8)).all(axis=1),
        summed=(totals == said).all(axis=1),
    )


def _sums(words: Words) -> Words:
    """The checksums of rows of words, begun at zero; shape ``(rows, 2)``."""
    weights, _ = _weights(words.shape[1])
    return words @ weights


@lru_cache(8)
def _weights(count: int) -> tuple[Words, Words]:
    """The checksum as a sum: what each word adds to both halves, and what becomes of the start.

    SQLite adds words in pairs, ``s0 += x + s1; s1 += y + s0``: a linear step modulo 2^32, so that
    many frames can be summed at once.
    """
    step = np.array([[1, 1], [1, 2]], dtype=np.uint32)
    pair = np.array([[1, 0], [1, 1]], dtype=np.uint32)
    weights = np.empty((count, 2), dtype=np.uint32)
    carry = np.eye(2, dtype=np.uint32)
    for k in range(count - 2, -1, -2):
        weights[k : k + 2] = (carry @ pair).T
        carry = carry @ step
    return weights, carry
