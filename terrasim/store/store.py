"""A store: one SQLite file that holds a terrain's blocks of every level.

Blocks point to content-addressed blobs, so that equal blocks are kept once. Nothing is believed on
the way back: a blob has its hash, a block's row a seal over all it says, and so do the meta rows.
A read is right or raises ``StoreCorrupt``.
"""

from __future__ import annotations

import json
import threading
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, Self

import apsw
import numpy as np

from terrasim.counts import HOLE, Counts, to_metres
from terrasim.errors import InputError
from terrasim.grid import Block, Grid, Indices
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT
from terrasim.sources.source import BlockData
from terrasim.store.codec import StoreCorrupt, unpack
from terrasim.store.store_file import (
    APPLICATION_ID,
    BUILDING,
    REMEDY,
    SCHEMA_VERSION,
    blob_hash,
    block_seal,
    connect_reader,
    meta_seal,
    reading,
    require_sqlite,
)
from terrasim.store.unfinished import beside

__all__ = ["StoreCorrupt", "StoreSource", "info", "open_store"]

_RECENT_BLOCKS = 64
_BLOCK_SQL = (
    "SELECT block.lowest, block.highest, block.error, block.seal, blob.hash, blob.data "
    "FROM block JOIN blob ON blob.id = block.blob "
    "WHERE block.level = ? AND block.row = ? AND block.col = ?"
)


class StoreSource:
    """A store's heights, read block by block as they are asked for.

    Any number of threads may read at once: each borrows a connection for the query alone, and
    checks and decodes what came by itself.
    """

    def __init__(
        self, path: Path, meta: dict[str, Any], connect: Callable[[], apsw.Connection]
    ) -> None:
        """Take what the meta rows said; ``open_store`` does that."""
        self.path = path
        """The file."""
        self.provenance: dict[str, object] = meta["provenance"]
        """Where the heights come from, ready for JSON."""
        self.summary: dict[str, Any] = meta["summary"]
        """What the build found: range, holes, blocks, errors a level."""
        self._grid = Grid(**meta["grid"])
        self._synthetic = str(meta["synthetic"])
        self._connect = connect
        self._idle: deque[apsw.Connection] = deque()
        self._recent: OrderedDict[Block, Counts] = OrderedDict()
        self._lock = threading.Lock()

    @property
    def grid(self) -> Grid:
        """Placement of the level-0 posts."""
        return self._grid

    @property
    def synthetic(self) -> str:
        """What part of the heights is invented, in a few words; empty if none is."""
        return self._synthetic

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        """Heights of the level's posts at the outer product of two index vectors.

        See :meth:`terrasim.sources.source.Source.posts`. The blocks decoded last are kept.

        Raises:
            InputError: If the terrain has no such level.
            StoreCorrupt: If a block is missing or damaged.
        """
        self._check_level(level)
        span = self._grid.posts(level)
        # The outermost posts stand on the edge or beyond it: all further out are like them.
        row = np.clip(np.asarray(rows, dtype=np.int64), span.row0, span.row1 - 1)
        col = np.clip(np.asarray(cols, dtype=np.int64), span.col0, span.col1 - 1)
        out = np.empty((row.size, col.size), dtype=np.int32)
        by_col = list(_by_block(col))
        for block_row, at_row in _by_block(row):
            inside = row[at_row] & (BLOCK - 1)
            for block_col, at_col in by_col:
                posts = self._decoded(Block(level, block_row, block_col)).take(inside, axis=0)
                _put(out, at_row, at_col, posts.take(col[at_col] & (BLOCK - 1), axis=1))
        return out

    def block(self, key: Block) -> BlockData:
        """One block, ready for the pool: read, checked and decoded anew each time.

        Raises:
            InputError: If the terrain has no such block.
            StoreCorrupt: If it is missing or damaged.
        """
        self._check_level(key.level)
        span = self._grid.blocks(key.level)
        if not (span.row0 <= key.row < span.row1 and span.col0 <= key.col < span.col1):
            raise InputError(
                f"level {key.level} has blocks ({span.row0}, {span.col0}) to "
                f"({span.row1 - 1}, {span.col1 - 1}), got ({key.row}, {key.col})"
            )
        with reading(self.path):
            row = self._fetch(key)
        return self._checked(key, row)

    def close(self) -> None:
        """Close the connections that are idle. Reading on opens new ones."""
        while self._idle:
            self._idle.popleft().close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_level(self, level: int) -> None:
        if not 0 <= level <= self._grid.top:
            raise InputError(f"level must be 0 to {self._grid.top}, got {level}")

    def _fetch(self, key: Block) -> tuple[Any, ...] | None:
        try:
            connection = self._idle.pop()
        except IndexError:
            connection = self._connect()
        try:
            row: tuple[Any, ...] | None = connection.execute(_BLOCK_SQL, tuple(key)).fetchone()
            return row
        finally:
            self._idle.append(connection)

    def _checked(self, key: Block, row: tuple[Any, ...] | None) -> BlockData:
        name = f"{self.path}: block ({key.row}, {key.col}) of level {key.level}"
        if row is None:
            raise StoreCorrupt(f"{name} is missing; {REMEDY}")
        lowest, highest, error, sealed, content, data = row
        if block_seal(key, content, lowest, highest, error) != sealed:
            raise StoreCorrupt(f"{name} is not the one that was written; {REMEDY}")
        if not isinstance(data, bytes) or blob_hash(data) != content:
            raise StoreCorrupt(f"{name} is damaged; {REMEDY}")
        posts = unpack(data)
        if posts.shape != (BLOCK, BLOCK):
            raise StoreCorrupt(f"{name} has shape {posts.shape}; {REMEDY}")
        return BlockData(posts, lowest, highest, error)

    def _decoded(self, key: Block) -> Counts:
        with self._lock:
            posts = self._recent.get(key)
            if posts is not None:
                self._recent.move_to_end(key)
                return posts
        # Outside the lock, so that nobody waits for a decode: two threads may do one block twice.
        posts = self.block(key).posts
        with self._lock:
            self._recent[key] = posts
            while len(self._recent) > _RECENT_BLOCKS:
                self._recent.popitem(last=False)
        return posts


