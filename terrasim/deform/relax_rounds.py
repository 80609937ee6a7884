"""Rounds of a relaxation: ground is read into memory, slumps there, and is written back.

All windows of a round go through the same number of iterations, as long as none needs ground that
it has not; what is too large for memory goes through one iteration at a time, square by square.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from terrasim.deform.ledger import Ledger
from terrasim.deform.patch import Patch, apply_patch
from terrasim.deform.plots import (
    Plots,
    area,
    bounds,
    clusters,
    grown,
    meet,
    posts_of,
    unique,
    widened,
)
from terrasim.deform.slump import Moved, Repose, Scratch, Slump
from terrasim.deform.target import Target
from terrasim.deform.window import NO_GROUND, read_window
from terrasim.grid import Span
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT
from terrasim.terrain import Terrain

ROOM = 4
"""Plots around those awake that a window holds: three to spread to and one that is only read."""
MOST_PLOTS = 4096
"""Plots in all windows of a round: four million posts, 170 MB while they are read."""
MOST_WINDOWS = 64
"""Windows of a round."""
SQUARE = 32
"""Plots along a side of the squares that are worked on one by one if all are too many."""
_MOST = 2**31 - 1


@dataclass
class Progress:
    """How far a relaxation has come."""

    awake: Plots
    """Plots still awake."""
    iterations: int = 0
    """Iterations made."""
    moved: int = 0
    """Sum of what flowed [counts]."""
    ledger: Ledger = field(default_factory=Ledger)
    """What flowed to and from the posts."""
    written: Ledger = field(default_factory=Ledger)
    """What was written, in which what came to a post and went again does not show."""

    def note(self, step: Moved, unit: int) -> None:
        """Take in what an iteration did in a window."""
        self.moved += step.moved
        self.ledger += Ledger(step.removed, step.added, step.posts, unit=unit)

    def total(self) -> Ledger:
        """What happened to the posts; where the range of heights was met, what was lost with it."""
        lost = self.written.net
        return self.ledger + Ledger(
            max(-lost, 0), max(lost, 0), clamped=self.written.clamped, unit=self.written.unit
        )


def relax_plots(
    terrain: Terrain, plots: Plots, target: Target, repose: Repose, iterations: int
) -> Progress:
    """Relax from some plots on until all sleep or the iterations are used up."""
    progress = Progress(plots)
    site = _Site(terrain, target, repose, Scratch(terrain.device))
    while len(progress.awake) and progress.iterations < iterations:
        spans = clusters(progress.awake, ROOM)
        if sum(area(span) for span in spans) <= MOST_PLOTS and len(spans) <= MOST_WINDOWS:
            windows = [_Window(site, span, progress.awake) for span in spans]
            _go_on(windows, progress, iterations)
            for window in windows:
                progress.written += window.write()
        else:
            _iterate_in_squares(site, progress)
    return progress


def _go_on(windows: list[_Window], progress: Progress, iterations: int) -> None:
    """Iterate over all windows together until one needs more ground or nothing is left to do."""
    while progress.iterations < iterations:
        for window in windows:
            if window.awake.any():
                window.iterate(progress)
        progress.iterations += 1
        progress.awake = unique(np.concatenate([window.plots() for window in windows]))
        if not len(progress.awake) or any(window.is_full() for window in windows):
            return


def _iterate_in_squares(site: _Site, progress: Progress) -> None:
    """One iteration; a square is written only when those around it have read it."""
    near = widened(progress.awake)
    waiting: list[tuple[int, _Window]] = []
    left = []
    for row, own in _squares(near):
        while waiting and waiting[0][0] < row - 1:
            progress.written += waiting.pop(0)[1].write()
        span = grown(bounds(own), 1)
        window = _Window(site, span, progress.awake)
        window.iterate(progress, window.map_of(own))
        left.append(window.plots())
        window.drop()
        waiting.append((row, window))
    for _, window in waiting:
        progress.written += window.write()
    progress.awake = unique(np.concatenate(left))
    progress.iterations += 1


def _squares(plots: Plots) -> Iterator[tuple[int, Plots]]:
    """Plots by the square they lie in, row after row of squares, each with its row."""
    keys = plots // SQUARE
    order = np.lexsort((keys[:, 1], keys[:, 0]))
    ordered, keys = plots[order], keys[order]
    ends = np.flatnonzero((np.diff(keys, axis=0) != 0).any(axis=1)) + 1
    for part in np.split(ordered, ends):
        yield int(part[0, 0]) // SQUARE, part


class _Site(NamedTuple):
    """What all windows of a relaxation share."""

    terrain: Terrain
    target: Target
    repose: Repose
    scratch: Scratch


class _Window:
    """A rectangle of plots in memory."""

    def __init__(self, site: _Site, span: Span, awake: Plots) -> None:
        self._site, self._span = site, span
        self._before = _read(site.terrain, posts_of(span), site.target)
        self._slump: Slump | None = Slump(
            self._before, site.repose, site.scratch, threads=site.terrain.threads
        )
        self._change: npt.NDArray[np.int64] | None = None
        self.awake = self.map_of(awake)

    def map_of(self, plots: Plots) -> npt.NDArray[np.bool_]:
        """Which of the window's plots are among these."""
        span = self._span
        found = np.zeros((span.row1 - span.row0, span.col1 - span.col0), dtype=np.bool_)
        at = plots - (span.row0, span.col0)
        at = at[((at >= 0) & (at < found.shape)).all(axis=1)]
        found[at[:, 0], at[:, 1]] = True
        return found

    def iterate(self, progress: Progress, own: npt.NDArray[np.bool_] | None = None) -> None:
        """One iteration; only the plots of ``own``, if given, may change."""
        assert self._slump is not None
        step = self._slump.iterate(self.awake, own)
        self.awake = step.awake
        progress.note(step, self._site.target.unit)

    def plots(self) -> Plots:
        """Plots that are awake."""
        corner = np.array([self._span.row0, self._span.col0])
        found: Plots = np.argwhere(self.awake) + corner
        return found

    def is_full(self) -> bool:
        """Whether the next iteration needs ground that the window has not."""
        edges = (self.awake[0], self.awake[-1], self.awake[:, 0], self.awake[:, -1])
        return any(bool(edge.any()) for edge in edges)

    def drop(self) -> None:
        """Keep of the window only what changed."""
        if self._slump is not None:
            change = self._slump.heights() - self._before
            self._change = np.where(np.isnan(change), 0.0, change).astype(np.int64)
            self._slump = None
            self._before = np.empty((0, 0))

    def write(self) -> Ledger:
        """Put what changed to the ground; returns what that did."""
        self.drop()
        assert self._change is not None
        posts = posts_of(self._span)
        ledger = Ledger(unit=self._site.target.unit)
        detail = self._site.target.level < 0
        for patch in _patches(self._change, posts.row0, posts.col0, detail=detail):
            ledger += apply_patch(self._site.terrain, patch)
        return ledger


