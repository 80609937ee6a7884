"""Are the journal, the checkpoints and the names of a store what was written?"""

from __future__ import annotations

from collections import defaultdict
from functools import partial
from typing import NamedTuple

import apsw

from terrasim.grid import Grid
from terrasim.store import records
from terrasim.store.codec import StoreCorrupt
from terrasim.store.journal import floor_of, op_hash, read_rows
from terrasim.store.names import Names, read_names
from terrasim.store.records import Checkpoint, Epoch, Idem
from terrasim.store.tree import extent
from terrasim.store.verify_blobs import Blobs, Findings


class _Claim(NamedTuple):
    """Who says that the journal's newest row up to a number has a chain hash."""

    seq: int
    chain: bytes
    who: str


def check_history(db: apsw.Connection, found: Findings, grid: Grid, blobs: Blobs) -> None:
    """Check journal, checkpoints, branches and snapshots, and all that they need.

    Raises:
        StoreCorrupt: If a row by which others are found is missing or damaged.
    """
    names = read_names(db)
    epochs = {one.id: one for one in records.read_all(db, Epoch)}
    checkpoints = {one.id: one for one in records.read_all(db, Checkpoint)}
    claims = _names(found, names, epochs, checkpoints)
    extents = partial(extent, grid, factor=names.state.factor)
    for at in checkpoints.values():
        if at.epoch in epochs:
            claims[at.epoch].append(_Claim(at.seq, at.chain, f"checkpoint {at.id}"))
        found.problems += [f"checkpoint {at.id}: {one}" for one in blobs.tree(at.root, extents)]
    ops = {(one.key, one.seq): one.op for one in records.read_all(db, Idem)}
    rows = 0
    for epoch in epochs.values():
        rows += _journal(db, found, epoch, claims[epoch.id], ops)
    [(all_rows,)] = db.execute("SELECT count(*) FROM journal").fetchall()
    assert isinstance(all_rows, int)
    found.counts |= {
        "journal_rows": rows,
        "unused_rows": all_rows - rows,
        "branches": len(names.branches),
        "snapshots": len(names.snapshots),
        "epochs": len(epochs),
        "checkpoints": len(checkpoints),
        "unused_blobs": len(blobs.sound - blobs.used),
    }


def _names(
    found: Findings, names: Names, epochs: dict[int, Epoch], checkpoints: dict[int, Checkpoint]
) -> defaultdict[int, list[_Claim]]:
    """What branches and snapshots speak of is there; what they say of the journal, by epoch."""
    claims: defaultdict[int, list[_Claim]] = defaultdict(list)
    for branch in names.branches.values():
        who, at = f"branch {branch.name}", checkpoints.get(branch.checkpoint)
        claims[branch.epoch].append(_Claim(branch.tail, branch.tail_chain, who))
        if at is None or at.epoch != branch.epoch:
            found.problems.append(f"{who}: its checkpoint {branch.checkpoint} is missing")
        _lineage(found, who, branch.epoch, epochs)
    for snapshot in names.snapshots.values():
        who, at = f"snapshot {snapshot.name}", checkpoints.get(snapshot.checkpoint)
        if at is None:
            found.problems.append(f"{who}: its checkpoint {snapshot.checkpoint} is missing")
        else:
            _lineage(found, who, at.epoch, epochs)
    return claims


def _lineage(found: Findings, who: str, epoch: int, epochs: dict[int, Epoch]) -> None:
    while epoch:
        if epoch not in epochs:
            found.problems.append(f"{who}: epoch {epoch} of its history is missing")
            return
        epoch = epochs[epoch].parent


def _journal(
    db: apsw.Connection,
    found: Findings,
    epoch: Epoch,
    claims: list[_Claim],
    ops: dict[tuple[str, int], bytes],
) -> int:
    """Walk an epoch's rows; returns how many there are."""
    count, tail = 0, floor_of(epoch)
    # Of rows that were trimmed nobody knows.
    waiting = sorted((one for one in claims if one.seq >= epoch.floor), reverse=True)
    try:
        for row, after in read_rows(lambda sql, given: db.execute(sql, given).fetchall(), tail):
            while waiting and waiting[-1].seq < row.seq:
                _compare(found, waiting.pop(), tail.chain)
            tail = after
            count += 1
            known = ops.get((row.idem, row.seq)) if row.idem is not None else None
            if known is not None and known != op_hash(row.op):
                found.problems.append(f"key {row.idem!r} stands for another operation")
    except StoreCorrupt as error:
        found.problems.append(f"epoch {epoch.id}: {error}")
        return count
    while waiting:
        _compare(found, waiting.pop(), tail.chain)
    return count


def _compare(found: Findings, claim: _Claim, chain: bytes) -> None:
    if claim.chain != chain:
        found.problems.append(f"{claim.who}: journal row {claim.seq} is missing or another one")