def _by_block(indices: Indices) -> Iterator[tuple[int, Indices]]:
    """Each block that the indices fall into, and which of them do, ascending."""
    if indices.size == 0:
        return
    blocks = indices >> BLOCK_SHIFT
    order = np.argsort(blocks, kind="stable")
    for at in np.split(order, np.flatnonzero(np.diff(blocks[order])) + 1):
        yield int(blocks[at[0]]), at


def _put(out: Counts, rows: Indices, cols: Indices, posts: Counts) -> None:
    if rows[-1] - rows[0] + 1 == rows.size and cols[-1] - cols[0] + 1 == cols.size:
        # Nearly always: a rectangle is written several times faster as one.
        out[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1] = posts
    else:
        out[np.ix_(rows, cols)] = posts


def open_store(path: str | Path) -> StoreSource:
    """Open a finished store for reading.

    Raises:
        InputError: If there is none at ``path``, or what is there is another kind of file, a newer
            store, or one whose import did not end.
        StoreCorrupt: If the file is cut short or its meta rows are damaged.
        RunError: If it cannot be read.
    """
    path = Path(path)
    require_sqlite()
    _require_file(path)
    with reading(path):
        connection = connect_reader(path)
        try:
            require_store(path, connection)
            _require_length(path, connection)
            found: list[Any] = connection.execute("SELECT key, value FROM meta").fetchall()
        finally:
            connection.close()
    rows = dict(found)
    if rows.get("state") == "building":
        raise InputError(f"{path} is half-built; run the import again")
    if rows.pop("seal", None) != meta_seal(rows) or rows.pop("state") != "complete":
        raise StoreCorrupt(f"{path}: the meta rows are damaged; {REMEDY}")
    meta = {key: json.loads(value) for key, value in rows.items()}
    return StoreSource(path, meta, lambda: connect_reader(path))


def require_store(path: Path, connection: apsw.Connection) -> None:
    """Refuse a file that is no store, or one of another schema version.

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
    if version != SCHEMA_VERSION:
        raise InputError(
            f"{path} has schema version {version}, this release reads {SCHEMA_VERSION}; "
            f"use the release that wrote it"
        )


def _require_length(path: Path, connection: apsw.Connection) -> None:
    # What stands in the write-ahead log need not be in the file yet.
    expected = connection.pragma("page_count") * connection.pragma("page_size")
    log = beside(path, "-wal")
    size = path.stat().st_size
    if size < expected and not (log.exists() and log.stat().st_size):
        raise StoreCorrupt(f"{path} is cut short: {size} of {expected} bytes; {REMEDY}")


def _require_file(path: Path) -> None:
    # It is not opened here: closing it would take away the locks of this process's connections.
    if path.is_file():
        return
    if path.exists():
        raise InputError(f"{path} is no file; name a terrasim store")
    if beside(path, BUILDING).exists():
        raise InputError(f"{path} is half-built; run the import again")
    raise InputError(f"there is no store at {path}; make one with terrasim import")


def info(path: str | Path) -> dict[str, Any]:
    """What a store holds, ready for JSON: placement, levels with their errors, size, provenance.

    Raises:
        InputError: As ``open_store``.
        StoreCorrupt: As ``open_store``.
        RunError: As ``open_store``.
    """
    with open_store(path) as store:
        grid, summary = store.grid, store.summary
    posts, size = grid.rows * grid.cols, Path(path).stat().st_size
    ground = summary["lowest"] != HOLE
    return {
        "store": str(path),
        **asdict(grid),
        "levels": summary["levels"],
        "lowest_m": float(to_metres(summary["lowest"], grid.datum)) if ground else None,
        "highest_m": float(to_metres(summary["highest"], grid.datum)) if ground else None,
        "posts": posts,
        "holes": summary["holes"],
        "blocks": summary["blocks"],
        "blobs": summary["blobs"],
        "bytes": size,
        "bytes_per_post": size / posts,
        "ratio": 4 * posts / size,
        "synthetic": store.synthetic,
        "provenance": store.provenance,
        "schema_version": SCHEMA_VERSION,
    }
