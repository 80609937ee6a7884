"""The tree of changed blocks: which blob holds a block now, by a tree of hashes.

A node is a blob; it covers a square of 8 x 8 nodes below it, or of 8 x 8 blocks. Its name is the
hash of what it says, so the name of the root stands for the heights of the whole terrain: a lookup
is right or fails, and what is absent is absent for certain. A change writes new nodes from the
changed blocks up to a new root and leaves the old ones alone, so that a snapshot, a branch or a
reset costs one row, and what was dropped cannot come back.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Mapping
from typing import NamedTuple

from terrasim.grid import Block, Grid, Span
from terrasim.store.codec import StoreCorrupt
from terrasim.store.store_file import REMEDY, blob_hash

NODE_CODEC = 2
"""Id of the format of nodes, the first byte of each."""
DETAIL = -1
"""The level of detail blocks."""
_BITS = 3
_SIDE = 1 << _BITS
_HEAD = struct.Struct("<BB")
_TOP = struct.Struct("<b16s")
_INNER = struct.Struct("<B16s")
_LEAF = struct.Struct("<B16s8siii")


class Entry(NamedTuple):
    """Where a changed block's posts are, and what is known of them."""

    content: bytes
    """Hash of the blob."""
    posts: bytes
    """Eight bytes of a hash of the posts where the blob holds their difference to the imported
    block; zeros where it holds the posts themselves."""
    lowest: int
    highest: int
    error: int


class Extent(NamedTuple):
    """Where a level's blocks lie, and how deep its part of the tree is."""

    rows: Span
    depth: int


Read = Callable[[bytes], bytes]
Held = bytes | Entry
Node = dict[int, Held]


