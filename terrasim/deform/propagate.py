"""What changed at level 0 carried up through the levels: posts, ranges and error bounds.

A level changes only where the level below did, so the work falls by four from level to level. Each
level is cut into pieces, one over each block of the level below: a piece needs few blocks in the
pool at once, so any pool will do, and the results are the same for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from terrasim.counts import HOLE, MAX_COUNT
from terrasim.deform.detail_pieces import parted, to_measure, to_sample
from terrasim.deform.pieces import MOST, Piece, groups, pieces_of
from terrasim.deform.placing import blank
from terrasim.deform.regions import first_regions, next_regions
from terrasim.deform.room import Room
from terrasim.deform.touched import Touched
from terrasim.grid import Block
from terrasim.kernels import propagate as kernels
from terrasim.kernels.addressing import BLOCK
from terrasim.launch import launch
from terrasim.terrain import Terrain

__all__ = ["Touched", "propagate"]

_RECORD = blank(kernels.Piece, 1).dtype
_Four = tuple[int, int, int, int]


def propagate(terrain: Terrain, touched: Sequence[Touched]) -> None:
    """Carry changes of level 0 up to the top.

    The caller has changed the posts of the blocks of level 0, those beyond the terrain's edge
    included, and has told the cache (``cache.edited``). Every level's posts are then again those of
    level 0, and every block's lowest and highest count exact. A block's error bound becomes
    ``min(old + rise + fall, max(old, distance + below))``: the surfaces moved by no more than the
    first says; where they moved, the level lies no further from the level below than ``distance``
    and that no further from level 0 than its own bound. So bounds do not grow without end, but
    where the level below has a hole inside a triangle of the level only the first holds.

    Args:
        terrain: The terrain.
        touched: What changed.

    Raises:
        RunError: If a block cannot be read or written.
    """
    grid = terrain.grid
    if not touched or grid.top == 0:
        return
    regions = first_regions(grid, touched)
    scratch = _Scratch(terrain, min(len(regions), MOST))
    room = Room.of(terrain)
    for level in range(1, grid.levels):
        if level > 1:
            regions = next_regions(grid, level, regions)
        found = _Found()
        pieces, fine = pieces_of(grid, level, regions), list[Piece]()
        if level == 1 and terrain.detail.factor > 1:
            pieces, fine = parted(pieces, terrain.cache.detail_count)
        for group in groups(pieces, room):
            scratch = scratch.for_pieces(len(group))
            _carry(terrain, scratch, group, found)
        if fine:
            # Last: it reads what the others sampled.
            scratch = _carry_detail(terrain, scratch, room, fine, found)
        _note_errors(terrain, found)


def _carry_detail(
    terrain: Terrain, scratch: _Scratch, room: Room, pieces: list[Piece], found: _Found
) -> _Scratch:
    """Sample and measure pieces of level 1 over ground with detail."""
    # A terrain without detail never compiles these.
    from terrasim.kernels.propagate_detail import measure_with_detail, sample_with_detail

    shared = [terrain.resident, terrain.lattice]
    for kernel, parts in (
        (sample_with_detail, to_sample(pieces)),
        (measure_with_detail, to_measure(terrain.grid, pieces)),
    ):
        for group in groups(parts, room):
            scratch = scratch.for_pieces(len(group))
            _carry(terrain, scratch, group, found, kernel, shared)
    most = {key: _largest_detail(terrain, key) for piece in pieces for key in piece.below}
    for piece in pieces:
        # At a post the level follows the detail; between posts it misses all of it.
        largest = max(most[key] for key in piece.below)
        found.note(piece, largest, 2 * largest, -1, -1)
    return scratch


def _largest_detail(terrain: Terrain, key: Block) -> int:
    """Largest difference of the detail on a block of level 0 [counts, rounded up]."""
    terrain.cache.hold([key])
    ranges = [terrain.cache.describe(one)[:2] for one in terrain.cache.details(key)]
    largest = max((max(-low, high) for low, high in ranges), default=0)
    return -(-largest // terrain.detail.factor)


class _Found:
    """What the pieces of a level found out, whichever launch they were in."""

    def __init__(self) -> None:
        self.bounds: dict[Block, _Four] = {}
        """For each block the most its surface rose and fell, the largest bound of those below
        [counts], and the distance from these [half counts]."""
        self.edges: dict[Block, int] = {}
        """Distances [half counts] on the northern and eastern sides of blocks."""

    def note(self, piece: Piece, below: int, distance: int, south: int, west: int) -> None:
        """Take in what a piece found of its block and of the neighbours that share an edge."""
        key = piece.block
        old = self.bounds.get(key)
        mine = (piece.rise, piece.fall, below, distance)
        self.bounds[key] = mine if old is None else _largest(old, mine)
        if south > 0:
            self._note_edge(Block(key.level, key.row - 1, key.col), south)
        if west > 0:
            self._note_edge(Block(key.level, key.row, key.col - 1), west)

    def _note_edge(self, key: Block, distance: int) -> None:
        self.edges[key] = max(self.edges.get(key, 0), distance)


def _largest(one: _Four, other: _Four) -> _Four:
    return (
        max(one[0], other[0]),
        max(one[1], other[1]),
        max(one[2], other[2]),
        max(one[3], other[3]),
    )


class _Scratch:
    """Arrays of a launch, kept from level to level."""

    def __init__(self, terrain: Terrain, pieces: int) -> None:
        self._terrain = terrain
        self._size = pieces
        device, rows = terrain.device, pieces * kernels.QUADRANT
        self.host = np.zeros(pieces, dtype=_RECORD)
        # By its address: Warp takes long to find out that the types agree.
        start, size = self.host.ctypes.data, self.host.nbytes
        here: Any = wp.array(
            ptr=start, capacity=size, shape=pieces, dtype=kernels.Piece, device="cpu"
        )
        self._here = here
        self._there: Any = wp.empty_like(here, device=device) if device.is_cuda else here
        # Where a row stands, whichever part of a launch it falls into.
        place = np.arange(rows, dtype=np.int32)
        self.place: Any = wp.array(place, dtype=wp.int32, device=device, copy=False)
        self.tally: Any = wp.empty((rows, kernels.FIELDS), dtype=wp.int64, device=device)

    def for_pieces(self, pieces: int) -> _Scratch:
        """Scratch for at least as many pieces."""
        return self if pieces <= self._size else _Scratch(self._terrain, pieces)

    @property
    def pieces(self) -> Any:
        """The pieces that stand in ``host``, on the device."""
        if self._there is not self._here:
            wp.copy(self._there, self._here)
        return self._there


def _carry(
    terrain: Terrain,
    scratch: _Scratch,
    group: list[Piece],
    found: _Found,
    kernel: Any = kernels.carry_up,
    shared: Sequence[Any] = (),
) -> None:
    """Sample and measure pieces, tell the cache of their blocks' ranges."""
    cache = terrain.cache
    needed = list(dict.fromkeys(key for piece in group for key in piece.needs))
    layers = dict(zip(needed, cache.hold(needed), strict=True))
    scratch.host[: len(group)] = [piece.record(layers) for piece in group]
    rows = len(group) * kernels.QUADRANT
    launch(
        kernel,
        rows,
        shared=[terrain.pool, *shared, scratch.pieces],
        items=[scratch.place, scratch.tally],
        device=terrain.device,
        threads=terrain.threads,
    )
    # Four times faster than the largest along an axis.
    starts = np.arange(0, rows, kernels.QUADRANT)
    tallies = np.maximum.reduceat(scratch.tally.numpy()[:rows], starts, axis=0).tolist()
    _note_ranges(terrain, group, tallies)
    for piece, row in zip(group, tallies, strict=True):
        below = cache.describe(piece.below[0])[2] if piece.measure else 0
        found.note(piece, below, *row[4:])


