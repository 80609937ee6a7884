"""Levels by sub-sampling, and how far each lies from level 0.

Both are streamed from the south: a terrain is never in memory, only some rows of blocks of it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, Protocol

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.counts import HOLE, Counts
from terrasim.errors import RunError
from terrasim.grid import Block, Grid
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT
from terrasim.kernels.pyramid import cell_error
from terrasim.sources.source import Source

Errors = npt.NDArray[np.int64]


class Rows(Protocol):
    """Level-0 posts that come in rows from south to north."""

    def read_rows(self, row: int, count: int) -> Counts:
        """Rows ``row`` to ``row + count - 1``, counted from the terrain's southern edge.

        Returns:
            Counts, shape ``(count, grid.cols)``, int32.
        """
        ...


class SourceRows:
    """The level-0 posts of any source, row by row."""

    def __init__(self, source: Source) -> None:
        """Take the source."""
        self._source = source

    def read_rows(self, row: int, count: int) -> Counts:
        """Rows ``row`` to ``row + count - 1``, counted from the southern edge."""
        grid = self._source.grid
        rows = grid.row + np.arange(row, row + count, dtype=np.int64)
        return self._source.posts(0, rows, grid.col + np.arange(grid.cols, dtype=np.int64))


class BlockRow(NamedTuple):
    """All blocks of one row of one level, side by side."""

    level: int
    row: int
    """Row of blocks."""
    posts: Counts
    """Counts, shape ``(BLOCK, blocks * BLOCK)``, from the level's first column of blocks on."""


def block_rows(rows: Rows, grid: Grid) -> Iterator[BlockRow]:
    """Every row of blocks of every level, from one reading of the level-0 posts.

    A row of blocks comes as soon as what it is sampled from has been read. About ``3 * BLOCK`` rows
    of level-0 posts are held.

    Raises:
        RunError: If the rows are not int32 or have not the grid's width.
    """
    lower: dict[int, Counts] = {}
    span = grid.blocks(0)
    for row in range(span.row0, span.row1):
        yield from _rise(grid, lower, BlockRow(0, row, _level0(rows, grid, row)))


def _level0(rows: Rows, grid: Grid, row: int) -> Counts:
    """One row of level-0 blocks, with the terrain's edge carried on."""
    first = max(row * BLOCK, grid.row)
    last = min((row + 1) * BLOCK, grid.row + grid.rows)
    posts = rows.read_rows(first - grid.row, last - first)
    if posts.dtype != np.int32 or posts.shape != (last - first, grid.cols):
        raise RunError(
            f"rows {first} to {last - 1} came as {posts.dtype} of shape {posts.shape}, "
            f"the grid expects int32 of {(last - first, grid.cols)}"
        )
    span = grid.blocks(0)
    west = grid.col - span.col0 * BLOCK
    east = span.col1 * BLOCK - grid.col - grid.cols
    around = ((first - row * BLOCK, (row + 1) * BLOCK - last), (west, east))
    return np.pad(posts, around, mode="edge") if any(map(any, around)) else posts


def _rise(grid: Grid, lower: dict[int, Counts], made: BlockRow) -> Iterator[BlockRow]:
    """Hand on a row of blocks, and the coarser ones that are complete with it.

    ``lower`` keeps, a level, the southern half of the row of blocks that is being put together.
    """
    yield made
    level, row, posts = made
    if level == grid.top:
        return
    here, above = grid.blocks(level), grid.blocks(level + 1)
    if row == here.row0 and row & 1:
        lower[level + 1] = _half(grid, level, np.repeat(posts[:1], BLOCK, axis=0))
    halves = [(row, posts)]
    if row == here.row1 - 1:
        edge = np.repeat(posts[-1:], BLOCK, axis=0)
        halves += [(beyond, edge) for beyond in range(row + 1, 2 * above.row1)]
    for at, whole in halves:
        half = _half(grid, level, whole)
        if at & 1:
            up = BlockRow(level + 1, at >> 1, np.concatenate((lower.pop(level + 1), half)))
            yield from _rise(grid, lower, up)
        else:
            lower[level + 1] = half


