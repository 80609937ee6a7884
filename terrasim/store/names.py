"""Branches and snapshots: the names of states, and the state row that tells if one was lost."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import apsw

from terrasim.errors import InputError
from terrasim.store.codec import StoreCorrupt
from terrasim.store.edited import At
from terrasim.store.noted import require_acknowledged
from terrasim.store.opening import require_file, require_store
from terrasim.store.readers import Readers
from terrasim.store.records import (
    BranchRow,
    Checkpoint,
    Snapshot,
    State,
    names_with,
    read_all,
    required,
)
from terrasim.store.store_file import REMEDY, connect_reader

MAIN = "main"
"""The branch that every store has."""
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,63}")


@dataclass(frozen=True)
class Names:
    """All that has a name."""

    state: State
    branches: Mapping[str, BranchRow]
    snapshots: Mapping[str, Snapshot]


@dataclass(frozen=True)
class SnapshotState:
    """A named state."""

    name: str
    seq: int
    """What the journal's rows up to this one did is in it."""
    branch: str
    """The branch on which it was taken."""
    time: float
    """When it was taken [s since 1970 UTC]."""


@dataclass(frozen=True)
class BranchState:
    """A named line of states."""

    name: str
    seq: int
    """What the journal's rows up to this one did is in its newest checkpoint."""
    time: float
    """When that was written [s since 1970 UTC]."""


@contextmanager
def one_state(db: apsw.Connection) -> Iterator[apsw.Connection]:
    """Several queries that see the same state, whoever writes meanwhile."""
    db.execute("BEGIN")
    try:
        yield db
    finally:
        db.execute("ROLLBACK")


def read_names(db: apsw.Connection) -> Names:
    """The state row, the branches and the snapshots.

    Raises:
        StoreCorrupt: If one is missing or not as it was written.
    """
    state = required(db, State, 1)
    branches, snapshots = read_all(db, BranchRow), read_all(db, Snapshot)
    if names_with(0, *branches, *snapshots) != state.names:
        raise StoreCorrupt(f"a branch or a snapshot is missing; {REMEDY}")
    return Names(state, {one.name: one for one in branches}, {one.name: one for one in snapshots})


def place_of(db: apsw.Connection, names: Names, branch: str | None, snapshot: str | None) -> At:
    """Which state is meant: a snapshot, or a branch's newest checkpoint.

    Without both it is the main branch's, or the terrain as imported if there is none.

    Raises:
        InputError: If there is no such name, or both are given.
        StoreCorrupt: If the checkpoint is missing.
    """
    if snapshot is not None and branch is not None:
        raise InputError("give a branch or a snapshot, got both")
    if snapshot is not None:
        number = find_snapshot(names, snapshot).checkpoint
    elif branch is None and MAIN not in names.branches:
        return At(0, b"", names.state.factor)
    else:
        number = find_branch(names, branch or MAIN).checkpoint
    found = required(db, Checkpoint, number)
    return At(found.id, found.root, names.state.factor)


def branches(store: Path | str | Readers) -> dict[str, BranchState]:
    """All branches of a store by name.

    Raises:
        InputError: As :func:`terrasim.store.store.open_store`.
        StoreCorrupt: If one is missing or damaged.
    """
    with _names(store) as (db, names):
        found = {}
        for row in names.branches.values():
            at = required(db, Checkpoint, row.checkpoint)
            found[row.name] = BranchState(row.name, at.seq, at.time * 1e-6)
        return found


def snapshots(store: Path | str | Readers) -> dict[str, SnapshotState]:
    """All snapshots of a store by name.

    Raises:
        InputError: As :func:`terrasim.store.store.open_store`.
        StoreCorrupt: If one is missing or damaged.
    """
    with _names(store) as (db, names):
        found = {}
        for row in names.snapshots.values():
            seq = required(db, Checkpoint, row.checkpoint).seq
            found[row.name] = SnapshotState(row.name, seq, row.branch, row.time * 1e-6)
        return found


@contextmanager
def _names(store: Path | str | Readers) -> Iterator[tuple[apsw.Connection, Names]]:
    if isinstance(store, Readers):
        with store.borrow() as db, one_state(db):
            yield db, read_names(db)
        return
    path = Path(store)
    require_file(path)
    readers = Readers(path, lambda: connect_reader(path))
    try:
        require_acknowledged(path)
        with readers.borrow() as db, one_state(db):
            if require_store(path, db) > 1:
                yield db, read_names(db)
            else:
                yield db, Names(State(1, b"", 1, 0, 0, 0, 0, 0), {}, {})
    finally:
        readers.close()


def find_branch(names: Names, name: str) -> BranchRow:
    """A branch that must be there.

    Raises:
        InputError: If it is not.
    """
    if name not in names.branches:
        raise InputError(
            f"there is no branch {name!r}; the store has {', '.join(names.branches) or 'none yet'}"
        )
    return names.branches[name]


def find_snapshot(names: Names, name: str) -> Snapshot:
    """A snapshot that must be there.

    Raises:
        InputError: If it is not.
    """
    if name not in names.snapshots:
        raise InputError(
            f"there is no snapshot {name!r}; the store has {', '.join(names.snapshots) or 'none'}"
        )
    return names.snapshots[name]


def check_name(name: str) -> None:
    """Refuse a name that no branch and no snapshot can have.

    Raises:
        InputError: If it is not 1 to 64 letters, digits, dots, dashes and underscores.
    """
    if not _NAME.fullmatch(name):
        raise InputError(
            "a name is 1 to 64 letters, digits, dots, dashes and underscores and begins with a "
            f"letter or a digit, got {name[:80]!r}"
        )


def no_names(path: Path) -> InputError:
    """What to say of a store that is too old for what is asked."""
    return InputError(
        f"{path} is of schema version 1 and has no branches or snapshots; "
        "it gets them when it is first opened for writing"
    )
