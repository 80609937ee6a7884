"""Callers' keys: the same operation under the same key is written once."""

from __future__ import annotations

import apsw

from terrasim.errors import InputError
from terrasim.store import records
from terrasim.store.journal import NewRow, op_hash
from terrasim.store.records import Idem


def earlier(db: apsw.Connection, branch: str, row: NewRow) -> int | None:
    """The number under which the same was written on a branch before; None if it was not.

    Raises:
        InputError: If the key stands for another operation.
    """
    if row.idem is None:
        return None
    found = records.read(db, Idem, branch, row.idem)
    if found is None:
        return None
    if found.op != op_hash(row.op):
        raise InputError(
            f"the key {row.idem!r} stands for another operation, number {found.seq}; use a new key"
        )
    return found.seq


def remember(db: apsw.Connection, branch: str, row: NewRow, seq: int, time: int) -> None:
    """Note what was written under a key, in the transaction that writes it."""
    if row.idem is not None:
        records.write(db, Idem(branch, row.idem, seq, op_hash(row.op), time))
