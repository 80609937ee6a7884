"""Plots, the squares of posts by which ground wakes and sleeps: sets of them as rows of indices."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
import numpy.typing as npt

from terrasim.errors import InputError
from terrasim.grid import Span
from terrasim.kernels.relaxation import PLOT, PLOT_SHIFT

Plots = npt.NDArray[np.int64]
"""Row and column of each plot, shape ``(count, 2)``, sorted, none twice."""

MAX_PLOTS = 2**22
"""Most plots that can be given: four thousand million posts."""


def plots_of(regions: Iterable[Span], within: Span) -> Plots:
    """Plots that hold any post of rectangles of posts.

    Args:
        regions: Rectangles of posts.
        within: What of them counts.

    Raises:
        InputError: If there are more than ``MAX_PLOTS``, those in two rectangles counted twice.
    """
    spans = []
    total = 0
    for one in regions:
        cut = meet(one, within)
        if cut.row0 < cut.row1 and cut.col0 < cut.col1:
            span = _shifted(cut)
            total += area(span)
            spans.append(span)
    if total > MAX_PLOTS:
        raise InputError(
            f"rectangles to relax hold {total} plots of {PLOT} x {PLOT} posts, at most {MAX_PLOTS} "
            "can be worked on at once; relax a part at a time"
        )
    found = [np.mgrid[s.row0 : s.row1, s.col0 : s.col1].reshape(2, -1).T for s in spans]
    return unique(np.concatenate(found)) if found else np.empty((0, 2), np.int64)


def rects_of(plots: Plots, within: Span) -> tuple[Span, ...]:
    """Rectangles of posts that hold exactly the plots, as far as they count, in order."""
    found: list[Span] = []
    above: dict[tuple[int, int], int] = {}
    for row, runs in _runs(plots):
        here: dict[tuple[int, int], int] = {}
        for run in runs:
            at = above.get(run)
            if at is not None and found[at].row1 == row:
                found[at] = found[at]._replace(row1=row + 1)
            else:
                at = len(found)
                found.append(Span(row, row + 1, *run))
            here[run] = at
        above = here
    return tuple(meet(posts_of(span), within) for span in found)


def widened(plots: Plots) -> Plots:
    """Plots and the eight around each."""
    shifts = np.mgrid[-1:2, -1:2].reshape(2, -1).T
    return unique((plots[:, None, :] + shifts).reshape(-1, 2))


def unique(plots: Plots) -> Plots:
    """Plots sorted by row and column, each once."""
    if len(plots) == 0:
        return plots
    order = np.lexsort((plots[:, 1], plots[:, 0]))
    ordered = plots[order]
    new = np.append(True, (np.diff(ordered, axis=0) != 0).any(axis=1))
    found: Plots = ordered[new]
    return found


def bounds(plots: Plots) -> Span:
    """The smallest rectangle of plots that holds all."""
    row0, col0 = plots.min(axis=0).tolist()
    row1, col1 = plots.max(axis=0).tolist()
    return Span(row0, row1 + 1, col0, col1 + 1)


def grown(span: Span, by: int) -> Span:
    """A rectangle with a margin."""
    return Span(span.row0 - by, span.row1 + by, span.col0 - by, span.col1 + by)


def meet(one: Span, other: Span) -> Span:
    """What two rectangles share; a side is not positive if nothing."""
    return Span(
        max(one.row0, other.row0),
        min(one.row1, other.row1),
        max(one.col0, other.col0),
        min(one.col1, other.col1),
    )


def area(span: Span) -> int:
    """Plots, or posts, of a rectangle."""
    return (span.row1 - span.row0) * (span.col1 - span.col0)


def clusters(plots: Plots, gap: int) -> list[Span]:
    """Disjoint rectangles of plots that hold all, each with a margin, in order.

    Args:
        plots: Plots.
        gap: The margin; plots closer than it to one another come into one rectangle.
    """
    cells: dict[tuple[int, int], Span] = {}
    coarse = 2 * gap
    for row, col in plots.tolist():
        key = (row // coarse, col // coarse)
        cells[key] = _around(cells.get(key), Span(row, row + 1, col, col + 1))
    found: list[Span] = []
    while cells:
        key = next(iter(cells))
        found.append(grown(_component(cells, key), gap))
    return _apart(found)


def _component(cells: dict[tuple[int, int], Span], start: tuple[int, int]) -> Span:
    """Take a cell and all that hang together with it out of the cells."""
    whole = cells.pop(start)
    open_ = [start]
    while open_:
        row, col = open_.pop()
        for key in ((row + r, col + c) for r in (-1, 0, 1) for c in (-1, 0, 1)):
            if key in cells:
                whole = _around(whole, cells.pop(key))
                open_.append(key)
    return whole


def _apart(spans: Sequence[Span]) -> list[Span]:
    """Rectangles joined until no two overlap; the result does not depend on the order."""
    found: list[Span] = []
    for span in spans:
        one = span
        while True:
            hit = [other for other in found if area_of_meet(one, other) > 0]
            if not hit:
                break
            found = [other for other in found if other not in hit]
            for other in hit:
                one = _around(one, other)
        found.append(one)
    return sorted(found)


def area_of_meet(one: Span, other: Span) -> int:
    """How much two rectangles share."""
    both = meet(one, other)
    return max(0, both.row1 - both.row0) * max(0, both.col1 - both.col0)


def _around(one: Span | None, other: Span) -> Span:
    if one is None:
        return other
    return Span(
        min(one.row0, other.row0),
        max(one.row1, other.row1),
        min(one.col0, other.col0),
        max(one.col1, other.col1),
    )


def _runs(plots: Plots) -> Iterable[tuple[int, list[tuple[int, int]]]]:
    """Rows of plots, each with its runs of columns that follow one another."""
    ends = np.flatnonzero(np.diff(plots[:, 0])) + 1
    for part in np.split(plots, ends) if len(plots) else []:
        cols = part[:, 1]
        breaks = np.flatnonzero(np.diff(cols) != 1) + 1
        runs = [(int(run[0]), int(run[-1]) + 1) for run in np.split(cols, breaks)]
        yield int(part[0, 0]), runs


def _shifted(span: Span) -> Span:
    """The plots that hold a rectangle of posts."""
    return Span(
        span.row0 >> PLOT_SHIFT,
        ((span.row1 - 1) >> PLOT_SHIFT) + 1,
        span.col0 >> PLOT_SHIFT,
        ((span.col1 - 1) >> PLOT_SHIFT) + 1,
    )


def posts_of(span: Span) -> Span:
    """The posts of a rectangle of plots."""
    return Span(span.row0 * PLOT, span.row1 * PLOT, span.col0 * PLOT, span.col1 * PLOT)
