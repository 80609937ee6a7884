"""A store: one SQLite file that holds a terrain's blocks of every level, and what became of them.

Blocks point to content-addressed blobs, so that equal blocks are kept once. Nothing is believed on
the way back: a blob has its hash, a row a seal over all it says. A read is right or raises
``StoreCorrupt``.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Self

import numpy as np

from terrasim.counts import Counts
from terrasim.errors import InputError
from terrasim.grid import Block, Grid, Indices, Span
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT
from terrasim.sources.source import BlockData, Source
from terrasim.store.acknowledged import sound_log
from terrasim.store.codec import StoreCorrupt
from terrasim.store.edited import At, Base, Nodes, read_changed
from terrasim.store.formula import same_source
from terrasim.store.imported import Imported
from terrasim.store.kept_base import KeptBase
from terrasim.store.names import (
    no_names,
    one_state,
    place_of,
    read_names,
)
from terrasim.store.noted import check_note
from terrasim.store.opening import read_meta, require_file, require_length, require_store
from terrasim.store.readers import Readers
from terrasim.store.store_file import SCHEMA_VERSION, connect_reader, reading, require_sqlite
from terrasim.store.tree import DETAIL

__all__ = ["StoreCorrupt", "StoreSource", "open_snapshot", "open_store"]

_RECENT_BLOCKS = 64


class StoreSource:
    """A store's heights in one state, read block by block as they are asked for.

    Any number of threads may read at once: each borrows a connection for the query alone, and
    checks and decodes what came by itself.
    """

    def __init__(self, meta: dict[str, Any], readers: Readers, at: At | None = None) -> None:
        """Take what the meta rows said; ``open_store`` does that."""
        self.path = readers.path
        """The file."""
        self.provenance: dict[str, object] = meta["provenance"]
        """Where the heights come from, ready for JSON."""
        self.summary: dict[str, Any] = meta["summary"]
        """What the build found: range, holes, blocks, errors a level; little of a formula."""
        self.schema_version: int = meta.get("schema_version", SCHEMA_VERSION)
        """Version of the file's tables."""
        self._grid = Grid(**meta["grid"])
        self._synthetic = str(meta["synthetic"])
        self._readers = readers
        self._at = at or At()
        self.nodes = Nodes(readers, self._grid)
        """The trees of changed blocks."""
        self._formula: Source | None = same_source(meta["formula"]) if "formula" in meta else None
        self._base: Base = self._formula or Imported(readers)
        self.base = KeptBase(self._base)
        """Unchanged blocks to compare changed ones with."""
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

    @property
    def detail_factor(self) -> int:
        """Detail posts to a base post; 1 if there is no detail."""
        return self._at.factor

    @property
    def state(self) -> At:
        """Which state it reads."""
        return self._at

    def at(self, at: At) -> StoreSource:
        """The same terrain in another state, through the same connections."""
        other = object.__new__(StoreSource)
        other.__dict__.update(self.__dict__)
        other._at = at
        other._recent, other._lock = OrderedDict(), threading.Lock()
        return other

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        """Heights of the level's posts at the outer product of two index vectors.

        See :meth:`terrasim.sources.source.Source.posts`. The blocks decoded last are kept.

        Raises:
            InputError: If the terrain has no such level.
            RunError: As ``block``.
            StoreCorrupt: If a block is missing or damaged.
        """
        self._check_level(level)
        span = self._grid.posts(level)
        # The outermost posts stand on the edge or beyond it: all further out are like them.
        row = np.clip(np.asarray(rows, dtype=np.int64), span.row0, span.row1 - 1)
        col = np.clip(np.asarray(cols, dtype=np.int64), span.col0, span.col1 - 1)
        by_row, by_col = dict(_by_block(row)), dict(_by_block(col))
        if self._formula is None:
            out = np.empty((row.size, col.size), dtype=np.int32)
            keys = iter([Block(level, r, c) for r in by_row for c in by_col])
        else:
            out = self._formula.posts(level, row, col)
            keys = self._changed(level, by_row, by_col)
        for key in keys:
            at_row, at_col = by_row[key.row], by_col[key.col]
            posts = self._decoded(key).take(row[at_row] & (BLOCK - 1), axis=0)
            _put(out, at_row, at_col, posts.take(col[at_col] & (BLOCK - 1), axis=1))
        return out

    def block(self, key: Block) -> BlockData:
        """One block, ready for the pool: read, checked and decoded anew each time.

        A detail block, of level -1, that was never written is zero everywhere.

        Raises:
            InputError: If the terrain has no such block.
            RunError: If the disk fails, or the state was dropped and collected meanwhile.
            StoreCorrupt: If it is missing or damaged.
        """
        if key.level != DETAIL or self._at.factor == 1:
            self._check_level(key.level)
        span = self.nodes.extent(key.level, self._at.factor).rows
        if not (span.row0 <= key.row < span.row1 and span.col0 <= key.col < span.col1):
            raise InputError(
                f"level {key.level} has blocks ({span.row0}, {span.col0}) to "
                f"({span.row1 - 1}, {span.col1 - 1}), got ({key.row}, {key.col})"
            )
        changed = read_changed(self.nodes, self.base, self._at, key)
        if changed is not None:
            return changed
        if key.level == DETAIL:
            return BlockData(np.zeros((BLOCK, BLOCK), np.int32), 0, 0, 0)
        return self._base.block(key)

    def details(self, key: Block) -> list[Block]:
        """Detail blocks within a level-0 block that are not zero everywhere, in order.

        Raises:
            RunError: As ``block``.
            StoreCorrupt: As ``block``.
        """
        factor, first = self._at.factor, self._grid.blocks(0)
        if factor == 1 or key.level != 0:
            return []
        row, col = (key.row - first.row0) * factor, (key.col - first.col0) * factor
        rect = Span(row, row + factor, col, col + factor)
        return sorted(one for one, _ in self.nodes.entries(self._at, DETAIL, rect))

    def changed(self) -> Iterator[Block]:
        """All blocks that differ from the terrain as imported, detail first, in order of levels.

        Raises:
            RunError: As ``block``.
            StoreCorrupt: As ``block``.
        """
        finest = DETAIL if self._at.factor > 1 else 0
        for level in range(finest, self._grid.levels):
            rect = self.nodes.extent(level, self._at.factor).rows
            yield from (key for key, _ in self.nodes.entries(self._at, level, rect))

    def close(self) -> None:
        """Close the connections that are idle. Reading on opens new ones."""
        self._readers.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check_level(self, level: int) -> None:
        if not 0 <= level <= self._grid.top:
            raise InputError(f"level must be 0 to {self._grid.top}, got {level}")

    def _changed(
        self, level: int, by_row: dict[int, Indices], by_col: dict[int, Indices]
    ) -> Iterator[Block]:
        """Changed blocks among those that are asked for."""
        if not by_row or not by_col:
            return
        rect = Span(min(by_row), max(by_row) + 1, min(by_col), max(by_col) + 1)
        for key, _ in self.nodes.entries(self._at, level, rect):
            if key.row in by_row and key.col in by_col:
                yield key

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