def _note_ranges(terrain: Terrain, group: list[Piece], tallies: list[list[int]]) -> None:
    """Tell the cache the lowest and highest counts of sampled blocks; their bounds come later."""
    cache = terrain.cache
    ranges: dict[Block, list[int]] = {}
    for piece, row in zip(group, tallies, strict=True):
        if piece.sample:
            other = ranges.get(piece.block)
            ranges[piece.block] = row if other is None else [*map(max, row, other)]
    lost = []
    for key, (low, high, old_low, old_high, *_) in ranges.items():
        lowest, highest, error = cache.describe(key)
        # An extreme that stood in what was sampled and is there no more: others must be looked at.
        if -low > lowest >= -old_low or high < highest <= old_high:
            lost.append(key)
        cache.edited(key, min(lowest, -low), max(highest, high), error)
    if lost:
        _look_again(terrain, lost)


def _look_again(terrain: Terrain, keys: list[Block]) -> None:
    """Find the lowest and highest counts of whole blocks."""
    cache, device = terrain.cache, terrain.device
    rows = len(keys) * BLOCK
    layers: Any = wp.array(cache.hold(keys), dtype=wp.int32, device=device)
    place: Any = wp.array(np.arange(rows, dtype=np.int32), device=device)
    ranges: Any = wp.empty((rows, 2), dtype=wp.int64, device=device)
    launch(
        kernels.range_of_rows,
        rows,
        shared=[terrain.pool, layers],
        items=[place, ranges],
        device=device,
        threads=terrain.threads,
    )
    found = ranges.numpy().reshape(len(keys), BLOCK, 2).max(axis=1).tolist()
    for key, (low, high) in zip(keys, found, strict=True):
        cache.edited(key, HOLE if high == HOLE else -low, high, cache.describe(key)[2])


def _note_errors(terrain: Terrain, found: _Found) -> None:
    """Tell the cache the blocks' new error bounds."""
    cache = terrain.cache
    for key, (rise, fall, below, distance) in found.bounds.items():
        if not cache.is_resident(key):
            cache.hold([key])
        lowest, highest, old = cache.describe(key)
        furthest = max(distance, found.edges.get(key, 0))
        measured = max(old, (furthest + 1) // 2 + below)
        error = min(old + rise + fall, measured, MAX_COUNT)
        cache.edited(key, lowest, highest, error)
