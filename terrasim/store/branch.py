"""A branch that is open for writing: what is done goes into its journal, images follow.

Recovery is the newest checkpoint and the rows after it, done once more by whoever understands them.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Self, TypeVar

import apsw

from terrasim.errors import InputError, RunError
from terrasim.grid import Block
from terrasim.sources.source import BlockData
from terrasim.store import journal
from terrasim.store.checkpoint import has_detail, write_images
from terrasim.store.edited import At
from terrasim.store.epochs import now
from terrasim.store.history import newest_first, oldest_first
from terrasim.store.journal import JournalRow, NewRow, Tail
from terrasim.store.keys import earlier, remember
from terrasim.store.moves import (
    change_factor,
    forget_branch,
    forget_snapshot,
    fork_at,
    next_checkpoint,
    note_tail,
    reset_to,
    take_snapshot,
)
from terrasim.store.names import (
    MAIN,
    BranchState,
    SnapshotState,
    branches,
    one_state,
    snapshots,
)
from terrasim.store.newest import Newest
from terrasim.store.opening import read_meta
from terrasim.store.readers import Readers
from terrasim.store.records import Checkpoint, Snapshot
from terrasim.store.retention import first_needed, forget_keys, trim_epoch
from terrasim.store.standing import Standing, stand
from terrasim.store.store import StoreSource
from terrasim.store.store_file import connect_reader
from terrasim.store.writer import Writer

T = TypeVar("T")


class Branch(Newest):
    """A named line of states that is written to. Also a source: its newest checkpoint's heights.

    Reading is safe from several threads; appending and writing a checkpoint may go on at once.
    """

    def __init__(self, path: Path, name: str, *, create: bool, vfs: str) -> None:
        """Take the writer's lock; use :func:`open_branch`."""
        self.name = name
        """Its name."""
        self.path = path
        """The store."""
        self._writer = Writer(path, vfs)
        self._readers = Readers(path, lambda: _beside_writer(path, vfs))
        # One at a time writes images, drops them or moves the branch; appending goes on meanwhile.
        self.images_lock = threading.RLock()
        """Held while images are written or collected."""
        self._closed = False
        try:
            self._standing = stand(self._writer, self._readers, name, create)
            with self._readers.borrow() as db:
                meta = read_meta(path, db)
            super().__init__(StoreSource(meta, self._readers, self._standing.at))
        except BaseException as error:
            self._readers.close()
            if isinstance(error, InputError) and self._writer.last_note is None:
                # The store is well, only the name is wrong: nothing stays beside it.
                self._writer.close()
            else:
                self._writer.abandon()
            raise

    @property
    def last_seq(self) -> int:
        """Highest number of a journal row so far."""
        return self._standing.last

    @property
    def checkpoint_seq(self) -> int:
        """What the journal's rows up to this one did is in the newest checkpoint."""
        return self._standing.checkpoint.seq

    @property
    def writer(self) -> Writer:
        """The store's only writing connection."""
        return self._writer

    @property
    def readers(self) -> Readers:
        """Connections that read."""
        return self._readers

    def changed(self) -> Iterator[Block]:
        """Blocks that differ from the imported ones at the newest checkpoint."""
        return self._view.changed()

    def append(
        self, op: bytes, *, idem: str | None = None, engine: str = "", summary: str = ""
    ) -> int:
        """Write what is done into the journal; it is on the disk when this returns.

        Args:
            op: What is done, opaque here.
            idem: A key of the caller's: the same operation under the same key is written once.
            engine: Who does it, so that doing it again elsewhere can be told.
            summary: What is done, in a few words for a list.

        Returns:
            Its number; that of the first time if it was written under the same key before.

        Raises:
            InputError: If the key stands for another operation, or a word is no text.
            RunError: If the disk is full or fails: nothing is written then. After a failure nothing
                is written until ``reopen``.
        """
        return self.append_many([NewRow(op, idem, engine, summary)])[0]

    def append_many(self, rows: Sequence[NewRow]) -> list[int]:
        """Write several rows at once: all of them are on the disk when this returns, or none is.

        Raises:
            InputError: As ``append``; none is written then.
            RunError: As ``append``.
        """
        for row in rows:
            journal.check_new(row)
        found = []
        with self._writer.transaction() as work:
            # Nobody else changes it while the transaction is open.
            standing = self._standing
            tail, last = standing.tail, standing.last
            for row in rows:
                seq = earlier(work.db, self.name, row)
                if seq is None:
                    last += 1
                    seq, time = last, now()
                    tail = journal.write_row(work.db, tail, seq, time, row)
                    remember(work.db, self.name, row, seq, time)
                found.append(seq)
            work.tail = tail
            work.done = lambda: self._stand(replace(standing, tail=tail, last=last))
        return found

    def earlier(self, op: bytes, idem: str) -> int | None:
        """The number under which an operation was written with a key before; None if it was not.

        Raises:
            InputError: If the key stands for another operation.
        """
        row = NewRow(op, idem)
        journal.check_new(row)
        with self._readers.borrow() as db:
            return earlier(db, self.name, row)

    def pending(self) -> Iterator[tuple[int, bytes, str]]:
        """Number, operation and engine of the rows after the newest checkpoint, oldest first.

        Raises:
            StoreCorrupt: If one is not as it was written.
        """
        at = self._standing.checkpoint
        for row, _ in journal.read_rows(self._readers.fetch, Tail(at.epoch, at.seq, at.chain)):
            yield row.seq, row.op, row.engine

    def rows(self, first: int = 0) -> Iterator[JournalRow]:
        """The branch's history from a number on, oldest first, as far as it was not trimmed.

        Raises:
            StoreCorrupt: If a row is not as it was written.
        """
        return oldest_first(self._readers, self._standing.row, first)

    def history(self, limit: int = 100) -> list[JournalRow]:
        """The newest rows of the branch's history, newest first.

        Raises:
            InputError: If the limit is negative.
            StoreCorrupt: If a row is not as it was written.
        """
        return newest_first(self._readers, self._standing.row, limit)

    def checkpoint(self, blocks: Mapping[Block, BlockData | None], seq: int) -> Checkpoint:
        """Write images of what has changed since the last checkpoint.

        Args:
            blocks: The blocks that changed; None for a detail block that is zero again.
            seq: What the journal's rows up to this one did is in the blocks, and no more.

        Returns:
            What was written.

        Raises:
            InputError: If a block or the number is none of this branch's.
            RunError: If it cannot be written; the state is the one before then.
        """
        with self.images_lock:
            before = self._standing
            if not before.checkpoint.seq <= seq <= before.last:
                raise InputError(
                    f"a checkpoint comes after operation {before.checkpoint.seq} to {before.last}, "
                    f"got {seq}"
                )
            nodes, base = self._view.nodes, self._view.base
            images = write_images(self._writer, nodes, base, before.at, blocks)
            detailed = has_detail(nodes, At(0, images.root, before.factor))
            with self._writer.transaction() as work:
                # Rows may have come since.
                standing = self._standing
                moved = next_checkpoint(work.db, standing, seq, images, detailed)
                work.done = lambda: self._stand(moved)
            return moved.checkpoint

    def snapshot(self, name: str) -> Snapshot:
        """Give the state of the newest checkpoint a name.

        Raises:
            InputError: If the name is taken or no name, or there are rows after the checkpoint.
            RunError: If it cannot be written.
        """
        with self.images_lock, self._writer.transaction() as work:
            return take_snapshot(work.db, self._standing, name)

    def reset(self, to: str | int) -> None:
        """Go back to a snapshot or to the checkpoint after an operation; costs the same always.

        What was done since is no part of the branch any more. Rows not yet in a checkpoint are
        dropped with it.

        Raises:
            InputError: If there is no such state.
            RunError: If it cannot be written.
        """
        with self.images_lock, self._writer.transaction() as work:
            moved = reset_to(work.db, self._standing, to)
            work.tail = moved.tail
            work.done = lambda: self._stand(moved)

    def fork(self, name: str, at: str | int | None = None) -> None:
        """Begin a branch in the state of a snapshot or checkpoint, by default the newest one.

        Raises:
            InputError: If the name is taken or no name, there is no such state, or by default if
                there are rows after the newest checkpoint.
            RunError: If it cannot be written.
        """
        with self.images_lock, self._writer.transaction() as work:
            fork_at(work.db, self._standing, name, at)

    def drop_branch(self, name: str) -> None:
        """Forget a branch; what only it held is collected later.

        Raises:
            InputError: If there is none, it is the main branch or this one.
            RunError: If it cannot be written.
        """
        if name in {MAIN, self.name}:
            raise InputError(f"branch {name!r} cannot be dropped: it is the main one or in use")
        with self.images_lock, self._writer.transaction() as work:
            forget_branch(work.db, name)

    def drop_snapshot(self, name: str) -> None:
        """Forget a snapshot; what only it held is collected later.

        Raises:
            InputError: If there is none.
            RunError: If it cannot be written.
        """
        with self.images_lock, self._writer.transaction() as work:
            forget_snapshot(work.db, name)

    def branches(self) -> dict[str, BranchState]:
        """All branches by name."""
        return branches(self._readers)

    def snapshots(self) -> dict[str, SnapshotState]:
        """All snapshots by name."""
        return snapshots(self._readers)

    def set_detail_factor(self, factor: int) -> None:
        """Say how many detail posts there are to a base post; the file keeps it.

        Raises:
            InputError: If it is no whole number from 1 on, the detail's numbers would be too large,
                or there are detail blocks or waiting rows that go by another one.
            RunError: If it cannot be written.
        """
        with self.images_lock, self._writer.transaction() as work:
            changed = change_factor(work.db, self._standing, self.grid, factor)
            work.done = lambda: self._stand(changed)

    def trim(self, keep: int) -> int:
        """Shorten the journal: keep the newest rows of every branch's and snapshot's history.

        Rows that no checkpoint holds yet are kept in any case, callers' keys for a day.

        Args:
            keep: How many rows of each history; so many operations can be undone.

        Returns:
            How many rows were deleted.

        Raises:
            InputError: If the number is negative.
            RunError: If it cannot be written; what was done stays done.
        """
        if keep < 0:
            raise InputError(f"keep must not be negative, got {keep}")
        with self.images_lock:
            with self._readers.borrow() as db, one_state(db):
                needed = first_needed(db, keep)
            forget_keys(self._writer)
            return sum(
                trim_epoch(self._writer, epoch, first, lambda: self.last_seq)
                for epoch, first in needed.items()
            )

    def reopen(self) -> None:
        """Go on after the disk failed: what was acknowledged is checked, all else dropped.

        Raises:
            RunError: If the disk still fails.
            StoreCorrupt: If something acknowledged is lost.
        """
        with self.images_lock, self._writer.lock:
            self._readers.close()
            self._writer.reopen()
            self._stand(stand(self._writer, self._readers, self.name, create=False))

    def close(self) -> None:
        """Note where the branch stands and let go of the store."""
        with self.images_lock:
            if self._closed:
                return
            self._closed = True
            try:
                # What was acknowledged is on the disk in any case; this shows if it is lost later.
                with suppress(RunError), self._writer.transaction() as work:
                    note_tail(work.db, self._standing)
            finally:
                self._readers.close()
                self._writer.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _stand(self, standing: Standing) -> None:
        """Take a new place; readers see it from the next block on."""
        self._standing = standing
        self._follow(standing.at)


def _beside_writer(path: Path, vfs: str) -> apsw.Connection:
    """A connection that reads and, even if it is the last, leaves the log to the writer.

    After the disk failed there is no other, and the log holds what was not acknowledged.
    """
    connection = connect_reader(path, vfs)
    connection.config(apsw.SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, 1)
    return connection


def open_branch(
    path: str | Path, name: str = MAIN, *, create: bool = False, vfs: str = ""
) -> Branch:
    """Open a branch of a store for writing. A store has one writer at a time, and any readers.

    Args:
        path: The store; one of an older version is brought up to this one.
        name: The branch. The main one is there always.
        create: Begin a branch of that name on the terrain as imported if there is none.
        vfs: Name of the SQLite VFS to go through; empty for the system's own.

    Raises:
        InputError: If there is no such store or branch, or the store is of a newer version.
        RunError: If the store is open for writing already, or the disk fails.
        StoreCorrupt: If something acknowledged is lost or damaged.
    """
    return Branch(Path(path), name, create=create, vfs=vfs)
