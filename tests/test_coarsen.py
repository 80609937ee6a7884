"""The rule of coarsening, against its definition applied one need at a time."""

from __future__ import annotations

import functools
import operator

import numpy as np
import pytest

from terrasim.cache.coarsen import Coarsened, coarsen
from terrasim.cache.needs import Boxes, Disc, Need, region_blocks
from terrasim.grid import Block, Grid

GRID = Grid(9000, 7000, 1.0, row=-4000, col=-3333)
TOP = frozenset(region_blocks(GRID, GRID.posts(GRID.top), GRID.top))


def defined(needs: list[Need], capacity: int) -> Coarsened:
    """The same in words: while too many, raise the finest, of those the largest, the first."""
    levels = [min(need.level, GRID.top) for need in needs]
    steps = 0
    while True:
        found = [need.blocks(GRID, level) for need, level in zip(needs, levels, strict=True)]
        blocks: list[Block] = list(dict.fromkeys(functools.reduce(operator.iadd, found, [])))
        if len(set(blocks) - TOP) <= capacity:
            break
        order = [
            (level, -len(keys), i)
            for i, (level, keys) in enumerate(zip(levels, found, strict=True))
        ]
        worst = min(entry for entry in order if entry[1])[2]
        levels[worst] += 1
        steps += 1
    raised = [
        keys
        for need, level, keys in zip(needs, levels, found, strict=True)
        if level > min(need.level, GRID.top)
    ]
    return Coarsened(blocks, frozenset(functools.reduce(operator.iadd, raised, [])), steps)


def some_needs(seed: int) -> list[Need]:
    """Discs and boxes that overlap, at several levels, some without a block."""
    random = np.random.default_rng(seed)
    needs: list[Need] = []
    for _ in range(int(random.integers(0, 12))):
        row, col = random.uniform(-4500.0, 5500.0), random.uniform(-3800.0, 4200.0)
        needs.append(
            Disc(row, col, float(random.choice([0.0, 90.0, 500.0])), int(random.integers(7)))
        )
        low = random.integers(-3000, 3000, (2, int(random.integers(0, 4))))
        needs.append(Boxes(low[0], low[0] + 300, low[1], low[1] + 20, int(random.integers(0, 3))))
    return needs


@pytest.mark.parametrize("capacity", [4, 7, 20, 60, 10_000])
@pytest.mark.parametrize("seed", range(20))
def test_the_result_is_as_defined(seed: int, capacity: int) -> None:
    needs = some_needs(seed)
    assert coarsen(needs, GRID, capacity, TOP) == defined(needs, capacity)


def test_what_fits_is_left_alone() -> None:
    need = Disc(0.0, 0.0, 300.0)
    blocks = need.blocks(GRID, 0)
    assert coarsen([need], GRID, len(blocks), TOP) == Coarsened(blocks, frozenset(), 0)
    assert coarsen([need], GRID, len(blocks) - 1, TOP).steps == 1


def test_the_top_costs_nothing() -> None:
    """A need for all of it fits beside what fills the capacity."""
    everything = Disc(0.0, 0.0, 9999.0, GRID.top)
    found = coarsen([everything, Disc(10.0, 10.0, 1.0)], GRID, 1, TOP)
    assert set(found.blocks) == {*TOP, Block(0, 0, 0)}
    assert found.steps == 0
