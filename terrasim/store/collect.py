"""Collecting what nobody needs: states without a name, and the blobs that only they held.

Needed are the newest checkpoint of every branch and every snapshot. All else goes, in small
transactions between which others may write: first the rows by which a state could be found, so that
whoever reads one learns that it is gone, then its blobs, then the room they took in the file.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import apsw

from terrasim.store import records
from terrasim.store.branch import Branch, open_branch
from terrasim.store.codec import StoreCorrupt
from terrasim.store.edited import Nodes
from terrasim.store.epochs import lineage
from terrasim.store.journal import row_id
from terrasim.store.names import one_state, read_names
from terrasim.store.readers import Readers
from terrasim.store.records import Checkpoint
from terrasim.store.store_file import REMEDY
from terrasim.store.tree import Entry
from terrasim.store.writer import Writer

_ROWS_AT_ONCE = 1000
_BLOBS_AT_ONCE = 100
_PAGES_AT_ONCE = 256


def collect(store: Branch | str | Path) -> dict[str, Any]:
    """Delete what no branch and no snapshot needs, and make the file smaller.

    Args:
        store: A branch of the store, if one is open for writing, or the store.

    Returns:
        How many ``checkpoints``, ``epochs``, journal ``rows``, ``blobs`` and ``bytes`` of the file
        were let go of, ready for JSON.

    Raises:
        InputError: As :func:`terrasim.store.branch.open_branch`.
        RunError: If it cannot be written; what was done stays done.
        StoreCorrupt: If a state that is needed is damaged: then no blob is deleted.
    """
    if not isinstance(store, Branch):
        with open_branch(store) as branch:
            return collect(branch)
    with store.images_lock:
        size = _pages(store.readers)
        nodes = Nodes(store.readers, store.grid)
        with store.readers.borrow() as db, one_state(db):
            named, epochs = _needed(db)
        done: dict[str, Any] = {
            "checkpoints": _drop_checkpoints(store.writer, {one.id for one in named}),
            "epochs": _drop_epochs(store.writer, epochs),
        }
        done["rows"] = _drop_rows(store.writer, store.readers, epochs)
        held = reachable(nodes, {one.root for one in named})
        done["blobs"] = _drop_blobs(store.writer, store.readers, held)
        _vacuum(store.writer)
        done["bytes"] = size - _pages(store.readers)
    return done


def reachable(nodes: Nodes, roots: Iterable[bytes]) -> set[bytes]:
    """Content addresses of all nodes and blobs of some trees, each visited once.

    Raises:
        StoreCorrupt: If a node is missing or damaged.
    """
    held: set[bytes] = set()
    waiting = [root for root in roots if root]
    while waiting:
        name = waiting.pop()
        if name in held:
            continue
        held.add(name)
        for one in nodes.node(name).values():
            if isinstance(one, Entry):
                held.add(one.content)
            else:
                waiting.append(one)
    return held


def _needed(db: apsw.Connection) -> tuple[list[Checkpoint], dict[int, int]]:
    """The checkpoints that have a name, and up to where each epoch is in one of their histories."""
    names = read_names(db)
    numbers = {one.checkpoint for one in names.branches.values()}
    numbers |= {one.checkpoint for one in names.snapshots.values()}
    named = [records.required(db, Checkpoint, number) for number in sorted(numbers)]
    heads = {one.epoch for one in names.branches.values()}
    epochs: dict[int, int] = {}
    for one in named:
        for epoch, until in lineage(db, one.epoch):
            named_last = epoch.id == one.epoch and epoch.id not in heads
            epochs[epoch.id] = max(one.seq if named_last else until, epochs.get(epoch.id, 0))
    return named, epochs


def _drop_checkpoints(writer: Writer, needed: set[int]) -> int:
    with writer.transaction() as work:
        ids = [row[0] for row in work.db.execute("SELECT id FROM checkpoint").fetchall()]
    gone = [(number,) for number in ids if number not in needed]
    return _delete(writer, "DELETE FROM checkpoint WHERE id = ?", gone, _ROWS_AT_ONCE)


def _drop_epochs(writer: Writer, needed: Container[int]) -> int:
    with writer.transaction() as work:
        ids = [row[0] for row in work.db.execute("SELECT id FROM epoch").fetchall()]
    gone = [(number,) for number in ids if number not in needed]
    return _delete(writer, "DELETE FROM epoch WHERE id = ?", gone, _ROWS_AT_ONCE)


def _drop_rows(writer: Writer, readers: Readers, needed: Mapping[int, int]) -> int:
    """Journal rows that are in no history, newest first, so that what is left stays chained."""
    count = 0
    for epoch in _journal_epochs(readers):
        span = row_id(epoch, needed.get(epoch, -1)), row_id(epoch + 1, 0)
        while found := readers.fetch(
            "SELECT id FROM journal WHERE id > ? AND id < ? ORDER BY id DESC LIMIT ?",
            (*span, _ROWS_AT_ONCE),
        ):
            count += _delete(writer, "DELETE FROM journal WHERE id = ?", found, _ROWS_AT_ONCE)
    return count


def _journal_epochs(readers: Readers) -> Iterator[int]:
    """Epochs that have rows, one query each."""
    epoch = 0
    while True:
        sql = "SELECT id FROM journal WHERE id >= ? ORDER BY id LIMIT 1"
        found = readers.fetch(sql, (row_id(epoch, 0),))
        if not found:
            return
        epoch = found[0][0] // row_id(1, 0)
        yield epoch
        epoch += 1


def _drop_blobs(writer: Writer, readers: Readers, held: set[bytes]) -> int:
    """Blobs that are in no tree. Those of the import come first in the table and stay."""
    [(imported,)] = readers.fetch("SELECT ifnull(max(blob), 0) FROM block")
    gone, found = [], set()
    last = imported
    while rows := readers.fetch(
        "SELECT id, hash FROM blob WHERE id > ? ORDER BY id LIMIT ?", (last, _ROWS_AT_ONCE)
    ):
        last = rows[-1][0]
        gone += [(number,) for number, name in rows if name not in held]
        found |= {name for _, name in rows}
    lost = [name for name in held - found if not _is_imported(readers, name, imported)]
    if lost:
        raise StoreCorrupt(f"{len(lost)} blobs are missing; nothing is deleted; {REMEDY}")
    return _delete(writer, "DELETE FROM blob WHERE id = ?", gone, _BLOBS_AT_ONCE)


def _is_imported(readers: Readers, name: bytes, imported: int) -> bool:
    found = readers.fetch("SELECT id FROM blob WHERE hash = ?", (name,))
    return bool(found) and found[0][0] <= imported


def _delete(writer: Writer, sql: str, keys: list[Any], at_once: int) -> int:
    for first in range(0, len(keys), at_once):
        with writer.transaction() as work:
            work.db.executemany(sql, keys[first : first + at_once])
    return len(keys)


def _vacuum(writer: Writer) -> None:
    """Give free pages back, some at a time."""
    while True:
        with writer.transaction() as work:
            before = work.db.pragma("freelist_count")
            if not before:
                return
            work.db.execute(f"PRAGMA incremental_vacuum({_PAGES_AT_ONCE})").fetchall()
            if work.db.pragma("freelist_count") >= before:
                # A file that was made without room to give back keeps its size.
                return


def _pages(readers: Readers) -> int:
    with readers.borrow() as db:
        size: int = db.pragma("page_count") * db.pragma("page_size")
        return size
