"""Epochs: where a stretch of a branch's journal begins, and what came before it."""

from __future__ import annotations

import time
from dataclasses import replace
from typing import NamedTuple

import apsw

from terrasim.errors import InputError
from terrasim.store import records
from terrasim.store.journal import first_chain, row_id
from terrasim.store.names import Names, find_snapshot
from terrasim.store.records import Checkpoint, Epoch, State


class Stretch(NamedTuple):
    """Rows of one epoch that belong to a history."""

    epoch: Epoch
    until: int
    """Number of the last."""


_ALWAYS = (1 << 40) - 1


def now() -> int:
    """The time [microseconds since 1970 UTC]."""
    return time.time_ns() // 1000


def begin(db: apsw.Connection, state: State, before: Checkpoint | None) -> tuple[State, Checkpoint]:
    """Begin an epoch in the state of a checkpoint, or on the terrain as imported.

    Two rows, however large the terrain is and however much was done to it.

    Args:
        db: A transaction.
        state: The state row, its ``seq`` up to date; it is not written here.
        before: The checkpoint.

    Returns:
        The state with the numbers given out, and the epoch's first checkpoint.
    """
    parent, cut = (before.epoch, before.seq) if before else (0, 0)
    number = state.epochs + 1
    state = replace(state, epochs=number, checkpoints=state.checkpoints + 1)
    chain = first_chain(number, parent, cut)
    epoch = Epoch(number, parent, cut, now(), state.seq, chain)
    root, detailed = (before.root, before.detailed) if before else (b"", 0)
    first = Checkpoint(
        state.checkpoints, number, state.seq, chain, root, detailed, blocks=0, time=now()
    )
    records.write(db, epoch, first)
    return state, first


def lineage(db: apsw.Connection, epoch: int) -> list[Stretch]:
    """An epoch and those it goes on from, newest first.

    Raises:
        StoreCorrupt: If one is missing or damaged.
    """
    found = []
    until = _ALWAYS
    while epoch:
        one = records.required(db, Epoch, epoch)
        found.append(Stretch(one, until))
        epoch, until = one.parent, one.cut
    return found


def find_checkpoint(db: apsw.Connection, names: Names, epoch: int, at: str | int) -> Checkpoint:
    """The checkpoint that a snapshot names, or the newest after a number of the history.

    Raises:
        InputError: If there is none.
        StoreCorrupt: If it is damaged.
    """
    if isinstance(at, str):
        return records.required(db, Checkpoint, find_snapshot(names, at).checkpoint)
    sql = "SELECT max(id) FROM checkpoint WHERE epoch = ? AND seq = ?"
    for stretch in lineage(db, epoch):
        if at > stretch.until:
            continue
        [(found,)] = db.execute(sql, (stretch.epoch.id, at)).fetchall()
        if found is not None:
            return records.required(db, Checkpoint, found)
    raise InputError(
        f"there is no checkpoint after operation {at} on this branch; name a snapshot, or an "
        f"operation at which a checkpoint was written"
    )


def newest_seq(db: apsw.Connection, state: State) -> int:
    """The highest number of a journal row in the store."""
    sql = "SELECT max(id) FROM journal WHERE id >= ? AND id < ?"
    first = row_id(state.epoch, 0)
    [(found,)] = db.execute(sql, (first, row_id(state.epoch + 1, 0))).fetchall()
    return max(state.seq, found - first) if isinstance(found, int) else state.seq
