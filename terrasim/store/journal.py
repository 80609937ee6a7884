"""The journal: what was done, one row each, every row chained by hash to the one before it.

A row is on the disk when ``append`` returns: that is the acknowledgement. Operations are opaque
bytes here. Numbers grow over the whole store, rows of one epoch lie together: a row's id in the
table is its epoch times 2^40 plus its number.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from hashlib import blake2b
from typing import Any, NamedTuple, Protocol

import apsw

from terrasim.errors import InputError
from terrasim.store.codec import StoreCorrupt
from terrasim.store.records import Epoch
from terrasim.store.store_file import REMEDY

MAX_OP_BYTES = 1 << 28
"""Largest operation [bytes]."""
MAX_KEY = 255
"""Longest key of a caller's [characters]."""
_SEQ_BITS = 40
_AT_ONCE = 256
_COLUMNS = "id, time, idem, engine, summary, op, chain"


@dataclass(frozen=True)
class NewRow:
    """Something to be written into the journal."""

    op: bytes
    """What is done, opaque here."""
    idem: str | None = None
    """The caller's key: the same operation under the same key is written once."""
    engine: str = ""
    """Who does it, so that doing it again elsewhere can be told."""
    summary: str = ""
    """What is done, in a few words for a list."""


@dataclass(frozen=True)
class JournalRow:
    """What the journal says was done."""

    seq: int
    """Its number: later is higher."""
    time: float
    """When it was written [s since 1970 UTC]."""
    op: bytes
    """What was done, opaque here."""
    idem: str | None
    """The caller's key."""
    engine: str
    """Who did it."""
    summary: str
    """What was done, in a few words."""


class Tail(NamedTuple):
    """The newest row of an epoch, or where its first will be chained."""

    epoch: int
    seq: int
    chain: bytes


class Fetch(Protocol):
    """Runs a query to its end and returns all rows."""

    def __call__(self, sql: str, bindings: tuple[Any, ...], /) -> list[tuple[Any, ...]]:
        """All rows of a query."""
        ...


def row_id(epoch: int, seq: int) -> int:
    """Where a row lies in the table."""
    return (epoch << _SEQ_BITS) + seq


def first_chain(epoch: int, parent: int, cut: int) -> bytes:
    """What an epoch's first row is chained to."""
    return blake2b(repr(("epoch", epoch, parent, cut)).encode(), digest_size=16).digest()


def floor_of(epoch: Epoch) -> Tail:
    """Where an epoch's oldest row is chained."""
    return Tail(epoch.id, epoch.floor, epoch.floor_chain)


def check_new(row: NewRow) -> None:
    """Refuse what the journal does not hold.

    Raises:
        InputError: If the operation is too large, or a word no text or too long.
    """
    if len(row.op) > MAX_OP_BYTES:
        raise InputError(f"an operation has at most {MAX_OP_BYTES} bytes, got {len(row.op)}")
    idem: object = "" if row.idem is None else row.idem
    words: tuple[tuple[str, object], ...]
    words = (("engine", row.engine), ("idem", idem), ("summary", row.summary))
    for name, text in words:
        if not isinstance(text, str) or not text.isprintable():
            raise InputError(f"{name} must be printable text, got {str(text)[:40]!r}")
    if row.idem is not None and not 0 < len(row.idem) <= MAX_KEY:
        raise InputError(f"idem must have 1 to {MAX_KEY} characters, got {len(row.idem)}")


def op_hash(op: bytes) -> bytes:
    """Sixteen bytes that stand for an operation."""
    return blake2b(op, digest_size=16).digest()


def write_row(db: apsw.Connection, tail: Tail, seq: int, time: int, row: NewRow) -> Tail:
    """Write a row behind an epoch's newest; returns the new tail."""
    said = (time, row.idem, row.engine, row.summary)
    chain = _chain(tail.chain, tail.epoch, seq, said, row.op)
    db.execute(
        "INSERT INTO journal VALUES (?, ?, ?, ?, ?, ?, ?)",
        (row_id(tail.epoch, seq), *said, row.op, chain),
    )
    return Tail(tail.epoch, seq, chain)


