"""Block images: changed blocks as blobs in small transactions, then a tree that names them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from terrasim.counts import Counts
from terrasim.errors import InputError
from terrasim.grid import Block
from terrasim.kernels.addressing import BLOCK
from terrasim.sources.source import BlockData
from terrasim.store.codec import CODEC, pack
from terrasim.store.edited import At, Base, Nodes, posts_hash, subtract
from terrasim.store.store_file import blob_hash
from terrasim.store.tree import DETAIL, NODE_CODEC, Entry, changed
from terrasim.store.writer import Writer

BATCH_BYTES = 1 << 20
"""Bytes of blobs in one transaction, between which others may write."""
# A blob that is there is not written again; one that was damaged is, because its hash says what
# it was.
_INSERT = (
    "INSERT INTO blob (hash, codec, data) VALUES (?, ?, ?) ON CONFLICT (hash) "
    "DO UPDATE SET data = excluded.data WHERE data <> excluded.data"
)


@dataclass(frozen=True)
class Images:
    """The ground as it will be, written but not yet named."""

    root: bytes
    """The tree of changed blocks; empty if there is none."""
    blocks: int
    """Blocks that differ from before."""


def write_images(
    writer: Writer, nodes: Nodes, base: Base, at: At, blocks: Mapping[Block, BlockData | None]
) -> Images:
    """Write what has changed since a state.

    Args:
        writer: The store.
        nodes: Its trees.
        base: The unchanged blocks.
        at: The state.
        blocks: The blocks that changed; None for a detail block that is zero again.

    Raises:
        InputError: If the terrain has no such block, or it is no block.
        RunError: If it cannot be written. What has been is collected later.
        StoreCorrupt: If what it is compared with is damaged.
    """
    batch = _Batch(writer)
    entries: dict[Block, Entry | None] = {}
    for key, data in blocks.items():
        _check(nodes, at, key, data)
        entry, blob = _image(base, key, data)
        if entry == nodes.entry(at, key):
            continue
        entries[key] = entry
        if entry is not None:
            batch.add(entry.content, CODEC, blob)
    root = at.root
    made: dict[bytes, bytes] = {}
    if entries:
        root, made = changed(
            nodes.required, at.root, entries, lambda level: nodes.extent(level, at.factor)
        )
    for name, data_ in made.items():
        batch.add(name, NODE_CODEC, data_)
    batch.flush()
    return Images(root, len(entries))


class _Batch:
    """Blobs that go into one transaction."""

    def __init__(self, writer: Writer) -> None:
        self._writer = writer
        self._waiting: list[tuple[bytes, int, bytes]] = []
        self._bytes = 0

    def add(self, name: bytes, codec: int, data: bytes) -> None:
        """Write it now or with others."""
        self._waiting.append((name, codec, data))
        self._bytes += len(data)
        if self._bytes >= BATCH_BYTES:
            self.flush()

    def flush(self) -> None:
        """Write all that wait."""
        if self._waiting:
            with self._writer.transaction() as work:
                work.db.executemany(_INSERT, self._waiting)
        self._waiting, self._bytes = [], 0


def _image(base: Base, key: Block, data: BlockData | None) -> tuple[Entry | None, bytes]:
    """A block's entry and blob; none if it is as the terrain was imported."""
    if data is None:
        return None, b""
    posts: Counts = np.ascontiguousarray(data.posts)
    numbers = (int(data.lowest), int(data.highest), int(data.error))
    if key.level == DETAIL:
        if not posts.any():
            return None, b""
        blob = pack(posts)
    else:
        imported = base.block(key)
        difference = subtract(posts, imported.posts)
        if numbers == (imported.lowest, imported.highest, imported.error) and not difference.any():
            return None, b""
        blob = pack(difference)
    return Entry(blob_hash(blob), posts_hash(posts, key), *numbers), blob


def _check(nodes: Nodes, at: At, key: Block, data: BlockData | None) -> None:
    if not DETAIL <= key.level <= nodes.top or (key.level == DETAIL and at.factor == 1):
        raise InputError(
            f"a block's level must be 0 to {nodes.top}, or -1 where there is detail, "
            f"got {key.level}"
        )
    span = nodes.extent(key.level, at.factor).rows
    if not (span.row0 <= key.row < span.row1 and span.col0 <= key.col < span.col1):
        raise InputError(
            f"level {key.level} has blocks ({span.row0}, {span.col0}) to "
            f"({span.row1 - 1}, {span.col1 - 1}), got ({key.row}, {key.col})"
        )
    if data is None:
        if key.level != DETAIL:
            raise InputError(f"only a detail block can be zero again, got level {key.level}")
    elif data.posts.shape != (BLOCK, BLOCK) or data.posts.dtype != np.int32:
        raise InputError(
            f"a block is an int32 array of {BLOCK} x {BLOCK} posts, "
            f"got {data.posts.dtype} of shape {data.posts.shape}"
        )


def has_detail(nodes: Nodes, at: At) -> bool:
    """Whether any detail block is not zero."""
    return bool(nodes.level(at, DETAIL))