def _read(terrain: Terrain, posts: Span, target: Target) -> npt.NDArray[np.float64]:
    """Heights of posts [counts]; NaN for holes and beyond the terrain."""
    found = np.full((posts.row1 - posts.row0, posts.col1 - posts.col0), np.nan)
    cut = meet(posts, Span(target.row, target.last_row + 1, target.col, target.last_col + 1))
    rows, cols = cut.row1 - cut.row0, cut.col1 - cut.col0
    if rows > 0 and cols > 0:
        counts = read_window(terrain, cut.row0, cut.col0, rows, cols, target.level < 0)
        row, col = cut.row0 - posts.row0, cut.col0 - posts.col0
        found[row : row + rows, col : col + cols] = np.where(counts == NO_GROUND, np.nan, counts)
    return found


def _patches(
    change: npt.NDArray[np.int64], row0: int, col0: int, *, detail: bool
) -> Iterator[Patch]:
    """Patches that make a change: no block without a change is touched."""
    for row in _blocks(row0, change.shape[0]):
        band = change[row]
        run: list[slice] = []
        for col in [*_blocks(col0, change.shape[1]), slice(0, 0)]:
            if band[:, col].any():
                run.append(col)
                continue
            if run:
                first = run[0].start
                part = band[:, first : run[-1].stop]
                yield from _patch(part, row0 + row.start, col0 + first, detail=detail)
            run = []


def _blocks(first: int, count: int) -> list[slice]:
    """Ranges of an array of posts, one for each block; the first post is number ``first``."""
    edges = range((first >> BLOCK_SHIFT) * BLOCK, first + count, BLOCK)
    return [slice(max(edge - first, 0), min(edge + BLOCK - first, count)) for edge in edges]


def _patch(part: npt.NDArray[np.int64], row0: int, col0: int, *, detail: bool) -> Iterator[Patch]:
    """A change cut to where it is not zero; two patches where one cannot hold it."""
    rows, cols = np.flatnonzero(part.any(axis=1)), np.flatnonzero(part.any(axis=0))
    row, col = int(rows[0]), int(cols[0])
    cut = part[row : int(rows[-1]) + 1, col : int(cols[-1]) + 1]
    while cut.any():
        now = np.clip(cut, -_MOST, _MOST)
        yield Patch(row0 + row, col0 + col, now.astype(np.int32), detail)
        cut = cut - now
