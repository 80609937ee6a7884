"""Is everything in a store that should be, and is it what was written?"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import apsw

from terrasim.grid import Grid
from terrasim.store.formula import same_source
from terrasim.store.names import one_state
from terrasim.store.noted import require_acknowledged
from terrasim.store.opening import read_meta, require_file, require_length, require_store
from terrasim.store.store_file import block_seal, connect_reader, reading, require_sqlite
from terrasim.store.verify_blobs import Blobs, Findings
from terrasim.store.verify_history import check_history

_SHOWN = 100


def verify(path: str | Path) -> dict[str, Any]:
    """Check all of a store: SQLite's own structure, every hash, seal, chain and reference.

    It may be in use meanwhile; what is checked is its state at one moment.

    Returns:
        ``sound``, the ``problems`` in words, and how much of each kind was checked, ready for JSON.

    Raises:
        InputError: If there is no store, or a newer one.
        RunError: If it cannot be read.
    """
    path = Path(path)
    require_sqlite()
    require_file(path)
    found = Findings()
    found.check(lambda: require_acknowledged(path))
    with reading(path):
        db = connect_reader(path)
    if found.problems:
        # What is left of a damaged log stays where it is.
        db.config(apsw.SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, 1)
    try:
        found.check(lambda: _all(path, db, found))
    finally:
        db.close(True)
    return {
        "store": str(path),
        "sound": not found.problems,
        "problems": found.problems[:_SHOWN],
        **found.counts,
    }


def _all(path: Path, db: apsw.Connection, found: Findings) -> None:
    with reading(path):
        version = require_store(path, db)
        with one_state(db):
            found.check(lambda: require_length(path, db))
            said = [row[0] for row in db.execute("PRAGMA integrity_check(20)").fetchall()]
            found.problems += [f"SQLite: {one}" for one in said if one != "ok"]
            blobs = Blobs(db, found)
            meta = read_meta(path, db)
            found.check(lambda: _imported(db, found, meta, blobs))
            if version > 1:
                check_history(db, found, Grid(**meta["grid"]), blobs)


def _imported(db: apsw.Connection, found: Findings, meta: dict[str, Any], blobs: Blobs) -> None:
    """The blocks of the import: all there, sealed, their blobs there."""
    sql = "SELECT level, row, col, blob, lowest, highest, error, seal FROM block"
    seen = 0
    for level, row, col, blob, *numbers, sealed in db.execute(sql):
        key: Any = (level, row, col)
        seen += 1
        name = blobs.hash_of.get(blob)
        if name is None:
            found.problems.append(f"block {key} has no sound blob")
        elif block_seal(key, name, *numbers) != sealed:
            found.problems.append(f"block {key} is not the one that was written")
        else:
            blobs.used.add(name)
    found.counts["blocks"] = seen
    if "formula" in meta:
        same_source(meta["formula"])
        return
    grid = Grid(**meta["grid"])
    spans = [grid.blocks(level) for level in range(grid.levels)]
    wanted = sum((one.row1 - one.row0) * (one.col1 - one.col0) for one in spans)
    if seen != wanted:
        found.problems.append(f"there are {seen} blocks, the terrain has {wanted}")
