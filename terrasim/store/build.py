"""From rows of posts to a store: one pass from the south, and a second over what it wrote.

The store grows beside its final name and takes that name when it is whole and on the disk. A build
that is killed leaves a file that cannot be mistaken for a store, and that the next build empties.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import apsw
import numpy as np

from terrasim.counts import HOLE, Counts
from terrasim.errors import InputError
from terrasim.grid import Block, Grid
from terrasim.kernels.addressing import BLOCK
from terrasim.store.acknowledged import Claim
from terrasim.store.opening import require_store
from terrasim.store.pyramid import BlockRow, Rows, block_rows, level_errors
from terrasim.store.store_file import BUILDING, writing
from terrasim.store.store_writer import StoreWriter
from terrasim.store.unfinished import unfinished

Progress = Callable[[float, str], None]
"""Takes the fraction done and what is being done."""

_LEVELS_SHARE = 0.6


@dataclass(frozen=True)
class BuildReport:
    """What a build made."""

    path: Path
    """The store."""
    posts: int
    """Level-0 posts."""
    holes: int
    """Level-0 posts without ground."""
    lowest: int
    """Smallest count of level 0; ``HOLE`` if all posts are holes."""
    highest: int
    """Largest count of level 0; ``HOLE`` if all posts are holes."""
    blocks: int
    """Blocks of all levels."""
    blobs: int
    """Different blocks: what is stored."""
    bytes: int
    """Size of the file."""
    errors: tuple[int, ...]
    """Largest vertical distance from level 0 [counts], a level."""
    skipped: tuple[int, ...]
    """Triangles with a hole at a corner, of which no error speaks, a level."""
    seconds: float
    """Wall time."""


def build_store(
    rows: Rows,
    grid: Grid,
    path: str | Path,
    *,
    provenance: object,
    synthetic: str = "",
    replace: bool = False,
    progress: Progress | None = None,
) -> BuildReport:
    """Build a store from level-0 rows.

    Memory holds some rows of blocks, about 5 kB a column of posts, however many rows there are.

    Args:
        rows: The level-0 posts; each row is read once, from the south.
        grid: Their placement.
        path: The store to make. Nothing is there before it is complete.
        provenance: Where the heights come from, as JSON can hold it, or a function without
            arguments that says so when all rows have been read.
        synthetic: What part of the heights is invented; empty if none is.
        replace: Put the new store in the place of one that is there.
        progress: Called now and then.

    Returns:
        What was made.

    Raises:
        InputError: If nothing may be written at ``path``, there is something already, or the
            provenance is not JSON.
        RunError: If the disk is full, or another process builds or uses the same store.
    """
    path, started = Path(path), time.monotonic()
    if not callable(provenance):
        _require_json(provenance)
    require_place(path, replace)
    tell = progress or _silent
    with unfinished(path, BUILDING) as growing:
        with writing(path), StoreWriter(growing) as writer:
            summary = _write_levels(writer, rows, grid, tell)
            levels = _write_errors(writer, grid, tell)
            said = provenance() if callable(provenance) else provenance
            _require_json(said)
            writer.finish(grid, synthetic, said, {**summary, "levels": levels})
        size = growing.stat().st_size
        if path.exists():
            retire(path)
    tell(1.0, "done")
    return BuildReport(
        path=path,
        posts=grid.rows * grid.cols,
        bytes=size,
        errors=tuple(level["error"] for level in levels),
        skipped=tuple(level["skipped"] for level in levels),
        seconds=time.monotonic() - started,
        **summary,
    )


def _silent(fraction: float, message: str, /) -> None:
    pass


def _write_levels(writer: StoreWriter, rows: Rows, grid: Grid, tell: Progress) -> dict[str, int]:
    """First pass: every block of every level; returns what was seen of level 0."""
    whole = _block_rows(grid)
    blocks = holes = 0
    lowest = highest = HOLE
    for done, made in enumerate(block_rows(rows, grid), 1):
        for key, posts in _blocks(grid, made):
            data = writer.add(key, posts)
            blocks += 1
            if key.level == 0 and data.lowest != HOLE:
                lowest = data.lowest if lowest == HOLE else min(lowest, data.lowest)
                highest = max(highest, data.highest)
        if made.level == 0:
            holes += int(np.count_nonzero(_inside(grid, made) == HOLE))
        tell(_LEVELS_SHARE * done / whole, "writing levels")
    return {
        "blocks": blocks,
        "blobs": writer.blobs(),
        "holes": holes,
        "lowest": lowest,
        "highest": highest,
    }


def _write_errors(writer: StoreWriter, grid: Grid, tell: Progress) -> list[dict[str, int]]:
    """Second pass: the exact error of every block, read back from what the first one wrote."""

    def on(fraction: float) -> None:
        tell(_LEVELS_SHARE + (1.0 - _LEVELS_SHARE) * fraction, "measuring errors")

    levels = []
    for level, (error, skipped) in enumerate(level_errors(writer.written(grid), progress=on)):
        span = grid.blocks(level)
        for (row, col), counts in np.ndenumerate(error):
            # Blocks begin with an error of 0.
            if counts:
                writer.set_error(Block(level, span.row0 + row, span.col0 + col), int(counts))
        levels.append({"blocks": error.size, "error": int(error.max()), "skipped": skipped})
    return levels


def _block_rows(grid: Grid) -> int:
    spans = (grid.blocks(level) for level in range(grid.levels))
    return sum(span.row1 - span.row0 for span in spans)


def _blocks(grid: Grid, made: BlockRow) -> Iterator[tuple[Block, Counts]]:
    """The blocks of a row, from the west."""
    for at, col in enumerate(range(*grid.blocks(made.level)[2:])):
        yield Block(made.level, made.row, col), made.posts[:, at * BLOCK : (at + 1) * BLOCK]


def _inside(grid: Grid, made: BlockRow) -> Counts:
    """A row of level-0 blocks without the extended edge."""
    row, col = made.row * BLOCK, grid.blocks(0).col0 * BLOCK
    north = grid.row + grid.rows - row
    west = grid.col - col
    return made.posts[max(grid.row - row, 0) : north, west : west + grid.cols]


def _require_json(provenance: object) -> None:
    try:
        json.dumps(provenance, allow_nan=False)
    except (TypeError, ValueError) as error:
        raise InputError(f"the provenance must be JSON, got something else: {error}") from None


def require_place(path: Path, replace: bool) -> None:
    """Refuse a path at which no store can be made.

    Raises:
        InputError: If there is something already, or no folder.
    """
    if path.exists() and not replace:
        raise InputError(f"{path} exists; remove it or choose another name")
    if not path.parent.is_dir():
        raise InputError(f"there is no folder {path.parent} for {path.name}; make it first")


def retire(path: Path) -> None:
    """Refuse to replace what is no store or is in use; bring it back into one file.

    Raises:
        InputError: If it is no store.
        RunError: If somebody uses it.
    """
    claim = Claim(path)
    try:
        _one_file(path)
    except BaseException:
        claim.release(well=False)
        raise
    # What was acknowledged of the old store says nothing of the new one.
    claim.release(well=True)


def _one_file(path: Path) -> None:
    with writing(path):
        old = apsw.Connection(str(path.absolute()), apsw.SQLITE_OPEN_READWRITE)
        try:
            require_store(path, old)
            # Only a file that nobody else has open leaves this mode, and its log goes with it.
            old.pragma("journal_mode", "delete")
        finally:
            old.close(True)
