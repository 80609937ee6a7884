"""All blobs of a store: which are sound, which are needed."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import apsw

from terrasim.errors import RunError
from terrasim.grid import Block
from terrasim.store.store_file import blob_hash
from terrasim.store.tree import NODE_CODEC, Entry, Extent, decode, parts


@dataclass
class Findings:
    """What was found so far."""

    problems: list[str] = field(default_factory=list)
    counts: dict[str, int] = field(default_factory=dict)

    def check(self, what: Callable[[], object]) -> None:
        """Look at something; what is wrong with it is a problem and no end."""
        try:
            what()
        except RunError as error:
            self.problems.append(str(error))


class Blobs:
    """All blobs: which are sound, and which are in use."""

    def __init__(self, db: apsw.Connection, found: Findings) -> None:
        """Look at each once."""
        self.nodes: dict[bytes, bytes] = {}
        self.sound: set[bytes] = set()
        self.hash_of: dict[int, bytes] = {}
        self.used: set[bytes] = set()
        for number, name, codec, data in db.execute("SELECT id, hash, codec, data FROM blob"):
            if not isinstance(data, bytes) or blob_hash(data) != name:
                found.problems.append(f"blob {number} is damaged")
                continue
            self.sound.add(name)
            self.hash_of[number] = name
            if codec == NODE_CODEC:
                self.nodes[name] = data
        found.counts["blobs"] = len(self.sound)

    def tree(self, root: bytes, extents: Callable[[int], Extent]) -> Iterator[str]:
        """Visit a tree as far as it was not visited; what is wrong with it.

        Args:
            root: The tree; empty bytes for an empty one.
            extents: A level's extent, by which the blocks are named.
        """
        waiting = [(root, Block(0, 0, 0))] if root and root not in self.used else []
        while waiting:
            name, at = waiting.pop()
            self.used.add(name)
            if name not in self.nodes:
                yield f"node {name.hex()} is missing or damaged"
                continue
            depth, node = decode(self.nodes[name])
            for place, held in node.items():
                child = held.content if isinstance(held, Entry) else held
                if child in self.used:
                    continue
                below = parts(at, depth, place)
                if not isinstance(held, Entry):
                    waiting.append((held, below))
                    continue
                self.used.add(child)
                if child not in self.sound:
                    rows = extents(below.level).rows
                    key = (below.level, below.row + rows.row0, below.col + rows.col0)
                    yield f"blob {child.hex()} of block {key} is missing or damaged"
