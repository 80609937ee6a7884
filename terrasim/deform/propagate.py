"""What changed at level 0 carried up through the levels: posts, ranges and error bounds.

A level changes only where the level below did, so the work falls by four from level to level. Each
level is cut into pieces, one over each block of the level below: a piece needs few blocks in the
pool at once, so any pool will do, and the results are the same for all.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from terrasim.counts import HOLE, MAX_COUNT
from terrasim.deform.pieces import MOST, Piece, groups, pieces_of
from terrasim.deform.placing import blank
from terrasim.deform.regions import first_regions, next_regions
from terrasim.deform.touched import Touched
from terrasim.grid import Block
from terrasim.kernels import propagate as kernels
from terrasim.kernels.addressing import BLOCK
from terrasim.launch import launch
from terrasim.terrain import Terrain

__all__ = ["Touched", "propagate"]


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
    for level in range(1, grid.levels):
        if level > 1:
            regions = next_regions(grid, level, regions)
        found = _Found()
        for group in groups(pieces_of(grid, level, regions), terrain.cache.capacity, grid.top):
            scratch = scratch.for_pieces(len(group))
            _carry(terrain, scratch, group, found)
        _note_errors(terrain, found)


class _Bound(NamedTuple):
    """What becomes of a block's error bound [counts]."""

    rise: int = 0
    fall: int = 0
    distance: int = 0
    """From the level below [half counts]."""
    below: int = 0
    """Largest bound of the blocks below."""


class _Found:
    """What the pieces of a level found out, whichever launch they were in."""

    def __init__(self) -> None:
        self.bounds: dict[Block, _Bound] = {}
        self.edges: dict[Block, int] = {}
        """Distances [half counts] on the northern and eastern side of a block."""

    def note(self, piece: Piece, below: int, distance: int, south: int, west: int) -> None:
        """Take in what a piece found of its block and of the neighbours that share an edge."""
        key = piece.block
        old = self.bounds.get(key, _Bound())
        self.bounds[key] = _Bound(
            max(old.rise, piece.rise),
            max(old.fall, piece.fall),
            max(old.distance, distance),
            max(old.below, below),
        )
        for other, edge in (
            (Block(key.level, key.row - 1, key.col), south),
            (Block(key.level, key.row, key.col - 1), west),
        ):
            if edge > 0:
                self.edges[other] = max(self.edges.get(other, 0), edge)


class _Scratch:
    """Arrays of a launch, kept from level to level."""

    def __init__(self, terrain: Terrain, pieces: int) -> None:
        self._terrain = terrain
        self._size = pieces
        device = terrain.device
        self.host = blank(kernels.Piece, pieces)
        self._pieces: Any = wp.array(
            self.host, dtype=kernels.Piece, device=device, copy=device.is_cuda
        )
        # Where a row stands, whichever part of a launch it falls into.
        self.place: Any = wp.array(
            np.arange(pieces * kernels.QUADRANT, dtype=np.int32), device=device
        )
        shape = (pieces * kernels.QUADRANT, kernels.FIELDS)
        self.tally: Any = wp.empty(shape, dtype=wp.int64, device=device)

    def for_pieces(self, pieces: int) -> _Scratch:
        """Scratch for at least as many pieces."""
        return self if pieces <= self._size else _Scratch(self._terrain, pieces)

    @property
    def pieces(self) -> Any:
        """The pieces that stand in ``host``, on the device."""
        if self._pieces.device.is_cuda:
            self._pieces.assign(self.host)
        return self._pieces


def _carry(terrain: Terrain, scratch: _Scratch, group: list[Piece], found: _Found) -> None:
    """Sample and measure pieces, tell the cache of their blocks' ranges."""
    cache = terrain.cache
    needed = list(dict.fromkeys(key for piece in group for key in piece.needs))
    layers = dict(zip(needed, cache.hold(needed), strict=True))
    for i, piece in enumerate(group):
        scratch.host[i] = piece.record(layers)
    rows = len(group) * kernels.QUADRANT
    launch(
        kernels.carry_up,
        rows,
        shared=[terrain.pool, scratch.pieces],
        items=[scratch.place, scratch.tally],
        device=terrain.device,
        threads=terrain.threads,
    )
    tally = scratch.tally.numpy()[:rows].reshape(len(group), kernels.QUADRANT, kernels.FIELDS)
    tallies = tally.max(axis=1).tolist()
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
    for key, bound in found.bounds.items():
        if not cache.is_resident(key):
            cache.hold([key])
        lowest, highest, old = cache.describe(key)
        distance = max(bound.distance, found.edges.get(key, 0))
        measured = max(old, (distance + 1) // 2 + bound.below)
        error = min(old + bound.rise + bound.fall, measured, MAX_COUNT)
        cache.edited(key, lowest, highest, error)