def read_rows(
    fetch: Fetch, tail: Tail, until: int | None = None
) -> Iterator[tuple[JournalRow, Tail]]:
    """Rows of an epoch behind a place whose chain hash is known, oldest first, each checked.

    No query stays open between two rows.

    Args:
        fetch: Runs a query.
        tail: The place.
        until: Number of the last row that is wanted; None for all.

    Raises:
        StoreCorrupt: If a row is not as it was written, or one before it is missing.
    """
    last = row_id(tail.epoch + 1, -1) if until is None else row_id(tail.epoch, until)
    while True:
        sql = f"SELECT {_COLUMNS} FROM journal WHERE id > ? AND id <= ? ORDER BY id LIMIT ?"
        found = fetch(sql, (row_id(tail.epoch, tail.seq), last, _AT_ONCE))
        for row in found:
            tail = _checked(tail, row)
            yield _row(row, tail.seq), tail
        if len(found) < _AT_ONCE:
            return


def chain_at(fetch: Fetch, epoch: Epoch, seq: int) -> Tail:
    """The newest row of an epoch up to a number, as it says itself; the floor if there is none."""
    if seq > epoch.floor:
        sql = "SELECT id, chain FROM journal WHERE id > ? AND id <= ? ORDER BY id DESC LIMIT 1"
        found = fetch(sql, (row_id(epoch.id, epoch.floor), row_id(epoch.id, seq)))
        if found:
            return Tail(epoch.id, found[0][0] - row_id(epoch.id, 0), found[0][1])
    return floor_of(epoch)


def newest_rows(fetch: Fetch, epoch: Epoch, until: int, least: int, count: int) -> list[JournalRow]:
    """The newest rows of an epoch up to a number, newest first, each checked, without operations.

    Args:
        fetch: Runs a query.
        epoch: The epoch.
        until: Number of the last row that is wanted.
        least: A row of this number must be there, if the journal goes back that far.
        count: At most so many.

    Raises:
        StoreCorrupt: If a row is not as it was written, or one between them is missing.
    """
    ids = fetch(
        "SELECT id FROM journal WHERE id > ? AND id <= ? ORDER BY id DESC LIMIT ?",
        (row_id(epoch.id, epoch.floor), row_id(epoch.id, until), count),
    )
    if count:
        require_row(ids[0][0] - row_id(epoch.id, 0) if ids else epoch.floor, least)
    if not ids:
        return []
    tail = chain_at(fetch, epoch, ids[-1][0] - row_id(epoch.id, 0) - 1)
    return [row for row, _ in read_rows(fetch, tail, until)][::-1]


def require_row(newest: int, least: int, first: int = 0) -> None:
    """Refuse a journal whose newest row is older than one that must be there and is asked for.

    Raises:
        StoreCorrupt: If it is.
    """
    if newest < least and first <= least:
        raise StoreCorrupt(f"journal row {least} is missing; {REMEDY}")


def _checked(tail: Tail, row: tuple[Any, ...]) -> Tail:
    place, time, idem, engine, summary, op, chain = row
    seq = place - row_id(tail.epoch, 0)
    if _chain(tail.chain, tail.epoch, seq, (time, idem, engine, summary), op) != chain:
        raise StoreCorrupt(
            f"journal row {seq} is not as it was written, or one before it is missing; {REMEDY}"
        )
    return Tail(tail.epoch, seq, chain)


def _row(row: tuple[Any, ...], seq: int) -> JournalRow:
    _, time, idem, engine, summary, op, _ = row
    return JournalRow(seq, time * 1e-6, op, idem, engine, summary)


def _chain(
    before: bytes, epoch: int, seq: int, said: tuple[int, str | None, str, str], op: object
) -> bytes:
    if not isinstance(op, bytes):
        return b""
    made = blake2b(before, digest_size=16)
    made.update(repr((epoch, seq, said, len(op))).encode())
    made.update(op)
    return made.digest()
