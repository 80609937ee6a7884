"""The one connection that writes a store: transactions that are on the disk when they end.

It is also the only one that moves the write-ahead log into the file. Any thread may use it, one at
a time. After the disk failed nobody knows what is on it: nothing is written until ``reopen`` has
dropped what was not acknowledged and looked at the rest. A full disk is no such failure.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

import apsw

from terrasim.errors import RunError
from terrasim.store.acknowledged import Claim, Note, check_log
from terrasim.store.file_system import require_local
from terrasim.store.journal import Tail
from terrasim.store.migrate import migrate
from terrasim.store.opening import require_file, require_length, require_store
from terrasim.store.records import State, required
from terrasim.store.store_file import require_sqlite, writing
from terrasim.store.unfinished import beside
from terrasim.store.write_ahead_log import FRAME_HEADER, HEADER

LOG_FRAMES = 2000
"""Frames of the write-ahead log at which it is moved into the file: 8 MiB."""
_LOG_KEPT = 64 << 20


@dataclass
class Work:
    """A transaction under way."""

    db: apsw.Connection
    """The connection to do it with."""
    tail: Tail | None = None
    """The journal row that will be the newest, if it is another than before."""
    done: Callable[[], None] = lambda: None
    """Called when it is on the disk, before anybody else writes."""


class Writer:
    """The one connection that writes a store, and the lock that keeps others out."""

    def __init__(self, path: Path, vfs: str = "") -> None:
        """Take the lock and open the file; an older store is brought up to this version.

        Args:
            path: The store.
            vfs: Name of the SQLite VFS to go through; empty for the system's own.

        Raises:
            InputError: If there is no store, a newer one, or it cannot be written.
            RunError: If another writes it, it lies on another machine, or the disk fails.
            StoreCorrupt: If acknowledged frames of the write-ahead log are lost.
        """
        require_sqlite()
        require_file(path)
        require_local(path)
        self.path = path
        """The file."""
        self.lock = threading.RLock()
        """Held during a transaction."""
        self._vfs = vfs
        self._process = os.getpid()
        self._claim = Claim(path)
        self.last_note = self._claim.note
        """What the last writer noted, if it was not closed well."""
        self._failure = ""
        self._frames = 0
        self._store = bytes(16)
        self._tail = Tail(0, 0, bytes(16))
        self._log_frames = LOG_FRAMES
        self._log_file: int | None = None
        try:
            self._db = self._open(self._claim.note)
        except BaseException:
            self._claim.release(well=False)
            raise

    @property
    def failed(self) -> bool:
        """Whether the disk failed and nothing is written until ``reopen``."""
        return bool(self._failure)

    def note(self, tail: Tail) -> None:
        """Note the newest journal row, which is on the disk."""
        with self.lock:
            self._tail = tail
            self._write_note()

    @contextmanager
    def transaction(self) -> Iterator[Work]:
        """Do several things at once; when it ends they are on the disk, or nothing was done.

        Raises:
            RunError: If the disk is full or fails; after a failure, until ``reopen``.
            StoreCorrupt: If SQLite says that the file is damaged.
        """
        with self.lock:
            self._require_sound()
            work = Work(self._db)
            with self._explained():
                self._db.execute("BEGIN IMMEDIATE")
                yield work
                self._db.execute("COMMIT")
            self._tail = work.tail or self._tail
            self._write_note()
            work.done()
            if self._frames >= self._log_frames:
                self._move_log()

    def reopen(self) -> None:
        """Begin anew after the disk failed: drop what was not acknowledged and check the rest.

        Raises:
            RunError: If the disk still fails; then nothing has changed.
            StoreCorrupt: If acknowledged frames are lost.
        """
        with self.lock, writing(self.path):
            self._require_here()
            self._failure = self._failure or "it was not reopened"
            with suppress(apsw.ConnectionClosedError):
                # Closing must not move what the disk may not have into the file.
                self._db.config(apsw.SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, 1)
                self._db.close(True)
            self._close_log()
            self._drop_unacknowledged(self._claim.note)
            self._db = self._open(self._claim.note)
            self._failure = ""

    def close(self) -> None:
        """Move the log into the file and give the lock back."""
        if os.getpid() != self._process:
            # Connection and lock are the parent's.
            return
        with self.lock:
            well = not self._failure
            try:
                if well:
                    self._db.set_busy_timeout(0)
                    self._db.wal_checkpoint(mode=apsw.SQLITE_CHECKPOINT_TRUNCATE)
                else:
                    self._db.config(apsw.SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, 1)
            except apsw.Error:
                # The log holds everything; whoever opens the store next reads it.
                well = False
            finally:
                with suppress(apsw.Error):
                    self._db.close(True)
                self._close_log()
                self._claim.release(well=well)

    def abandon(self) -> None:
        """Give the lock back and leave all as it is, the note of what was acknowledged too."""
        with self.lock:
            self._failure = self._failure or "it was abandoned"
            self.close()

    def _open(self, note: Note | None) -> apsw.Connection:
        with writing(self.path):
            log = check_log(self.path, note)
            name = str(self.path.absolute())
            db = apsw.Connection(name, apsw.SQLITE_OPEN_READWRITE, vfs=self._vfs or None)
            try:
                db.set_busy_timeout(5000)
                require_store(self.path, db)
                require_length(self.path, db)
                db.pragma("journal_mode", "wal")
                db.pragma("synchronous", "full")
                db.pragma("journal_size_limit", _LOG_KEPT)
                self._frames = log.frames if log else 0
                db.set_wal_hook(self._committed)
                migrate(db)
                # What recovery found may not be on the disk yet: from here on it is.
                db.wal_checkpoint(mode=apsw.SQLITE_CHECKPOINT_PASSIVE)
                self._store = required(db, State, 1).store
            except BaseException:
                db.close(True)
                raise
        self._tail = note.tail if note and note.store == self._store else Tail(0, 0, bytes(16))
        # From here on all frames that are beyond it are unacknowledged.
        self._write_note()
        return db

    def _committed(self, db: apsw.Connection, name: str, frames: int) -> int:
        self._frames = frames
        return apsw.SQLITE_OK

    def _write_note(self) -> None:
        self._claim.write(Note(self._store, self._salts(), self._frames, self._tail))

    def _salts(self) -> bytes:
        """Those of the log as it is now; they change when it begins anew."""
        try:
            if self._log_file is None:
                name = beside(self.path, "-wal")
                self._log_file = os.open(name, os.O_RDONLY | os.O_CLOEXEC)
            return os.pread(self._log_file, 8, 16).ljust(8, b"\0")
        except OSError:
            return bytes(8)

    def _move_log(self) -> None:
        """Move the log into the file. What was committed stays so, whatever happens here."""
        try:
            self._db.wal_checkpoint(mode=apsw.SQLITE_CHECKPOINT_PASSIVE)
            self._log_frames = LOG_FRAMES
        except (apsw.FullError, apsw.BusyError, apsw.LockedError):
            # Later: the log only grows meanwhile.
            self._log_frames = self._frames + LOG_FRAMES
        except apsw.Error as error:
            self._failure = str(error)

    @contextmanager
    def _explained(self) -> Iterator[None]:
        """Undo a transaction that failed, and remember a disk that did."""
        with writing(self.path):
            try:
                yield
            except BaseException as error:
                open_still = self._db.in_transaction
                harmless = isinstance(error, _HARMLESS) or not isinstance(error, apsw.Error)
                if not harmless or not (open_still or isinstance(error, apsw.Error)):
                    # The second: interrupted when it may have been done already.
                    self._failure = str(error) or type(error).__name__
                try:
                    if open_still:
                        self._db.execute("ROLLBACK")
                except apsw.Error as undoing:
                    self._failure = str(undoing)
                raise

    def _require_here(self) -> None:
        if os.getpid() != self._process:
            raise RunError(
                f"{self.path} was opened for writing in another process; write to it there, or "
                "close it there and open it in this one"
            )

    def _require_sound(self) -> None:
        self._require_here()
        if self._failure:
            raise RunError(
                f"{self.path} is not written to since the disk failed ({self._failure}); "
                "reopen it, or close it and open it again"
            )

    def _drop_unacknowledged(self, note: Note | None) -> None:
        """Cut off what follows the acknowledged frames: it may be on the disk or not."""
        log = check_log(self.path, note)
        if note and log and (any(note.salts) or not note.frames):
            # A log that begins anew has other salts, and nothing in it was acknowledged.
            kept = note.frames if note.salts == log.salts else 0
            end = HEADER + kept * (FRAME_HEADER + log.page_size)
            os.truncate(beside(self.path, "-wal"), end)

    def _close_log(self) -> None:
        if self._log_file is not None:
            os.close(self._log_file)
            self._log_file = None


_HARMLESS = (apsw.FullError, apsw.BusyError, apsw.LockedError, apsw.ConstraintError)
"""After these the disk is as it was."""
