"""What of the ground fits into the pool at once."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Set
from dataclasses import dataclass, field

from terrasim.cache.cache import Cache
from terrasim.grid import Block
from terrasim.terrain import Terrain


@dataclass(frozen=True)
class Room:
    """The room in a terrain's pool. A block of level 0 takes all its detail with it."""

    capacity: int
    """Blocks beside the coarsest level; at least four, or all."""
    top: int
    """The coarsest level, which is always there."""
    detail_capacity: int = 0
    """Blocks of detail."""
    cache: Cache | None = field(default=None, repr=False)
    """Who knows how much detail there is; None if there is none."""

    @classmethod
    def of(cls, terrain: Terrain) -> Room:
        """The room in a terrain's pool."""
        cache = terrain.cache
        if terrain.detail.factor == 1:
            return cls(cache.capacity, terrain.grid.top)
        return cls(cache.capacity, terrain.grid.top, cache.detail_capacity, cache)

    def holds(self, keys: Set[Block]) -> bool:
        """Whether blocks fit together."""
        beside = len(keys)
        if beside > self.capacity:
            beside = sum(key.level < self.top for key in keys)
        if beside > self.capacity:
            return False
        if self.cache is None or self.top == 0:
            return True
        return sum(map(self.cache.detail_count, keys)) <= self.detail_capacity

    def groups(self, keys: Iterable[Block], most: int) -> Iterator[list[Block]]:
        """Blocks in order, as many at a time as fit, at least one and at most ``most``."""
        group: list[Block] = []
        for key in keys:
            if group and (len(group) == most or not self.holds({*group, key})):
                yield group
                group = []
            group.append(key)
        if group:
            yield group
