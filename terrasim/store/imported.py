"""The blocks of a terrain as they were imported: one row each, sealed, with its blob."""

from __future__ import annotations

from typing import Any

from terrasim.grid import Block
from terrasim.kernels.addressing import BLOCK
from terrasim.sources.source import BlockData
from terrasim.store.codec import StoreCorrupt, unpack
from terrasim.store.readers import Readers
from terrasim.store.store_file import REMEDY, blob_hash, block_seal

_SQL = (
    "SELECT block.lowest, block.highest, block.error, block.seal, blob.hash, blob.data "
    "FROM block JOIN blob ON blob.id = block.blob "
    "WHERE block.level = ? AND block.row = ? AND block.col = ?"
)


class Imported:
    """Reads blocks that were imported; nothing is kept."""

    def __init__(self, readers: Readers) -> None:
        """Take the connections to read through."""
        self._readers = readers

    def block(self, key: Block) -> BlockData:
        """One block: read, checked and decoded anew each time.

        Raises:
            StoreCorrupt: If it is missing or damaged.
        """
        found = self._readers.fetch(_SQL, tuple(key))
        return self._checked(key, found[0] if found else None)

    def _checked(self, key: Block, row: tuple[Any, ...] | None) -> BlockData:
        name = f"{self._readers.path}: block ({key.row}, {key.col}) of level {key.level}"
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