def _half(grid: Grid, level: int, posts: Counts) -> Counts:
    """Every second post of a row of blocks, widened to whole blocks of the next level."""
    here, above = grid.blocks(level), grid.blocks(level + 1)
    west = (here.col0 - 2 * above.col0) * (BLOCK // 2)
    east = (2 * above.col1 - here.col1) * (BLOCK // 2)
    middle = posts[::2, ::2]
    # The outermost posts of a level stand on the terrain's edge or beyond it.
    return np.concatenate(
        (
            np.repeat(posts[::2, :1], west, axis=1),
            middle,
            np.repeat(posts[::2, -1:], east, axis=1),
        ),
        axis=1,
    )


def cell_errors(
    fine: Counts, fine_at: tuple[int, int], coarse: Counts, coarse_at: tuple[int, int], level: int
) -> Errors:
    """Largest vertical distance of each coarse cell's surface from the level-0 posts given.

    The level-0 triangulation refines the coarse one, so the distance between the two surfaces is
    reached at a post. A post is compared where it is ground and lies on a coarse triangle whose
    corners are; of the others nothing is said.

    Args:
        fine: Level-0 counts, shape ``(rows, cols)``, over all columns of the cells and at least
            some of their rows.
        fine_at: Level-0 row and column of the first of them.
        coarse: Counts of the level, shape ``(cell rows + 1, cell cols + 1)``.
        coarse_at: Row and column, at the level, of the first of them.
        level: The level, at least 1.

    Returns:
        Distances [counts], rounded up, shape ``(cell rows, cell cols)``.
    """
    shape = (coarse.shape[0] - 1, coarse.shape[1] - 1)
    errors = np.empty(shape, dtype=np.int64)
    wp.launch(
        cell_error,
        dim=shape,
        inputs=[_on_cpu(fine), *fine_at, _on_cpu(coarse), *coarse_at, level],
        outputs=[wp.array(errors, dtype=wp.int64, device="cpu", copy=False)],
        device="cpu",
    )
    return errors


def _on_cpu(posts: Counts) -> wp.array[Any, Any]:
    return wp.array(np.ascontiguousarray(posts), dtype=wp.int32, device="cpu", copy=False)


class LevelErrors(NamedTuple):
    """What sub-sampling cost at one level."""

    error: Errors
    """Largest vertical distance from level 0 [counts], rounded up, shape of ``grid.blocks(level)``.

    It is taken over the cells whose (x-, y-) post is the block's, the extended edge included."""
    skipped: int
    """Triangles inside the terrain that a hole at a corner takes out of the comparison."""


def level_errors(
    source: Source,
    *,
    strip: int = BLOCK,
    progress: Callable[[float], None] | None = None,
) -> list[LevelErrors]:
    """Exact errors of every block of every level.

    Args:
        source: The terrain. Its level-0 posts are read once, from the south.
        strip: Rows of level-0 posts held at once; a coarse cell may be taller.
        progress: Called with the fraction done after each strip.

    Returns:
        One entry a level; all zero at level 0.
    """
    grid = source.grid
    errors = [np.zeros(_shape(grid, level), dtype=np.int64) for level in range(grid.levels)]
    skipped = [0] * grid.levels
    if grid.top > 0:
        top = grid.posts(grid.top)
        # Cells one beyond the terrain's first posts belong to their blocks: what lies further out
        # repeats them.
        low, high = (top.row0 - 1) << grid.top, top.row1 << grid.top
        west, east = (top.col0 - 1) << grid.top, top.col1 << grid.top
        cols = np.arange(west, east + 1, dtype=np.int64)
        for row, fine in _strips(source, low, high, cols, strip):
            for level in range(1, grid.levels):
                skipped[level] += _measure(source, level, fine, (row, west), errors[level])
            if progress is not None:
                progress((row + len(fine) - 1 - low) / (high - low))
    return [LevelErrors(e, s) for e, s in zip(errors, skipped, strict=True)]


def block_error(source: Source, key: Block) -> int:
    """Exact error of one block [counts], rounded up: see ``LevelErrors``."""
    if key.level == 0:
        return 0
    grid, level = source.grid, key.level
    span = grid.posts(level)
    row0, row1 = max(key.row * BLOCK, span.row0 - 1), min((key.row + 1) * BLOCK, span.row1)
    col0, col1 = max(key.col * BLOCK, span.col0 - 1), min((key.col + 1) * BLOCK, span.col1)
    cols = np.arange(col0 << level, (col1 << level) + 1, dtype=np.int64)
    coarse_cols = np.arange(col0, col1 + 1, dtype=np.int64)
    worst = 0
    for row, fine in _strips(source, row0 << level, row1 << level, cols, BLOCK):
        first, last = row >> level, (row + len(fine) - 2) >> level
        coarse = source.posts(level, np.arange(first, last + 2, dtype=np.int64), coarse_cols)
        cells = cell_errors(fine, (row, col0 << level), coarse, (first, col0), level)
        worst = max(worst, int(cells.max()))
    return worst


def _shape(grid: Grid, level: int) -> tuple[int, int]:
    span = grid.blocks(level)
    return span.row1 - span.row0, span.col1 - span.col0


def _strips(
    source: Source, low: int, high: int, cols: npt.NDArray[np.int64], strip: int
) -> Iterator[tuple[int, Counts]]:
    """Level-0 rows ``low`` to ``high`` in strips that share a border row; each row is read once."""
    last = source.posts(0, np.array([low], dtype=np.int64), cols)
    for row in range(low, high, strip):
        end = min(row + strip, high)
        new = source.posts(0, np.arange(row + 1, end + 1, dtype=np.int64), cols)
        yield row, np.concatenate((last, new))
        last = new[-1:]


def _measure(
    source: Source, level: int, fine: Counts, fine_at: tuple[int, int], worst: Errors
) -> int:
    """Take a strip into a level's errors; returns the skipped triangles that begin in it."""
    span, blocks = source.grid.posts(level), source.grid.blocks(level)
    row = fine_at[0]
    first = max(row >> level, span.row0 - 1, blocks.row0 * BLOCK)
    last = min((row + len(fine) - 2) >> level, span.row1 - 1)
    if first > last:
        return 0
    col = max(span.col0 - 1, blocks.col0 * BLOCK)
    cols = np.arange(col, span.col1 + 1, dtype=np.int64)
    coarse = source.posts(level, np.arange(first, last + 2, dtype=np.int64), cols)
    cells = cell_errors(fine, fine_at, coarse, (first, col), level)
    starts = np.flatnonzero((cols[:-1] % BLOCK == 0) | (cols[:-1] == col))
    by_block = np.maximum.reduceat(cells, starts, axis=1)
    for r, errors in enumerate(by_block, first):
        into = worst[(r >> BLOCK_SHIFT) - blocks.row0]
        np.maximum(into, errors, out=into)
    # Cells between the terrain's own posts, each in the strip that holds its first row.
    inside = coarse[max(-(-row >> level), span.row0) - first : span.row1 - first, span.col0 - col :]
    return _holed_triangles(inside[:, : span.col1 - span.col0])


def _holed_triangles(posts: Counts) -> int:
    hole = posts == HOLE
    if not hole.any():
        return 0
    diagonal = hole[:-1, :-1] | hole[1:, 1:]
    return int((diagonal | hole[:-1, 1:]).sum() + (diagonal | hole[1:, :-1]).sum())
