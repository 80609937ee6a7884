"""Which blocks are changed together: as many as the pool holds with all that belongs to them.

A block of level 0 is never in the pool without its detail, and detail is changed against the
surface of its block, whose last cells end at the next blocks' posts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from terrasim.deform.binning import Touch
from terrasim.errors import RunError
from terrasim.grid import Block
from terrasim.terrain import Terrain


@dataclass(frozen=True)
class Part:
    """Touched blocks that are changed together, those from ``first`` up to before ``last``."""

    first: int
    last: int
    beside: tuple[Block, ...] = ()
    """Blocks of level 0 that must be in the pool meanwhile."""


class Fitting:
    """The pool's room, filled with blocks of level 0 and the detail that comes with them."""

    def __init__(self, terrain: Terrain, touches: Sequence[Touch]) -> None:
        """Find the detail that an edit may make.

        Args:
            terrain: The terrain.
            touches: All blocks that the edit touches.
        """
        self._cache = terrain.cache
        self._detail = terrain.detail if terrain.detail.factor > 1 else None
        self._touches = touches
        self._span = terrain.grid.blocks(0)
        self._below_top = terrain.grid.top > 0
        self._coming: dict[Block, set[Block]] = {}
        for found in touches:
            if found.level < 0:
                for key in found.blocks():
                    self._coming.setdefault(self._base_of(key), set()).add(key)

    def parts(self, found: Touch, most: int) -> list[Part]:
        """Cut touched blocks into parts that the pool holds, of ``most`` blocks at most.

        Raises:
            RunError: If the pool is too small for what belongs to one block.
        """
        count = len(found.row)
        if self._detail is None:
            room = min(most, self._cache.capacity) if self._below_top else most
            return [Part(i, min(i + room, count)) for i in range(0, count, room)]
        parts = []
        first = 0
        self._clear()
        for i, key in enumerate(found.blocks()):
            if i - first == most or not self._take(key):
                parts.append(Part(first, i, self._beside(found)))
                first = i
                self._clear()
                if not self._take(key):
                    raise RunError(
                        f"the pool is too small for what belongs to {self._base_of(key)}; "
                        "raise pool_bytes and detail_pool_bytes"
                    )
        parts.append(Part(first, count, self._beside(found)))
        return [part for part in parts if part.first < part.last]

    def all_at_once(self) -> set[Block] | None:
        """Every block of level 0 that the edit needs; None if the pool does not hold them."""
        if self._detail is None:
            needed = {key for found in self._touches for key in found.blocks()}
            fits = len(needed) <= self._cache.capacity or not self._below_top
            return needed if fits else None
        self._clear()
        fits = all(self._take(key) for found in self._touches for key in found.blocks())
        return self._needed if fits else None

    def _base_of(self, key: Block) -> Block:
        return key if key.level == 0 or self._detail is None else self._detail.base_of(key)

    def _beside(self, found: Touch) -> tuple[Block, ...]:
        return tuple(sorted(self._needed)) if found.level < 0 else ()

    def _clear(self) -> None:
        """Begin anew, with nothing but what is always in the pool."""
        span = self._span
        self._needed: set[Block] = set()
        if not self._below_top:
            rows, cols = range(span.row0, span.row1), range(span.col0, span.col1)
            self._needed = {Block(0, row, col) for row in rows for col in cols}
        self._fine = sum(self._weight(base) for base in self._needed)

    def _take(self, key: Block) -> bool:
        """Add a block and what belongs to it, if there is room."""
        base = self._base_of(key)
        reach = (0, 1) if key.level < 0 else (0,)
        around = {Block(0, base.row + r, base.col + c) for r in reach for c in reach}
        new = {one for one in around if self._is_there(one)} - self._needed
        fine = sum(self._weight(one) for one in new)
        if self._fine + fine > self._cache.detail_capacity:
            return False
        if self._below_top and len(self._needed) + len(new) > self._cache.capacity:
            return False
        self._needed |= new
        self._fine += fine
        return True

    def _is_there(self, key: Block) -> bool:
        span = self._span
        return span.row0 <= key.row < span.row1 and span.col0 <= key.col < span.col1

    def _weight(self, base: Block) -> int:
        """Detail blocks on a block, those included that the edit may make."""
        return len(self._coming.get(base, set()).union(self._cache.details(base)))
