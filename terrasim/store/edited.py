"""The ground as some checkpoint left it: changed blocks by the tree, all others as imported.

A changed block is stored as its difference to the imported one, which is zero nearly everywhere and
packs small; with it a hash of the posts themselves, because the imported block may come from a
formula. Detail blocks have nothing below them and are stored as they are.
"""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b
from typing import Protocol

import numpy as np

from terrasim.counts import Counts
from terrasim.errors import RunError
from terrasim.grid import Block, Grid, Span
from terrasim.kernels.addressing import BLOCK
from terrasim.sources.source import BlockData
from terrasim.store.codec import StoreCorrupt, unpack
from terrasim.store.readers import Readers
from terrasim.store.store_file import REMEDY, blob_hash
from terrasim.store.tree import DETAIL, Entry, Extent, Node, decode, extent, find, top, within

NO_POSTS = bytes(8)
"""Stands in an entry whose blob holds the posts themselves."""
_NODES_KEPT = 4096


class Base(Protocol):
    """Where unchanged blocks come from."""

    def block(self, key: Block) -> BlockData:
        """One block."""
        ...


@dataclass(frozen=True)
class At:
    """Which state of the ground."""

    checkpoint: int = 0
    """Number of the checkpoint; 0 for the terrain as imported."""
    root: bytes = b""
    """Its tree of changed blocks."""
    factor: int = 1
    """Detail posts to a base post."""


class Nodes:
    """The trees' nodes and blobs, each checked by its hash when it is read; nodes are kept."""

    def __init__(self, readers: Readers, grid: Grid) -> None:
        """Take the connections to read through."""
        self._readers = readers
        self._kept: OrderedDict[bytes, Node] = OrderedDict()
        self._lock = threading.Lock()
        self.top = grid.top
        """The coarsest level."""
        self.extent = lru_cache(64)(lambda level, factor: extent(grid, level, factor))
        """A level's extent."""

    def blob(self, content: bytes) -> bytes | None:
        """A blob by its hash; None if it is not there.

        Raises:
            StoreCorrupt: If it is damaged.
        """
        found = self._readers.fetch("SELECT data FROM blob WHERE hash = ?", (content,))
        if not found:
            return None
        data = found[0][0]
        if not isinstance(data, bytes) or blob_hash(data) != content:
            raise StoreCorrupt(f"{self._readers.path}: blob {content.hex()} is damaged; {REMEDY}")
        return data

    def node(self, content: bytes) -> Node:
        """What a node holds.

        Raises:
            Missing: If it is not there.
            StoreCorrupt: If it is damaged.
        """
        with self._lock:
            kept = self._kept.get(content)
            if kept is not None:
                self._kept.move_to_end(content)
                return kept
        data = self.required(content)
        node: Node = decode(data)[1] if data[1:2] != b"\0" else top(data)
        with self._lock:
            self._kept[content] = node
            while len(self._kept) > _NODES_KEPT:
                self._kept.popitem(last=False)
        return node

    def required(self, content: bytes) -> bytes:
        """A blob that must be there.

        Raises:
            Missing: If it is not.
            StoreCorrupt: If it is damaged.
        """
        data = self.blob(content)
        if data is None:
            raise Missing(f"{self._readers.path}: blob {content.hex()} is missing; {REMEDY}")
        return data

    def holds(self, checkpoint: int) -> bool:
        """Whether a checkpoint is still there."""
        sql = "SELECT 1 FROM checkpoint WHERE id = ?"
        return bool(self._readers.fetch(sql, (checkpoint,)))

    def entry(self, at: At, key: Block) -> Entry | None:
        """What the tree says of a block."""
        node = self.level(at, key.level)
        return find(self.node, node, self.extent(key.level, at.factor), key) if node else None

    def entries(self, at: At, level: int, rect: Span) -> Iterator[tuple[Block, Entry]]:
        """Changed blocks in a rectangle of blocks."""
        node = self.level(at, level)
        where: Extent = self.extent(level, at.factor)
        return within(self.node, node, level, where, rect) if node else iter(())

    def level(self, at: At, level: int) -> bytes:
        """A level's node; empty bytes if none of its blocks changed."""
        if not at.root:
            return b""
        node = self.node(at.root).get(level, b"")
        assert isinstance(node, bytes)
        return node


class Missing(StoreCorrupt):
    """A blob is not there. It may have been collected with the state that needed it."""


class Collected(RunError):  # noqa: N818 as StoreCorrupt
    """The state that is read was dropped and collected meanwhile."""


def read_changed(nodes: Nodes, base: Base, at: At, key: Block) -> BlockData | None:
    """A block as the tree has it; None if it was never changed.

    Raises:
        Collected: If the state was dropped meanwhile.
        StoreCorrupt: If something is missing or damaged.
    """
    try:
        entry = nodes.entry(at, key)
        if entry is None:
            return None
        posts = unpack(nodes.required(entry.content))
    except Missing:
        if nodes.holds(at.checkpoint):
            raise
        raise Collected(
            f"the state of checkpoint {at.checkpoint} was dropped and collected; "
            "open the store again"
        ) from None
    if posts.shape == (BLOCK, BLOCK) and key.level != DETAIL:
        posts = add(base.block(key).posts, posts)
    if posts.shape != (BLOCK, BLOCK) or posts_hash(posts, key) != entry.posts:
        name = f"block ({key.row}, {key.col}) of level {key.level}"
        raise StoreCorrupt(f"{name} is not the one that was written; {REMEDY}")
    return BlockData(posts, entry.lowest, entry.highest, entry.error)


def posts_hash(posts: Counts, key: Block) -> bytes:
    """What an entry says of a block's posts."""
    if key.level == DETAIL:
        return NO_POSTS
    return blake2b(np.ascontiguousarray(posts).data, digest_size=8).digest()


def add(base: Counts, difference: Counts) -> Counts:
    """Posts from their difference, modulo 2^32, so that holes come back too."""
    total: Counts = (base.view(np.uint32) + difference.view(np.uint32)).view(np.int32)
    return total


def subtract(posts: Counts, base: Counts) -> Counts:
    """The difference that :func:`add` takes back."""
    difference: Counts = (posts.view(np.uint32) - base.view(np.uint32)).view(np.int32)
    return difference