def open_store(
    path: str | Path, *, branch: str | None = None, snapshot: str | None = None, vfs: str = ""
) -> StoreSource:
    """Open a finished store for reading, in the state that it has now.

    Args:
        path: The store.
        branch: Read this branch's newest checkpoint; by default that of ``main``, or the terrain as
            imported if nothing was done to it yet.
        snapshot: Read this snapshot instead.
        vfs: Name of the SQLite VFS to go through; empty for the system's own.

    Raises:
        InputError: If there is none at ``path``, or what is there is another kind of file, a newer
            store, or one whose import did not end; or there is no such branch or snapshot.
        StoreCorrupt: If the file is cut short, its write-ahead log or one of the rows that say what
            it holds is damaged.
        RunError: If it cannot be read.
    """
    path = Path(path)
    require_sqlite()
    require_file(path)
    with reading(path), sound_log(path) as note:
        connection = connect_reader(path, vfs)
        try:
            version = require_store(path, connection)
            require_length(path, connection)
            with one_state(connection):
                meta = read_meta(path, connection)
                if version > 1:
                    names = read_names(connection)
                    at = place_of(connection, names, branch, snapshot)
                    if note is not None:
                        check_note(path, connection, note, names.state)
                elif branch or snapshot:
                    raise no_names(path)
                else:
                    at = At()
        finally:
            connection.close()
    meta["schema_version"] = version
    return StoreSource(meta, Readers(path, lambda: connect_reader(path, vfs)), at)


def open_snapshot(path: str | Path, name: str) -> StoreSource:
    """Open a snapshot for reading; see :func:`open_store`."""
    return open_store(path, snapshot=name)
