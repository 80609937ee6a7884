"""Ground in a store with a hole, an odd edge and room for detail: what is done to it, every bit."""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from hashlib import blake2b
from pathlib import Path
from typing import Any

import apsw
import numpy as np

import terrasim as ts
from terrasim.counts import HOLE, Counts
from terrasim.deform.operations import Operation, Relaxing, Stamping
from terrasim.deform.patch import Patch
from terrasim.grid import Block
from terrasim.store.build import build_store

GRID = ts.Grid(560, 540, 0.5, row=-40, col=10)
"""Twelve blocks at level 0, more than the smallest pool holds with those above them."""
FACTOR = 2
"""Detail cells along a cell's side."""
SMALL = 8 << 18
"""Bytes of the smallest pool."""
CORNER = (50.0, 128.0)
"""Where four blocks of level 0 meet, and no hole is near [m]."""

Bits = dict[Block, bytes]
"""Every block of level 0 and above, and every detail block that there is."""


@cache
def posts() -> Counts:
    """Gentle noise with a hole."""
    rng = np.random.default_rng(3)
    made: Counts = rng.normal(0, 200, (GRID.rows, GRID.cols)).astype(np.int32)
    made[60:63, 50] = HOLE
    return made


def source() -> ts.ArraySource:
    """The terrain in memory, as it was imported."""
    return ts.ArraySource(posts(), GRID)


def build(path: Path) -> Path:
    """The terrain as a store."""
    build_store(source(), GRID, path, provenance={"made": "here"})
    return path


def opened(path: Path, branch: str = "main", **options: Any) -> ts.Terrain:
    """The terrain with detail, on a branch of its store."""
    return ts.open_terrain(path, branch, detail_factor=FACTOR, **options)


def hill(x: float = 0.0, y: float = 0.0, **more: Any) -> ts.Gaussian:
    """A hill, on the corner of four blocks unless it stands beside it."""
    return ts.Gaussian(CORNER[0] + x, CORNER[1] + y, 1.3, 4.0, **more)


def operations(seed: int = 5) -> list[Operation]:
    """One of every kind, on top of each other and over corners, edges and the hole."""
    rng = np.random.default_rng(seed)
    x, y = rng.uniform(-4.0, 4.0, (2, 9)).tolist()
    pile = Patch(90, 250, rng.integers(0, 60_000, (40, 30), dtype=np.int32))
    fine = rng.integers(-3_000, 3_000, (50, 60), dtype=np.int32)
    return [
        Stamping((hill(x[0], y[0]), ts.Crater(40.0, 120.0 + y[1], 30.0, 2.0, 0.4))),
        Stamping((hill(x[2], y[2], detail=True), ts.ConeStamp(6.0, -18.0, 9.0, 1.0 / 3.0))),
        Stamping((hill(x[3], y[3], mode="fill", z=0.4),)),
        pile,
        Patch(2 * 300, 2 * 240, fine, detail=True),
        Relaxing((ts.Rect(60, 160, 230, 300),), 20.0, 12),
        Stamping((hill(x[4], y[4], detail=True, mode="dig", z=0.2),)),
        Stamping((ts.Crater(128.0 + x[5], 128.0 + y[5], 9.0, 2.0, 0.4),), (3, -4)),
        Stamping((hill(x[6], y[6]), hill(x[7], y[7], detail=True))),
        Stamping((ts.Crater(29.0 + x[8], 6.0, 8.0, 1.0),)),
    ]


def bits(terrain: ts.Terrain) -> Bits:
    """All posts of all blocks, whatever is in the pool."""
    terrain.settle()
    terrain.cache.flush()
    found = {}
    for level in range(terrain.grid.levels):
        span = terrain.grid.blocks(level)
        for row in range(span.row0, span.row1):
            for col in range(span.col0, span.col1):
                key = Block(level, row, col)
                details = terrain.cache.details(key) if level == 0 else []
                for one in (key, *details):
                    found[one] = terrain.ground.block(one).posts.tobytes()
    return found


def heights(found: Bits) -> int:
    """Sum of all heights of level 0 and of the detail [counts / FACTOR^3]."""
    total = 0
    for key, data in found.items():
        counts = np.frombuffer(data, np.int32).astype(np.int64)
        inside = counts[_inside(key)]
        if key.level == 0:
            total += FACTOR**3 * int(inside[inside != HOLE].sum())
        elif key.level < 0:
            total += int(inside.sum())
    return total


def _inside(key: Block) -> Any:
    """Which of a block's posts are the terrain's own."""
    factor = FACTOR if key.level < 0 else 1
    row0 = (GRID.row + (256 if key.level < 0 else 0)) * factor
    rows = np.arange(256) + 256 * key.row - row0
    cols = np.arange(256) + 256 * key.col - GRID.col * factor
    rows_in = (rows >= 0) & (rows <= (GRID.rows - 1) * factor)
    cols_in = (cols >= 0) & (cols <= (GRID.cols - 1) * factor)
    return np.outer(rows_in, cols_in).ravel()


def held(path: Path) -> bytes:
    """A hash of every row of every table of a store: its journal, its blocks and its names."""
    digest = blake2b()
    db = apsw.Connection(str(path), flags=apsw.SQLITE_OPEN_READONLY)
    try:
        db.execute("BEGIN")
        names = db.execute("SELECT name FROM sqlite_master WHERE type = 'table' ORDER BY name")
        for name in [name for (name,) in names]:
            digest.update(name.encode())
            for row in sorted(map(repr, db.execute(f"SELECT * FROM {name}"))):
                digest.update(row.encode())
    finally:
        db.close()
    return digest.digest()


def model(done: Sequence[Operation], **options: Any) -> Bits:
    """What the ground must be, worked out in memory."""
    from terrasim.deform.edits import edits_of

    with ts.Terrain(source(), detail_factor=FACTOR, **options) as terrain:
        for one in done:
            edits_of(terrain).commit(one)
        return bits(terrain)
