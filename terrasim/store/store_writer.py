"""The one who writes a new store: blocks in any order, then what is known of the whole."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

import apsw

from terrasim.counts import Counts
from terrasim.grid import Block, Grid
from terrasim.sources.source import BlockData, describe
from terrasim.store.codec import CODEC, pack
from terrasim.store.migrate import add_tables
from terrasim.store.readers import Readers
from terrasim.store.store import StoreSource
from terrasim.store.store_file import (
    APPLICATION_ID,
    SCHEMA,
    SCHEMA_VERSION,
    blob_hash,
    block_seal,
    meta_seal,
    require_sqlite,
)


class StoreWriter:
    """Fills an empty file, which is marked as half-built until ``finish``; a crash may ruin it."""

    def __init__(self, path: Path) -> None:
        """Write the tables into an empty file."""
        require_sqlite()
        self._path = path
        self._db = apsw.Connection(str(path.absolute()))
        # Nobody reads the file before it is whole and flushed: a journal would double the work.
        self._db.pragma("auto_vacuum", 2)
        self._db.pragma("journal_mode", "off")
        self._db.pragma("synchronous", "off")
        self._db.pragma("application_id", APPLICATION_ID)
        self._db.pragma("user_version", SCHEMA_VERSION)
        self._db.execute(SCHEMA).fetchall()
        add_tables(self._db)
        self._db.execute("INSERT INTO meta VALUES ('state', 'building')")
        self._db.execute("BEGIN")

    def add(self, key: Block, posts: Counts) -> BlockData:
        """Write one block; its error is 0 until it is set."""
        data = describe(posts, 0)
        blob = pack(data.posts)
        content = blob_hash(blob)
        sealed = block_seal(key, content, data.lowest, data.highest, 0)
        row = (*key, self._blob(content, blob), data.lowest, data.highest, 0, sealed)
        self._db.execute("INSERT INTO block VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)
        return data

    def set_error(self, key: Block, error: int) -> None:
        """Set the largest vertical distance [counts] of a block's surface from level 0's."""
        [(content, lowest, highest)] = self._db.execute(
            "SELECT blob.hash, lowest, highest FROM block JOIN blob ON blob.id = block.blob "
            "WHERE level = ? AND row = ? AND col = ?",
            tuple(key),
        ).fetchall()
        self._db.execute(
            "UPDATE block SET error = ?, seal = ? WHERE level = ? AND row = ? AND col = ?",
            (error, block_seal(key, content, lowest, highest, error), *key),
        )

    def written(self, grid: Grid) -> StoreSource:
        """What has been written so far as a source, for this thread alone."""
        meta = {"grid": asdict(grid), "synthetic": "", "provenance": {}, "summary": {}}
        return StoreSource(meta, Readers(self._path, lambda: self._db))

    def blobs(self) -> int:
        """How many different blocks there are."""
        [(count,)] = self._db.execute("SELECT count(*) FROM blob").fetchall()
        assert isinstance(count, int)
        return count

    def finish(
        self, grid: Grid, synthetic: str, provenance: object, summary: object, **more: object
    ) -> None:
        """Write what is known of the whole and mark the store as complete."""
        meta: dict[str, Any] = {
            "grid": asdict(grid),
            "synthetic": synthetic,
            "provenance": provenance,
            "summary": summary,
            **more,
        }
        rows = {key: json.dumps(value) for key, value in meta.items()} | {"state": "complete"}
        rows["seal"] = meta_seal(rows)
        self._db.executemany("INSERT OR REPLACE INTO meta VALUES (?, ?)", rows.items())
        self._db.execute("COMMIT")
        # From here on readers and one writer share the file.
        self._db.pragma("journal_mode", "wal")

    def close(self) -> None:
        """Let go of the file."""
        self._db.close(True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _blob(self, content: bytes, data: bytes) -> int:
        row = self._db.execute("SELECT id FROM blob WHERE hash = ?", (content,)).fetchone()
        if row is None:
            sql = "INSERT INTO blob (hash, codec, data) VALUES (?, ?, ?)"
            self._db.execute(sql, (content, CODEC, data))
            return self._db.last_insert_rowid()
        found: int = row[0]
        return found
