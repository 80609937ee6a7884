"""What was done on a branch: its own epoch's rows and those of the epochs it goes on from."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from terrasim.errors import InputError
from terrasim.store.epochs import Stretch, lineage
from terrasim.store.journal import JournalRow, chain_at, newest_rows, read_rows, require_row
from terrasim.store.names import MAIN, find_branch, no_names, one_state, read_names
from terrasim.store.noted import require_acknowledged
from terrasim.store.opening import require_file, require_store
from terrasim.store.readers import Readers
from terrasim.store.records import BranchRow
from terrasim.store.store_file import connect_reader

_MOST = 2**63 - 1
"""SQLite counts no further."""


def history(path: str | Path, branch: str = MAIN, limit: int = 100) -> list[JournalRow]:
    """The newest operations of a branch, newest first; the store may be in use.

    Raises:
        InputError: If there is no such store or branch, or the limit is negative.
        RunError: If it cannot be read.
        StoreCorrupt: If a row is not as it was written.
    """
    path = Path(path)
    _check_limit(limit)
    require_file(path)
    require_acknowledged(path)
    readers = Readers(path, lambda: connect_reader(path))
    try:
        with readers.borrow() as db:
            if require_store(path, db) == 1:
                raise no_names(path)
            with one_state(db):
                names = read_names(db)
        if branch == MAIN and MAIN not in names.branches:
            return []
        return newest_first(readers, find_branch(names, branch), limit)
    finally:
        readers.close()


def newest_first(readers: Readers, branch: BranchRow, limit: int) -> list[JournalRow]:
    """The newest rows of a branch's history, newest first.

    Raises:
        InputError: If the limit is negative.
        StoreCorrupt: If a row is not as it was written.
    """
    _check_limit(limit)
    found: list[JournalRow] = []
    for (one, until), least in _stretches(readers, branch):
        if len(found) < limit:
            most = min(limit - len(found), _MOST)
            found += newest_rows(readers.fetch, one, until, least, most)
    return found


def oldest_first(readers: Readers, branch: BranchRow, first: int) -> Iterator[JournalRow]:
    """Rows of a branch's history from a number on, oldest first, as far as they were not trimmed.

    Raises:
        StoreCorrupt: If a row is not as it was written, or one that must be there is missing.
    """
    for (one, until), least in reversed(_stretches(readers, branch)):
        if until >= first:
            tail = chain_at(readers.fetch, one, first - 1)
            for row, after in read_rows(readers.fetch, tail, until):
                tail = after
                yield row
            require_row(tail.seq, least, first)


def _check_limit(limit: int) -> None:
    if limit < 0:
        raise InputError(f"limit must not be negative, got {limit}; give how many to list at most")


def _stretches(readers: Readers, branch: BranchRow) -> list[tuple[Stretch, int]]:
    """Where a history lies, newest first, each with the number of a row that must be there."""
    with readers.borrow() as db, one_state(db):
        found = lineage(db, branch.epoch)
    # An older epoch ends at the checkpoint from which the next one went on.
    return [(one, branch.tail if one.epoch.id == branch.epoch else one.until) for one in found]
