"""Who writes a store, and how far it was acknowledged: a small file beside it, ``NAME-writer``.

The writer holds a lock on the file as long as it lives. After each commit it notes there how many
frames of the write-ahead log are on the disk and which journal row is the newest. The note is not
flushed: it can only fall behind, and then says less. It shows what SQLite cannot know, that the end
of the log is missing. A store that was closed well needs no note and the file is removed.
"""

from __future__ import annotations

import fcntl
import os
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from hashlib import blake2b
from pathlib import Path

from terrasim.errors import InputError, RunError
from terrasim.store.codec import StoreCorrupt
from terrasim.store.journal import Tail
from terrasim.store.store_file import REMEDY
from terrasim.store.unfinished import beside
from terrasim.store.write_ahead_log import Log, read_log

ENDING = "-writer"
"""Ends the name of the file beside a store that is being written."""
_NOTE = struct.Struct("<16s8sIQQ16s")
_SEAL = 8
_TRIES = 20
_PATIENCE_S = 0.3


@dataclass(frozen=True)
class Note:
    """How far a store was acknowledged."""

    store: bytes
    """Which store, 16 bytes."""
    salts: bytes
    """Which write-ahead log; zeros if there was none."""
    frames: int
    """How many of its frames are on the disk."""
    tail: Tail
    """The newest journal row of the epoch that was written."""


class Claim:
    """The one writer's lock on a store."""

    def __init__(self, path: Path) -> None:
        """Take the lock.

        Raises:
            RunError: If another has it.
            InputError: If nothing may be written beside the store.
        """
        self._path = path
        self._file = _claim(path)
        self.note = _read(self._file)
        """What the last writer noted, if it was not closed well."""

    def write(self, note: Note) -> None:
        """Note how far the store is acknowledged."""
        self.note = note
        # What is acknowledged is in the store; without the note less damage can be seen.
        with suppress(OSError):
            os.pwrite(self._file, _packed(note), 0)

    def release(self, *, well: bool) -> None:
        """Give the lock back; without a note if all is in the store."""
        if well or self.note is None:
            with suppress(OSError):
                beside(self._path, ENDING).unlink()
        # A forked child may have the file open still.
        fcntl.flock(self._file, fcntl.LOCK_UN)
        os.close(self._file)


@contextmanager
def sound_log(path: Path) -> Iterator[Note | None]:
    """Keep writers out while a store is opened for reading, if none is at work on it.

    Yields:
        What a writer noted that is gone and was not closed well.

    Raises:
        StoreCorrupt: If the write-ahead log lost something.
        RunError: If it cannot be read.
    """
    for _ in range(_TRIES):
        with _shared(path) as (file, locked):
            if file is not None and not locked:
                # The writer looked when it opened the store.
                yield None
                return
            note = None if file is None else _read(file)
            try:
                check_log(path, note)
            except StoreCorrupt:
                # Unless a writer has begun meanwhile: what was read may have been half-written.
                if file is not None or not beside(path, ENDING).exists():
                    raise
                continue
            yield note
            return
    raise RunError(f"{path} is opened and closed for writing too often; try again later")


def check_log(path: Path, note: Note | None) -> Log | None:
    """What the write-ahead log holds.

    Raises:
        StoreCorrupt: If something is missing from it.
        RunError: If it cannot be read.
    """
    try:
        log = read_log(path)
    except OSError as error:
        raise RunError(f"{path}-wal cannot be read: {error.strerror}") from None
    if note and log and note.salts == log.salts and log.frames < note.frames:
        raise StoreCorrupt(
            f"{path}: {note.frames} frames of the write-ahead log were acknowledged and only "
            f"{log.frames} are there; {_accept(path)}"
        )
    return log


def check_tail(path: Path, note: Note, store: bytes, tail: Tail) -> None:
    """Refuse a store that lacks the journal row that was acknowledged last.

    Args:
        path: The store.
        note: What was noted.
        store: Random bytes that tell the store from any other.
        tail: The newest row up to that number, as it is in the store.

    Raises:
        StoreCorrupt: If it is not that row.
    """
    if note.store == store and tail.chain != note.tail.chain:
        raise StoreCorrupt(
            f"{path}: operation {note.tail.seq} was acknowledged and is not there; {_accept(path)}"
        )


def _accept(path: Path) -> str:
    return f"{REMEDY}, or remove {beside(path, ENDING)} to go on from the earlier state"


def _claim(path: Path) -> int:
    name, until = beside(path, ENDING), time.monotonic() + _PATIENCE_S
    while True:
        try:
            file = os.open(name, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        except OSError as error:
            raise InputError(
                f"{name} cannot be written: {error.strerror}; a store is opened for writing where "
                "its folder can be written"
            ) from None
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Between the two calls the last writer may have removed it: then it is not the lock.
            if name.exists() and os.path.samestat(os.fstat(file), name.stat()):
                return file
        except BlockingIOError:
            # A reader holds the file for a moment while it opens the store.
            if time.monotonic() > until:
                os.close(file)
                raise RunError(
                    f"{path} is open for writing already; a store has one writer: close it first"
                ) from None
            time.sleep(0.01)
        except BaseException:
            os.close(file)
            raise
        os.close(file)


@contextmanager
def _shared(path: Path) -> Iterator[tuple[int | None, bool]]:
    """Keep writers out, if there is a file to do so: the file, and whether none is at work."""
    try:
        file = os.open(beside(path, ENDING), os.O_RDONLY | os.O_CLOEXEC)
    except OSError:
        yield None, False
        return
    try:
        locked = True
        try:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
        except BlockingIOError:
            locked = False
        yield file, locked
    finally:
        os.close(file)


def _packed(note: Note) -> bytes:
    said = _NOTE.pack(note.store, note.salts, note.frames, *note.tail[:2], note.tail.chain)
    return said + blake2b(said, digest_size=_SEAL).digest()


def _read(file: int) -> Note | None:
    """The note in a file; None if it is empty or damaged: then it says nothing."""
    data = os.pread(file, _NOTE.size + _SEAL, 0)
    said, sealed = data[: _NOTE.size], data[_NOTE.size :]
    if len(data) < _NOTE.size + _SEAL or blake2b(said, digest_size=_SEAL).digest() != sealed:
        return None
    store, salts, frames, epoch, seq, chain = _NOTE.unpack(said)
    return Note(store, salts, frames, Tail(epoch, seq, chain))
