"""A store as a file: its tables, its hashes, who may open it, and what SQLite's errors mean.

What is done to the terrain later has its own tables: see ``records.py``.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path

import apsw

from terrasim.errors import InputError, RunError
from terrasim.grid import Block
from terrasim.store.codec import StoreCorrupt
from terrasim.store.unfinished import beside

APPLICATION_ID = 0x54525349
"""Tells a store from any other SQLite file: "TRSI" at byte 68."""
SCHEMA_VERSION = 2
"""A file of a newer version is refused. Version 1 has no journal, branches and snapshots."""
SCHEMA = """
CREATE TABLE meta (
    key TEXT PRIMARY KEY,
    value TEXT NOT NULL
) WITHOUT ROWID;
CREATE TABLE blob (
    id INTEGER PRIMARY KEY,
    hash BLOB NOT NULL UNIQUE,
    codec INTEGER NOT NULL,
    data BLOB NOT NULL
);
CREATE TABLE block (
    level INTEGER NOT NULL,
    row INTEGER NOT NULL,
    col INTEGER NOT NULL,
    blob INTEGER NOT NULL REFERENCES blob (id),
    lowest INTEGER NOT NULL,
    highest INTEGER NOT NULL,
    error INTEGER NOT NULL,
    seal BLOB NOT NULL,
    PRIMARY KEY (level, row, col)
) WITHOUT ROWID;
"""
BUILDING = ".building"
"""Ends the name of a store whose import has not ended."""
REMEDY = "restore the file from a copy or import the terrain again"
_OLDEST_SQLITE = (3, 51, 3)


def require_sqlite() -> None:
    """Refuse an SQLite that can lose a write-ahead log.

    Raises:
        RunError: If the library is older than 3.51.3.
    """
    version = apsw.sqlite_lib_version()
    if tuple(map(int, version.split("."))) < _OLDEST_SQLITE:
        raise RunError(
            f"SQLite {version} can lose what was written (its WAL-reset bug): "
            f"a store needs 3.51.3 or newer; upgrade apsw"
        )


def blob_hash(data: bytes) -> bytes:
    """Content address of a blob, 16 bytes."""
    return blake2b(data, digest_size=16).digest()


def block_seal(
    key: Block, content: object, lowest: object, highest: object, error: object
) -> bytes:
    """Eight bytes that change with anything a block's row says, and with its blob's hash."""
    said = repr((tuple(key), content, lowest, highest, error)).encode()
    return blake2b(said, digest_size=8).digest()


def meta_seal(rows: dict[str, str]) -> str:
    """A hash over all meta rows but the seal itself."""
    return blake2b(repr(sorted(rows.items())).encode(), digest_size=16).hexdigest()


def seal(*said: object) -> bytes:
    """Eight bytes that change with anything that is said."""
    return blake2b(repr(said).encode(), digest_size=8).digest()


def connect_reader(path: Path, vfs: str = "") -> apsw.Connection:
    """A connection that only reads. The file must exist.

    Args:
        path: The file.
        vfs: Name of the SQLite VFS to go through; empty for the system's own.
    """
    path = path.absolute()
    writable = os.access(path, os.W_OK) and os.access(path.parent, os.W_OK)
    if not writable and not beside(path, "-wal").exists():
        # Nobody here can write the file, nor those beside it through which SQLite would tell us.
        name = path.as_uri() + "?immutable=1"
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        return apsw.Connection(name, flags, vfs=vfs or None)
    # A connection without the right to write leaves files behind when it closes.
    connection = apsw.Connection(str(path), apsw.SQLITE_OPEN_READWRITE, vfs=vfs or None)
    connection.set_busy_timeout(5000)
    connection.pragma("query_only", True)
    return connection


@contextmanager
def reading(path: Path) -> Iterator[None]:
    """Turn what SQLite says while reading into one line.

    Raises:
        RunError: If the file is locked or the disk fails.
        StoreCorrupt: Otherwise: what was sound when written gives no complaint.
    """
    try:
        yield
    except (apsw.BusyError, apsw.LockedError):
        raise RunError(f"{path} is locked by another process; try again later") from None
    except (
        apsw.IOError,
        apsw.CantOpenError,
        apsw.NoMemError,
        apsw.PermissionsError,
        apsw.ReadOnlyError,
    ) as error:
        raise RunError(f"{path} cannot be read: {error}") from None
    except (apsw.Error, UnicodeDecodeError) as error:
        raise StoreCorrupt(f"{path} is damaged ({error}); {REMEDY}") from None


@contextmanager
def writing(path: Path) -> Iterator[None]:
    """Turn what SQLite and the system say while writing into one line.

    Raises:
        RunError: If the disk is full or fails, or the file is in use.
        StoreCorrupt: If what is there is damaged.
        InputError: If nothing may be written at the path.
    """
    try:
        yield
    except apsw.FullError:
        raise RunError(f"{path} cannot be written: the disk is full; make room") from None
    except (apsw.CorruptError, apsw.NotADBError) as error:
        raise StoreCorrupt(f"{path} is damaged ({error}); {REMEDY}") from None
    except (apsw.BusyError, apsw.LockedError):
        raise RunError(f"{path} is in use by another process; try again later") from None
    except (apsw.CantOpenError, apsw.PermissionsError, apsw.ReadOnlyError) as error:
        raise InputError(f"{path} cannot be written ({error}); choose another path") from None
    except apsw.Error as error:
        raise RunError(f"{path} cannot be written: {error}") from None
