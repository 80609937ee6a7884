"""What was done to a terrain, read from its store without the right to write."""

from __future__ import annotations

from pathlib import Path

from terrasim.errors import InputError
from terrasim.store.epochs import lineage
from terrasim.store.journal import JournalRow, newest_rows
from terrasim.store.names import MAIN, find_branch, one_state, read_names
from terrasim.store.opening import require_file, require_store
from terrasim.store.readers import Readers
from terrasim.store.store_file import connect_reader, reading


def history(path: str | Path, branch: str = MAIN, limit: int = 20) -> list[JournalRow]:
    """The newest rows of a branch's journal, newest first.

    Args:
        path: The store; somebody may be writing to it.
        branch: The branch.
        limit: Most rows.

    Raises:
        InputError: If there is no such store or branch, or the limit is negative.
        StoreCorrupt: If a row is not as it was written.
        RunError: If it cannot be read.
    """
    if limit < 0:
        raise InputError(f"limit must not be negative, got {limit}")
    path = Path(path)
    require_file(path)
    readers = Readers(path, lambda: connect_reader(path))
    found: list[JournalRow] = []
    try:
        with reading(path), readers.borrow() as db, one_state(db):
            if require_store(path, db) == 1:
                # Written before there was a journal.
                return []
            names = read_names(db)
            if branch == MAIN and MAIN not in names.branches:
                return []
            stretches = lineage(db, find_branch(names, branch).epoch)
        for epoch, until in stretches:
            left = limit - len(found)
            found += newest_rows(readers.fetch, epoch, until, left) if left else []
    finally:
        readers.close()
    return found
