"""From an older schema version to this one, in place and in one transaction."""

from __future__ import annotations

import os
from dataclasses import replace

import apsw

from terrasim.store import records
from terrasim.store.records import State
from terrasim.store.store_file import SCHEMA_VERSION

_UNNAMED = bytes(16)


def migrate(db: apsw.Connection) -> bool:
    """Bring a store up to this version; a crash leaves it as it was or as it will be.

    A store that is first written gets what tells it from any other, which an import does not give:
    two imports of the same ground are the same file.

    Returns:
        Whether there was something to do.
    """
    older = db.pragma("user_version") != SCHEMA_VERSION
    if not older and records.required(db, State, 1).store != _UNNAMED:
        return False
    db.execute("BEGIN IMMEDIATE")
    try:
        if older:
            add_tables(db)
            db.pragma("user_version", SCHEMA_VERSION)
        state = records.required(db, State, 1)
        records.write(db, replace(state, store=os.urandom(len(_UNNAMED))))
        db.execute("COMMIT")
    except BaseException:
        if db.in_transaction:
            db.execute("ROLLBACK")
        raise
    return True


def add_tables(db: apsw.Connection) -> None:
    """What version 2 has more than version 1: nothing that is there is touched."""
    db.execute(records.SCHEMA).fetchall()
    records.write(
        db, State(1, _UNNAMED, factor=1, epoch=0, seq=0, epochs=0, checkpoints=0, names=0)
    )
