"""Coarsening by rule: what is required is made to fit, whatever was resident and however fast."""

from __future__ import annotations

import heapq
from collections import Counter
from collections.abc import Callable, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass

from terrasim.cache.needs import Need
from terrasim.grid import Block, Grid


@dataclass(frozen=True)
class Coarsened:
    """Blocks that needs get together."""

    blocks: list[Block]
    """Each once, in the order of the needs."""
    raised: frozenset[Block]
    """Those that stand in for finer ones."""
    steps: int
    """How often a need was moved up one level."""


def coarsen(
    needs: Sequence[Need],
    grid: Grid,
    capacity: int,
    free: AbstractSet[Block],
    details: Callable[[Block], int] | None = None,
    room: int = 0,
) -> Coarsened:
    """Raise needs, level by level, until their blocks fit.

    First those whose detail does not fit are raised to level 1, the one with most detail first.
    Then the need at the finest level goes first, of those the one with most blocks, of those the
    first.

    Args:
        needs: What is asked for; a level above the top counts as the top.
        grid: The terrain's grid.
        capacity: Most blocks there may be beside the free ones.
        free: Blocks that cost nothing: all of the top.
        details: Number of detail blocks on a block; None if there are none at all.
        room: Most detail blocks there may be on blocks beside the free ones.
    """
    levels = [min(need.level, grid.top) for need in needs]
    found = [need.blocks(grid, level) for need, level in zip(needs, levels, strict=True)]
    raised: dict[int, int] = {}
    if details is not None:
        raised = dict.fromkeys(_too_detailed(found, free, details, room), 1)
    for i in raised:
        levels[i], found[i] = 1, needs[i].blocks(grid, 1)
    blocks = dict.fromkeys(key for keys in found for key in keys)
    if len(blocks) <= capacity and not raised:
        return Coarsened(list(blocks), frozenset(), 0)
    # How many needs have a block: a raised one gives back what no other has.
    shares = Counter(key for keys in found for key in keys if key not in free)
    queue = [(levels[i], -len(keys), i) for i, keys in enumerate(found) if keys]
    heapq.heapify(queue)
    while len(shares) > capacity:
        level, _, i = queue[0]
        for key in found[i]:
            shares[key] -= 1
            if shares[key] <= 0:
                del shares[key]
        found[i] = needs[i].blocks(grid, level + 1)
        shares.update(key for key in found[i] if key not in free)
        heapq.heapreplace(queue, (level + 1, -len(found[i]), i))
        raised[i] = raised.get(i, 0) + 1
    return Coarsened(
        list(dict.fromkeys(key for keys in found for key in keys)),
        frozenset(key for i in raised for key in found[i]),
        sum(raised.values()),
    )


def _too_detailed(
    found: Sequence[Sequence[Block]],
    free: AbstractSet[Block],
    details: Callable[[Block], int],
    room: int,
) -> list[int]:
    """Needs to be raised so that the detail of the rest fits, in the order of raising."""
    counts = {key: details(key) for keys in found for key in keys if key not in free}
    total = sum(counts.values())
    if total <= room:
        return []
    shares = Counter(key for keys in found for key in keys if counts.get(key, 0) > 0)
    weight = [sum(counts.get(key, 0) for key in keys) for keys in found]
    raised = []
    for i in sorted(range(len(found)), key=lambda i: -weight[i]):
        if total <= room:
            break
        for key in found[i]:
            shares[key] -= 1
            if shares[key] == 0:
                total -= counts[key]
        raised.append(i)
    return raised
