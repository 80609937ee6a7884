"""The rows that say what a terrain has become: state, epochs, checkpoints, branches, snapshots.

An epoch is a stretch of a branch's journal. A reset or a fork begins a new one, which says up to
where the rows of its parent belong to its history; what the parent did after that is dropped. A
checkpoint names the tree of changed blocks (``tree.py``) after some row of its epoch.

Every row has a seal over all it says. The seals of branches and snapshots are added up in the state
row, so that one that is lost is missed. Checkpoints and epochs are missed by those who name them.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, fields
from typing import Any, ClassVar, Protocol, TypeVar

import apsw

from terrasim.store.codec import StoreCorrupt
from terrasim.store.store_file import REMEDY, seal

SCHEMA = """
CREATE TABLE state (
    id INTEGER PRIMARY KEY CHECK (id = 1),
    store BLOB NOT NULL,
    factor INTEGER NOT NULL,
    epoch INTEGER NOT NULL,
    seq INTEGER NOT NULL,
    epochs INTEGER NOT NULL,
    checkpoints INTEGER NOT NULL,
    names INTEGER NOT NULL,
    seal BLOB NOT NULL
);
CREATE TABLE epoch (
    id INTEGER PRIMARY KEY,
    parent INTEGER NOT NULL,
    cut INTEGER NOT NULL,
    time INTEGER NOT NULL,
    floor INTEGER NOT NULL,
    floor_chain BLOB NOT NULL,
    seal BLOB NOT NULL
);
CREATE TABLE checkpoint (
    id INTEGER PRIMARY KEY,
    epoch INTEGER NOT NULL,
    seq INTEGER NOT NULL,
    chain BLOB NOT NULL,
    root BLOB NOT NULL,
    detailed INTEGER NOT NULL,
    blocks INTEGER NOT NULL,
    time INTEGER NOT NULL,
    seal BLOB NOT NULL
);
CREATE INDEX checkpoint_place ON checkpoint (epoch, seq);
CREATE TABLE branch (
    name TEXT PRIMARY KEY,
    epoch INTEGER NOT NULL,
    checkpoint INTEGER NOT NULL,
    tail INTEGER NOT NULL,
    tail_chain BLOB NOT NULL,
    seal BLOB NOT NULL
) WITHOUT ROWID;
CREATE TABLE snapshot (
    name TEXT PRIMARY KEY,
    checkpoint INTEGER NOT NULL,
    branch TEXT NOT NULL,
    time INTEGER NOT NULL,
    seal BLOB NOT NULL
) WITHOUT ROWID;
CREATE TABLE journal (
    id INTEGER PRIMARY KEY,
    time INTEGER NOT NULL,
    idem TEXT,
    engine TEXT NOT NULL,
    summary TEXT NOT NULL,
    op BLOB NOT NULL,
    chain BLOB NOT NULL
);
CREATE TABLE idem (
    branch TEXT NOT NULL,
    key TEXT NOT NULL,
    seq INTEGER NOT NULL,
    op BLOB NOT NULL,
    time INTEGER NOT NULL,
    seal BLOB NOT NULL,
    PRIMARY KEY (branch, key)
) WITHOUT ROWID;
"""


class Record(Protocol):
    """A frozen dataclass whose fields are a table's columns but the seal, the key first."""

    __dataclass_fields__: ClassVar[dict[str, Any]]
    table: ClassVar[str]


@dataclass(frozen=True)
class State:
    """What holds for the whole store; there is one."""

    table: ClassVar[str] = "state"
    id: int
    """1."""
    store: bytes
    """Random bytes that tell this store from any other."""
    factor: int
    """Detail posts to a base post; 1 if there is no detail."""
    epoch: int
    """The epoch that is written to, or was last."""
    seq: int
    """No journal row had a higher number when this was written; later ones are in ``epoch``."""
    epochs: int
    """Highest number of an epoch so far."""
    checkpoints: int
    """Highest number of a checkpoint so far."""
    names: int
    """Seals of all branches and snapshots, combined by exclusive or."""


@dataclass(frozen=True)
class Epoch:
    """A stretch of a branch's journal."""

    table: ClassVar[str] = "epoch"
    id: int
    """Its number, from 1 on."""
    parent: int
    """The epoch that it goes on from; 0 if from the terrain as imported."""
    cut: int
    """Rows of the parent up to this one belong to its history."""
    time: int
    """When it began [microseconds since 1970 UTC]."""
    floor: int
    """Its rows come after this one; those before were trimmed."""
    floor_chain: bytes
    """What its first row is chained to."""


