"""Checkpoints, snapshots, resets, forks: each some rows in one transaction, for any terrain."""

from __future__ import annotations

from dataclasses import replace

import apsw

from terrasim.errors import InputError
from terrasim.grid import MAX_INDEX, Grid
from terrasim.kernels.addressing import BLOCK
from terrasim.store import records
from terrasim.store.checkpoint import Images
from terrasim.store.epochs import begin, find_checkpoint, now
from terrasim.store.journal import Tail, chain_at
from terrasim.store.names import check_name, find_branch, find_snapshot, read_names
from terrasim.store.records import BranchRow, Checkpoint, Epoch, Snapshot, State, names_with
from terrasim.store.standing import Standing


def next_checkpoint(
    db: apsw.Connection, standing: Standing, seq: int, images: Images, detailed: bool
) -> Standing:
    """Name images that are written as a branch's newest checkpoint."""
    state = records.required(db, State, 1)
    epoch = records.required(db, Epoch, standing.row.epoch)
    known = chain_at(lambda sql, given: db.execute(sql, given).fetchall(), epoch, seq)
    made = Checkpoint(
        id=state.checkpoints + 1,
        epoch=epoch.id,
        seq=seq,
        chain=known.chain,
        root=images.root,
        detailed=int(detailed),
        blocks=images.blocks,
        time=now(),
    )
    records.write(db, made)
    state = replace(state, checkpoints=made.id, seq=standing.last)
    return _moved(db, state, standing, made, standing.tail)


def take_snapshot(db: apsw.Connection, standing: Standing, name: str) -> Snapshot:
    """Give the state of the newest checkpoint a name.

    Raises:
        InputError: If the name is taken or no name, or there are rows after the checkpoint.
    """
    check_name(name)
    _require_no_rows_waiting(standing)
    names = read_names(db)
    if name in names.snapshots:
        raise InputError(f"there is a snapshot {name!r} already; choose another name")
    made = Snapshot(name, standing.checkpoint.id, standing.row.name, now())
    records.write(db, made, replace(names.state, names=names_with(names.state.names, made)))
    return made


def reset_to(db: apsw.Connection, standing: Standing, to: str | int) -> Standing:
    """Begin a new epoch of a branch in an earlier state.

    Raises:
        InputError: If there is no such state.
    """
    names = read_names(db)
    found = find_checkpoint(db, names, standing.row.epoch, to)
    state, first = begin(db, replace(names.state, seq=standing.last), found)
    tail = Tail(first.epoch, first.seq, first.chain)
    return _moved(db, replace(state, epoch=first.epoch), standing, first, tail)


def fork_at(db: apsw.Connection, standing: Standing, name: str, at: str | int | None) -> None:
    """Begin a branch in the state of a snapshot or checkpoint, or of the newest one.

    Raises:
        InputError: If the name is taken or no name, or there is no such state.
    """
    check_name(name)
    names = read_names(db)
    if name in names.branches:
        raise InputError(f"there is a branch {name!r} already; choose another name")
    if at is None:
        _require_no_rows_waiting(standing)
        found = standing.checkpoint
    else:
        found = find_checkpoint(db, names, standing.row.epoch, at)
    state, first = begin(db, replace(names.state, seq=standing.last), found)
    row = BranchRow(name, first.epoch, first.id, first.seq, first.chain)
    records.write(db, row, replace(state, names=names_with(state.names, row)))


def forget_branch(db: apsw.Connection, name: str) -> None:
    """Take out a branch and its callers' keys.

    Raises:
        InputError: If there is none of that name.
    """
    names = read_names(db)
    db.execute("DELETE FROM idem WHERE branch = ?", (name,))
    _forget(db, names.state, find_branch(names, name))


def forget_snapshot(db: apsw.Connection, name: str) -> None:
    """Take out a snapshot.

    Raises:
        InputError: If there is none of that name.
    """
    names = read_names(db)
    _forget(db, names.state, find_snapshot(names, name))


def change_factor(db: apsw.Connection, standing: Standing, grid: Grid, factor: int) -> Standing:
    """Say how many detail posts there are to a base post.

    Raises:
        InputError: If it is out of range, or something there goes by another one.
    """
    if type(factor) is not int or factor < 1:
        raise InputError(f"detail factor must be a whole number from 1 on, got {factor!r}")
    span = grid.blocks(0)
    posts = max(span.row1 - span.row0, span.col1 - span.col0) * BLOCK * factor
    if posts >= MAX_INDEX:
        raise InputError(
            f"detail factor {factor} makes {posts} detail posts a side: they must stay below "
            f"{MAX_INDEX}; take a smaller factor or terrain"
        )
    if factor == standing.factor:
        return standing
    if db.execute("SELECT 1 FROM checkpoint WHERE detailed LIMIT 1").fetchone():
        raise InputError(
            f"the store has detail blocks of factor {standing.factor}, got {factor}: open it with "
            "that one, or drop what holds them and collect"
        )
    if standing.pending:
        raise InputError(
            f"detail factor is {standing.factor} and operations wait for a checkpoint, "
            f"got {factor}: write a checkpoint first"
        )
    records.write(db, replace(records.required(db, State, 1), factor=factor))
    return replace(standing, factor=factor)


def note_tail(db: apsw.Connection, standing: Standing) -> None:
    """Say in the branch's row which journal row is its newest, so that it is missed if lost."""
    if standing.row.tail != standing.tail.seq:
        state = replace(records.required(db, State, 1), seq=standing.last)
        _moved(db, state, standing, standing.checkpoint, standing.tail)


def _moved(
    db: apsw.Connection, state: State, standing: Standing, checkpoint: Checkpoint, tail: Tail
) -> Standing:
    """Put a branch elsewhere, its row and the state row with it."""
    row = BranchRow(standing.row.name, checkpoint.epoch, checkpoint.id, tail.seq, tail.chain)
    names = names_with(state.names, standing.row, row)
    records.write(db, row, replace(state, names=names))
    return replace(standing, row=row, checkpoint=checkpoint, tail=tail)


def _forget(db: apsw.Connection, state: State, row: BranchRow | Snapshot) -> None:
    db.execute(f"DELETE FROM {row.table} WHERE name = ?", (row.name,))
    records.write(db, replace(state, names=names_with(state.names, row)))


def _require_no_rows_waiting(standing: Standing) -> None:
    if standing.pending:
        raise InputError(
            f"branch {standing.row.name!r} has operations {standing.checkpoint.seq + 1} to "
            f"{standing.tail.seq} after its newest checkpoint; write a checkpoint first"
        )
