"""A terrain whose pools are small, for tests of what happens to detail in them."""

from __future__ import annotations

from detail_oracle import rough

from terrasim.cache.needs import Disc
from terrasim.cache.pool import BLOCK_BYTES
from terrasim.detail.grid import DetailGrid
from terrasim.grid import Block, Grid
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

FACTOR = 4
GRID = Grid(1500, 1500, 1.0, row=-300, col=-20)
DETAIL = DetailGrid(GRID, FACTOR)
BASES = [Block(0, row, col) for row in range(-2, 5) for col in range(-1, 6)]
ROUGH = ArraySource(rough(1500, 1500, 1), GRID)


def terrain_of(layers: int = 12, detail_layers: int = 8, **options: object) -> Terrain:
    """A terrain with small pools."""
    return Terrain(
        ROUGH,
        pool_bytes=layers * BLOCK_BYTES,
        detail_factor=FACTOR,
        detail_pool_bytes=detail_layers * BLOCK_BYTES,
        **options,  # type: ignore[arg-type]
    )


def on(base: Block, number: int = 0) -> Block:
    """One of a level-0 block's detail blocks."""
    span = DETAIL.blocks_in(base)
    return Block(-1, span.row0 + number // FACTOR, span.col0 + number % FACTOR)


def need(base: Block) -> Disc:
    """What needs one level-0 block alone."""
    return Disc(base.row * 256 + 128.0, base.col * 256 + 128.0, 10.0)


def crowd_out(terrain: Terrain, *spared: Block) -> None:
    """Bring in so many other blocks that all but these leave the pool."""
    for key in BASES:
        if key not in spared:
            terrain.cache.hold([key])
