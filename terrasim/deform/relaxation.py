"""Relaxation: ground steeper than its angle of repose slumps until it is not.

Only what is too steep moves, downhill, and nothing is lost: heights change by whole counts that
flow from post to post. What an iteration does depends on the ground nearby alone, so neither how
the regions are cut, nor how many iterations a call makes, nor the pool, nor the threads change a
bit of the result. Holes and the terrain's edge are walls.

Work goes by plots, squares of posts: those in which something flowed, and those around them, are
looked at in the next iteration, all others sleep and cost nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from terrasim.deform.ledger import Ledger
from terrasim.deform.plots import plots_of, rects_of
from terrasim.deform.relax_rounds import relax_plots
from terrasim.deform.slump import Repose
from terrasim.deform.target import Target, target_of
from terrasim.errors import InputError
from terrasim.grid import MAX_INDEX, Span
from terrasim.kernels.relaxation import PLOT
from terrasim.terrain import Terrain

Rect = Span
"""A half-open rectangle of posts: rows ``row0 <= r < row1``, columns likewise."""

REACH = 2 * PLOT
"""Posts beyond a region that each iteration may change or read at most."""
MAX_ANGLE_DEG = 89.0
"""Largest angle of repose [degrees]."""


@dataclass(frozen=True)
class Relaxed:
    """What a relaxation did and where it has not come to rest."""

    ledger: Ledger
    """What fell and rose, summed over the iterations; the two are equal, unless a difference of the
    detail grid met the end of its range, which is counted as clamped. A post counts once for each
    iteration that changed it."""
    awake: tuple[Rect, ...]
    """Where something still moved in the last iteration: the regions to go on with. None when all
    is at rest."""
    iterations: int
    """Iterations made; fewer than allowed if all came to rest."""
    moved: int
    """Counts that flowed from a post to the next, summed over edges and iterations [counts, of the
    detail grid's if it was that]."""


def relax(
    terrain: Terrain,
    regions: Sequence[Rect],
    *,
    angle_deg: float,
    iterations: int,
    detail: bool = False,
) -> Relaxed:
    """Let ground slump that is steeper than its angle of repose.

    The slope of a cell is the root of the mean square over its two triangles. Nothing begins to
    move below 3 counts a post more than the angle: so no ground at the angle, rounded to counts, is
    ever touched. One call with many iterations, or many calls that go on with what was ``awake``,
    give the same bits.

    Args:
        terrain: The terrain.
        regions: Rectangles of posts in which something may be too steep, of level 0 or of the
            detail grid if ``detail``. Ground further than a plot from them, and from what moves, is
            not looked at however steep. What lies beyond the terrain does not count.
        angle_deg: Angle of repose [degrees], 0 to 89.
        iterations: Most iterations, at least 1.
        detail: Let the detail grid's posts slump instead of the terrain's own.

    Returns:
        What moved and what is left to do.

    Raises:
        InputError: As :func:`check_relaxation`; nothing is changed then.
        RunError: If a block cannot be read or written; the ground may be half-changed then.
    """
    target = check_relaxation(
        terrain, regions, angle_deg=angle_deg, iterations=iterations, detail=detail
    )
    posts = _posts_of(target)
    repose = Repose(angle_deg, target.spacing, target.per_metre)
    done = relax_plots(terrain, plots_of(regions, posts), target, repose, iterations)
    return Relaxed(done.total(), rects_of(done.awake, posts), done.iterations, done.moved)


def check_relaxation(
    terrain: Terrain,
    regions: Sequence[Rect],
    *,
    angle_deg: float,
    iterations: int,
    detail: bool = False,
) -> Target:
    """Refuse what cannot be relaxed, before anything is allocated or changed.

    Returns:
        The posts that would slump.

    Raises:
        InputError: If the angle, the iterations or a rectangle is out of its range, the rectangles
            are too large for one call, or there is no detail grid.
    """
    check_angle(angle_deg)
    check_iterations(iterations)
    target = target_of(terrain, detail=detail)
    for region in regions:
        _check_region(region)
    plots_of(regions, _posts_of(target))
    return target


def check_angle(angle_deg: float) -> None:
    """Refuse an angle of repose that is none."""
    if not 0.0 <= angle_deg <= MAX_ANGLE_DEG:
        raise InputError(
            f"angle_deg must be from 0 to {MAX_ANGLE_DEG:g} degrees, got {angle_deg!r}"
        )


def check_iterations(iterations: object) -> None:
    """Refuse a number of iterations that is none."""
    if isinstance(iterations, bool) or not isinstance(iterations, int) or iterations < 1:
        raise InputError(f"iterations must be a whole number, at least 1, got {iterations!r}")


def _check_region(region: Rect) -> None:
    row0, row1, col0, col1 = region
    ends: tuple[object, ...] = region
    if not all(isinstance(one, int) and abs(one) <= MAX_INDEX for one in ends):
        raise InputError(
            f"a region to relax is four whole numbers within +-{MAX_INDEX}, got {tuple(region)}"
        )
    if row0 >= row1 or col0 >= col1:
        raise InputError(
            "a region to relax must have row0 < row1 and col0 < col1, "
            f"got rows {row0} to {row1}, columns {col0} to {col1}"
        )


def _posts_of(target: Target) -> Span:
    return Span(target.row, target.last_row + 1, target.col, target.last_col + 1)
