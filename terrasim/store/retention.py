"""How long the journal is kept: what a checkpoint holds is needed only to look back and to undo."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import apsw

from terrasim.store import records
from terrasim.store.epochs import lineage, now
from terrasim.store.journal import row_id
from terrasim.store.names import read_names
from terrasim.store.records import Checkpoint, Epoch, State
from terrasim.store.writer import Writer

KEYS_KEPT_S = 24 * 3600
"""How long a caller's key is remembered at least [s]."""
_ROWS_AT_ONCE = 1000


def first_needed(db: apsw.Connection, keep: int) -> dict[int, int]:
    """The oldest row of each epoch that is needed, by epoch.

    Needed are all rows that no checkpoint holds yet, and the newest ``keep`` of the history of
    every branch and every snapshot.
    """
    # SQLite counts no further.
    keep = min(keep, 2**63 - 1)
    names = read_names(db)
    needed: dict[int, int] = {}
    for branch in names.branches.values():
        at = records.required(db, Checkpoint, branch.checkpoint)
        _need(needed, branch.epoch, at.seq + 1)
        _need_newest(db, needed, branch.epoch, None, keep)
    for snapshot in names.snapshots.values():
        at = records.required(db, Checkpoint, snapshot.checkpoint)
        _need_newest(db, needed, at.epoch, at.seq, keep)
    return needed


def trim_epoch(writer: Writer, number: int, first: int, last_seq: Callable[[], int]) -> int:
    """Delete an epoch's rows before one, some at a time; the rest stays chained.

    Args:
        writer: The store.
        number: The epoch.
        first: The first row that stays.
        last_seq: Highest number of a journal row in the store.

    Returns:
        How many were deleted.
    """
    count = 0
    while True:
        with writer.transaction() as work:
            epoch = records.required(work.db, Epoch, number)
            found = work.db.execute(
                "SELECT id, chain FROM journal WHERE id >= ? AND id < ? ORDER BY id LIMIT ?",
                (row_id(number, 0), row_id(number, first), _ROWS_AT_ONCE),
            ).fetchall()
            if not found:
                return count
            newest, chain = found[-1]
            assert isinstance(newest, int)
            assert isinstance(chain, bytes)
            sql = "DELETE FROM journal WHERE id >= ? AND id <= ?"
            work.db.execute(sql, (row_id(number, 0), newest))
            floor = newest - row_id(number, 0)
            # The numbers that were given out are not given out again.
            state = replace(records.required(work.db, State, 1), seq=last_seq())
            records.write(work.db, replace(epoch, floor=floor, floor_chain=chain), state)
        count += len(found)


def forget_keys(writer: Writer) -> None:
    """Delete callers' keys that are older than they are promised to be remembered."""
    with writer.transaction() as work:
        work.db.execute("DELETE FROM idem WHERE time < ?", (now() - KEYS_KEPT_S * 1_000_000,))


def _need(needed: dict[int, int], epoch: int, seq: int) -> None:
    needed[epoch] = min(seq, needed.get(epoch, seq))


def _need_newest(
    db: apsw.Connection, needed: dict[int, int], epoch: int, until: int | None, keep: int
) -> None:
    for stretch in lineage(db, epoch):
        number = stretch.epoch.id
        last = stretch.until if until is None else min(until, stretch.until)
        found = db.execute(
            "SELECT id FROM journal WHERE id >= ? AND id <= ? ORDER BY id DESC LIMIT ?",
            (row_id(number, 0), row_id(number, last), keep),
        ).fetchall()
        keep -= len(found)
        oldest = found[-1][0] if found else row_id(number, last + 1)
        assert isinstance(oldest, int)
        _need(needed, number, oldest - row_id(number, 0))
