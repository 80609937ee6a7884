"""Opening a store's file: is it one, is it whole, and what its meta rows say."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import apsw

from terrasim.errors import InputError
from terrasim.store.codec import StoreCorrupt
from terrasim.store.store_file import APPLICATION_ID, BUILDING, REMEDY, SCHEMA_VERSION, meta_seal
from terrasim.store.unfinished import beside


def require_store(path: Path, connection: apsw.Connection) -> int:
    """Refuse a file that is no store, or one of a newer schema version.

    Returns:
        The file's schema version.

    Raises:
        InputError: In either case.
    """
    try:
        application = connection.pragma("application_id")
    except apsw.NotADBError:
        application = None
    if application != APPLICATION_ID:
        raise InputError(f"{path} is no terrasim store; make one with terrasim import")
    version = connection.pragma("user_version")
    if not isinstance(version, int) or not 1 <= version <= SCHEMA_VERSION:
        raise InputError(
            f"{path} has schema version {version}, this release reads 1 to {SCHEMA_VERSION}; "
            f"use the release that wrote it"
        )
    return version


def require_length(path: Path, connection: apsw.Connection) -> None:
    """Refuse a file that is cut short.

    Raises:
        StoreCorrupt: If it is.
    """
    # What stands in the write-ahead log need not be in the file yet.
    expected = connection.pragma("page_count") * connection.pragma("page_size")
    log = beside(path, "-wal")
    size = path.stat().st_size
    if size < expected and not (log.exists() and log.stat().st_size):
        raise StoreCorrupt(f"{path} is cut short: {size} of {expected} bytes; {REMEDY}")


def require_file(path: Path) -> None:
    """Refuse a path at which there can be no store.

    Raises:
        InputError: If there is none.
    """
    # It is not opened here: closing it would take away the locks of this process's connections.
    if path.is_file():
        return
    if path.exists():
        raise InputError(f"{path} is no file; name a terrasim store")
    if beside(path, BUILDING).exists():
        raise InputError(f"{path} is half-built; run the import again")
    raise InputError(f"there is no store at {path}; make one with terrasim import")


def read_meta(path: Path, connection: apsw.Connection) -> dict[str, Any]:
    """What the meta rows say.

    Raises:
        InputError: If the store is half-built.
        StoreCorrupt: If they are damaged.
    """
    found: list[Any] = connection.execute("SELECT key, value FROM meta").fetchall()
    rows = dict(found)
    if rows.get("state") == "building":
        raise InputError(f"{path} is half-built; run the import again")
    if rows.pop("seal", None) != meta_seal(rows) or rows.pop("state") != "complete":
        raise StoreCorrupt(f"{path}: the meta rows are damaged; {REMEDY}")
    return {key: json.loads(value) for key, value in rows.items()}
