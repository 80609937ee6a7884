"""Connections that read, lent to one thread at a time for one query."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import apsw

from terrasim.store.store_file import reading


class Readers:
    """Any number of threads may read at once: each borrows a connection for the query alone."""

    def __init__(self, path: Path, connect: Callable[[], apsw.Connection]) -> None:
        """Begin without a connection; one is opened when it is needed."""
        self.path = path
        """The file."""
        self._connect = connect
        self._idle: deque[apsw.Connection] = deque()

    @contextmanager
    def borrow(self) -> Iterator[apsw.Connection]:
        """A connection for a while.

        Raises:
            RunError: If the file is locked or the disk fails.
            StoreCorrupt: If SQLite says that the file is damaged.
        """
        with reading(self.path):
            try:
                connection = self._idle.pop()
            except IndexError:
                connection = self._connect()
            try:
                yield connection
            finally:
                self._idle.append(connection)

    def fetch(self, sql: str, bindings: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
        """All rows of a query.

        Raises:
            RunError: As ``borrow``.
            StoreCorrupt: As ``borrow``.
        """
        with self.borrow() as connection:
            found: list[Any] = connection.execute(sql, bindings).fetchall()
            return found

    def close(self) -> None:
        """Close the connections that are idle. Reading on opens new ones."""
        while self._idle:
            self._idle.popleft().close()