def extent(grid: Grid, level: int, factor: int) -> Extent:
    """Where a level's blocks lie; those of the detail are numbered from the terrain's first."""
    span = grid.blocks(max(level, 0))
    if level == DETAIL:
        rows, cols = span.row1 - span.row0, span.col1 - span.col0
        span = Span(0, rows * factor, 0, cols * factor)
    side = max(span.row1 - span.row0, span.col1 - span.col0)
    return Extent(span, max(1, -(-(side - 1).bit_length() // _BITS)))


def top(data: bytes) -> Node:
    """Levels and their nodes of a root's blob."""
    depth, held = decode(data)
    if depth != 0:
        raise StoreCorrupt(f"a root has depth {depth}; {REMEDY}")
    return held


def decode(data: bytes) -> tuple[int, Node]:
    """A node's depth (0 a root, 1 above blocks) and what it holds, by place.

    Raises:
        StoreCorrupt: If the bytes are no node's.
    """
    try:
        codec, depth = _HEAD.unpack_from(data)
        if codec != NODE_CODEC:
            raise StoreCorrupt(f"a node has codec {codec}; {REMEDY}")
        said = memoryview(data)[_HEAD.size :]
        if depth == 1:
            leaf: Node = {at: Entry(*entry) for at, *entry in _LEAF.iter_unpack(said)}
            return depth, leaf
        form = _INNER if depth else _TOP
        return depth, dict(form.iter_unpack(said))
    except struct.error:
        raise StoreCorrupt(f"a node of {len(data)} bytes is cut short; {REMEDY}") from None


def parts(at: Block, depth: int, place: int) -> Block:
    """Where a part of a node is, in parts of its size from the level's first block.

    Args:
        at: Where the node is, in nodes of its size.
        depth: The node's depth.
        place: The part's place in it; a root's are the levels.
    """
    if depth == 0:
        return Block(place, 0, 0)
    row, col = place >> _BITS, place & _SIDE - 1
    return Block(at.level, at.row << _BITS | row, at.col << _BITS | col)


def find(nodes: Callable[[bytes], Node], node: bytes, where: Extent, key: Block) -> Entry | None:
    """A block's entry below a level's node; None if the block was never changed.

    Args:
        nodes: What a node holds.
        node: The level's node.
        where: The level's extent.
        key: The block.
    """
    row, col = key.row - where.rows.row0, key.col - where.rows.col0
    for depth in range(where.depth, 1, -1):
        child = nodes(node).get(_place(row, col, depth))
        if not isinstance(child, bytes):
            return None
        node = child
    entry = nodes(node).get(_place(row, col, 1))
    return entry if isinstance(entry, Entry) else None


def within(
    nodes: Callable[[bytes], Node], node: bytes, level: int, where: Extent, rect: Span
) -> Iterator[tuple[Block, Entry]]:
    """Changed blocks of a level in a rectangle of blocks, with their entries."""
    row0, col0 = where.rows.row0, where.rows.col0
    wanted = Span(rect.row0 - row0, rect.row1 - row0, rect.col0 - col0, rect.col1 - col0)
    for row, col, entry in _below(nodes, node, where.depth, (0, 0), wanted):
        yield Block(level, row + row0, col + col0), entry


def changed(
    read: Read,
    root: bytes,
    changes: Mapping[Block, Entry | None],
    extents: Callable[[int], Extent],
) -> tuple[bytes, dict[bytes, bytes]]:
    """Put entries into a tree.

    Args:
        read: A node's blob by its hash.
        root: The tree; empty bytes for an empty one.
        changes: New entries; None takes one out.
        extents: A level's extent.

    Returns:
        The new root, empty bytes if nothing is in the tree, and the new nodes by hash.
    """
    made: dict[bytes, bytes] = {}
    levels = top(read(root)) if root else {}
    for level in sorted({key.level for key in changes}):
        where = extents(level)
        moved = [
            (key.row - where.rows.row0, key.col - where.rows.col0, entry)
            for key, entry in changes.items()
            if key.level == level
        ]
        below = levels.pop(level, b"")
        assert isinstance(below, bytes)
        node = _put(read, below, where.depth, moved, made)
        if node:
            levels[level] = node
    return _made(made, 0, levels), made


def _below(
    nodes: Callable[[bytes], Node], node: bytes, depth: int, corner: tuple[int, int], rect: Span
) -> Iterator[tuple[int, int, Entry]]:
    side = 1 << _BITS * (depth - 1)
    for at, held in sorted(nodes(node).items()):
        row, col = corner[0] + (at >> _BITS) * side, corner[1] + (at & _SIDE - 1) * side
        if row >= rect.row1 or row + side <= rect.row0:
            continue
        if col >= rect.col1 or col + side <= rect.col0:
            continue
        if isinstance(held, Entry):
            yield row, col, held
        else:
            yield from _below(nodes, held, depth - 1, (row, col), rect)


def _put(
    read: Read,
    node: bytes,
    depth: int,
    changes: list[tuple[int, int, Entry | None]],
    made: dict[bytes, bytes],
) -> bytes:
    """A node's successor; empty bytes if nothing is left in it."""
    held: Node = dict(decode(read(node))[1]) if node else {}
    if depth == 1:
        for row, col, entry in changes:
            _set(held, _place(row, col, 1), entry)
        return _made(made, 1, held)
    groups: dict[int, list[tuple[int, int, Entry | None]]] = {}
    for change in changes:
        groups.setdefault(_place(change[0], change[1], depth), []).append(change)
    for at, group in groups.items():
        below = held.get(at, b"")
        assert isinstance(below, bytes)
        _set(held, at, _put(read, below, depth - 1, group, made) or None)
    return _made(made, depth, held)


def _set(held: Node, at: int, value: Held | None) -> None:
    if value is None:
        held.pop(at, None)
    else:
        held[at] = value


def _made(made: dict[bytes, bytes], depth: int, held: Mapping[int, Held]) -> bytes:
    """Write a node into what is new; returns its name."""
    if not held:
        return b""
    parts = [_HEAD.pack(NODE_CODEC, depth)]
    for at, one in sorted(held.items()):
        if isinstance(one, Entry):
            parts.append(_LEAF.pack(at, *one))
        else:
            parts.append((_INNER if depth else _TOP).pack(at, one))
    data = b"".join(parts)
    name = blob_hash(data)
    made[name] = data
    return name


def _place(row: int, col: int, depth: int) -> int:
    shift = _BITS * (depth - 1)
    return (row >> shift & _SIDE - 1) << _BITS | (col >> shift & _SIDE - 1)