@dataclass(frozen=True)
class Checkpoint:
    """The ground after some journal row, as images of all changed blocks."""

    table: ClassVar[str] = "checkpoint"
    id: int
    """Its number, from 1 on."""
    epoch: int
    """The epoch that it is in."""
    seq: int
    """What the journal's rows up to this one did is in the images."""
    chain: bytes
    """Chain hash of the epoch's newest row up to there."""
    root: bytes
    """Content address of the tree of changed blocks; empty if there is none."""
    detailed: int
    """1 if there is detail in it."""
    blocks: int
    """How many blocks it changed."""
    time: int
    """When it was written [microseconds since 1970 UTC]."""


@dataclass(frozen=True)
class BranchRow:
    """A named line of states."""

    table: ClassVar[str] = "branch"
    name: str
    """Its name."""
    epoch: int
    """The epoch it is in."""
    checkpoint: int
    """Its newest checkpoint."""
    tail: int
    """A journal row of its epoch that must be there, or the epoch's floor."""
    tail_chain: bytes
    """That row's chain hash."""


@dataclass(frozen=True)
class Snapshot:
    """A named state."""

    table: ClassVar[str] = "snapshot"
    name: str
    """Its name."""
    checkpoint: int
    """Number of the checkpoint that it names."""
    branch: str
    """The branch on which it was taken."""
    time: int
    """When it was taken [microseconds since 1970 UTC]."""


@dataclass(frozen=True)
class Idem:
    """What was done under a key of a caller's."""

    table: ClassVar[str] = "idem"
    branch: str
    """Branch on which it was done."""
    key: str
    """The caller's key."""
    seq: int
    """Its number in the journal."""
    op: bytes
    """Hash of the operation."""
    time: int
    """When it was done [microseconds since 1970 UTC]."""


R = TypeVar("R", State, Epoch, Checkpoint, BranchRow, Snapshot, Idem)


def seal_of(row: Record) -> bytes:
    """The seal over all a row says."""
    return seal(row.table, *astuple(row))


def names_with(names: int, *rows: BranchRow | Snapshot) -> int:
    """Put rows into the combined seals, or take out those that are in."""
    for row in rows:
        # The sign bit stays clear: SQLite's integers have one.
        names ^= int.from_bytes(seal_of(row), "little") >> 1
    return names


def read(db: apsw.Connection, kind: type[R], *key: object) -> R | None:
    """One row by its key, None if there is none.

    Raises:
        StoreCorrupt: If it is not the one that was written.
    """
    columns = _columns(kind)
    where = " AND ".join(f"{name} = ?" for name in columns[: len(key)])
    sql = f"SELECT {', '.join(columns)}, seal FROM {kind.table} WHERE {where}"
    found = db.execute(sql, key).fetchone()
    return None if found is None else checked(kind, found)


def read_all(db: apsw.Connection, kind: type[R]) -> list[R]:
    """All rows of a table, by key.

    Raises:
        StoreCorrupt: If one is not as it was written.
    """
    columns = ", ".join(_columns(kind))
    found = db.execute(f"SELECT {columns}, seal FROM {kind.table} ORDER BY 1").fetchall()
    return [checked(kind, row) for row in found]


def required(db: apsw.Connection, kind: type[R], *key: object) -> R:
    """One row that must be there.

    Raises:
        StoreCorrupt: If it is not.
    """
    found = read(db, kind, *key)
    if found is None:
        raise StoreCorrupt(f"{kind.table} {key[-1]} is missing; {REMEDY}")
    return found


def checked(kind: type[R], found: tuple[Any, ...]) -> R:
    """A row as it came from its table, its seal last.

    Raises:
        StoreCorrupt: If the seal does not fit.
    """
    row = kind(*found[:-1])
    if seal_of(row) != found[-1]:
        raise StoreCorrupt(f"{kind.table} {found[0]} is not as it was written; {REMEDY}")
    return row


def write(db: apsw.Connection, *rows: Record) -> None:
    """Put rows in the place of those with the same key, if there are any."""
    for row in rows:
        said = (*astuple(row), seal_of(row))
        marks = ", ".join("?" * len(said))
        db.execute(f"INSERT OR REPLACE INTO {row.table} VALUES ({marks})", said)


def _columns(kind: type[R]) -> list[str]:
    return [field.name for field in fields(kind)]
