"""A copy of a store that is in use: never of its files, always through SQLite, and checked."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import apsw

from terrasim.errors import InputError
from terrasim.store.build import require_place, retire
from terrasim.store.codec import StoreCorrupt
from terrasim.store.names import one_state
from terrasim.store.noted import require_acknowledged
from terrasim.store.opening import read_meta, require_file, require_store
from terrasim.store.store_file import BUILDING, connect_reader, reading, require_sqlite, writing
from terrasim.store.unfinished import unfinished
from terrasim.store.verify import verify

Progress = Callable[[float, str], None]
"""Takes the fraction done and what is being done."""
_PAGES_AT_ONCE = 1000


def backup(
    path: str | Path,
    target: str | Path,
    *,
    replace: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Copy a store while it may be written: its state at one moment, journal and all.

    Args:
        path: The store.
        target: The copy. Nothing is there before it is whole, on the disk and found sound.
        replace: Put the copy in the place of a store that is there.
        progress: Called now and then.

    Returns:
        What :func:`terrasim.store.verify.verify` says of the copy.

    Raises:
        InputError: If there is no store, or nothing may be written at ``target``.
        RunError: If the disk is full or fails.
        StoreCorrupt: If the store is damaged; then nothing is at ``target``.
    """
    path, target = Path(path), Path(target)
    require_sqlite()
    require_file(path)
    if target.exists() and target.samefile(path):
        raise InputError(f"{target} is the store itself; choose another name")
    require_place(target, replace)
    require_acknowledged(path)
    with unfinished(target, BUILDING) as growing:
        _copy(path, growing, progress or _silent)
        found = verify(growing)
        if not found["sound"]:
            raise StoreCorrupt(f"the copy of {path} is not sound: {found['problems'][0]}")
        if target.exists():
            retire(target)
    return {**found, "store": str(target)}


def _copy(path: Path, growing: Path, tell: Progress) -> None:
    with reading(path):
        source = connect_reader(path)
    copy = apsw.Connection(str(growing.absolute()))
    try:
        with reading(path), one_state(source):
            # The first query fixes the state that is copied, however long it takes.
            require_store(path, source)
            read_meta(path, source)
            with writing(growing), copy.backup("main", source, "main") as pages:
                while not pages.done:
                    pages.step(_PAGES_AT_ONCE)
                    tell(1.0 - pages.remaining / max(pages.page_count, 1), "copying")
    finally:
        copy.close(True)
        source.close(True)


def _silent(fraction: float, message: str, /) -> None:
    pass
