"""Is what a writer acknowledged still there? Asked before anything of a store is believed."""

from __future__ import annotations

from pathlib import Path

import apsw

from terrasim.store import records
from terrasim.store.acknowledged import Note, check_tail, sound_log
from terrasim.store.journal import Tail, chain_at
from terrasim.store.opening import require_store
from terrasim.store.records import BranchRow, Epoch, State
from terrasim.store.store_file import connect_reader, reading


def require_acknowledged(path: Path) -> None:
    """Refuse a store that lost something acknowledged, unless a writer is at work on it.

    Raises:
        InputError: If it is no store, or a newer one.
        RunError: If it cannot be read.
        StoreCorrupt: If the write-ahead log or the journal row that was acknowledged last is not
            as it was.
    """
    with reading(path), sound_log(path) as note:
        if note is None:
            return
        db = connect_reader(path)
        try:
            if require_store(path, db) > 1:
                # No writer is at work, so all that is read is of one state.
                check_note(path, db, note, records.required(db, State, 1))
        finally:
            db.close(True)


def check_note(path: Path, db: apsw.Connection, note: Note, state: State) -> None:
    """Refuse a store that lacks the journal row that was acknowledged last.

    Raises:
        StoreCorrupt: If it does.
    """
    epoch = records.read(db, Epoch, note.tail.epoch)
    if epoch is None and note.tail.epoch > state.epochs:
        check_tail(path, note, state.store, Tail(0, 0, b""))
    # A note is not flushed and may come from before what was done since. Where no branch goes on
    # from an epoch's end, its last rows may have been collected; those up to the floor, trimmed.
    ends = {branch.epoch for branch in records.read_all(db, BranchRow)}
    if epoch is not None and epoch.id in ends and note.tail.seq >= epoch.floor:
        found = chain_at(lambda sql, given: db.execute(sql, given).fetchall(), epoch, note.tail.seq)
        check_tail(path, note, state.store, found)
