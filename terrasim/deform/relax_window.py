"""Relaxation of an array of heights by itself, without a terrain."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.deform.slump import Repose, Scratch, Slump
from terrasim.errors import InputError
from terrasim.grid import Span
from terrasim.kernels.detail import NO_GROUND
from terrasim.kernels.relaxation import PLOT
from terrasim.terrain import open_device


@dataclass(frozen=True)
class WindowRelaxed:
    """What a relaxation did to an array."""

    change: npt.NDArray[np.int64]
    """By how much each post rose [counts], shape as the heights; the sum is 0."""
    awake: Span | None
    """A rectangle that holds all posts that may still move; None if all are at rest."""
    iterations: int
    """Iterations made; fewer than allowed if all came to rest."""
    moved: int
    """Counts that flowed from a post to the next, summed over edges and iterations."""


def relax_window(
    heights: npt.NDArray[np.signedinteger[Any]],
    repose: Repose,
    *,
    iterations: int,
    device: str = "cpu",
    threads: int = 1,
    part: int | None = None,
) -> WindowRelaxed:
    """Let an array of heights slump to its angle of repose.

    Turning or mirroring the array turns or mirrors the result, to the bit. The array's edges are
    walls.

    Args:
        heights: Heights [counts], shape ``(rows, cols)``; the smallest number of their type and
            ``kernels.detail.NO_GROUND`` mark a hole.
        repose: How steep the ground stays.
        iterations: Most iterations.
        device: Warp device.
        threads: CPU threads.
        part: Plots along a side of what is worked on at once; the bits do not depend on it.

    Raises:
        InputError: If the heights are no array of whole numbers, or there is no such device.
    """
    values = np.asarray(heights)
    if values.ndim != 2 or values.size == 0 or values.dtype.kind != "i":
        raise InputError(
            "heights to relax must be a 2-D array of whole numbers, not empty, "
            f"got {values.dtype} of shape {values.shape}"
        )
    rows, cols = values.shape
    inside = (slice(PLOT, PLOT + rows), slice(PLOT, PLOT + cols))
    sheet = np.full([2 * PLOT - (-size // PLOT) * PLOT for size in values.shape], np.nan)
    hole = (values == np.iinfo(values.dtype).min) | (values == NO_GROUND)
    sheet[inside] = np.where(hole, np.nan, values)
    slump = Slump(sheet, repose, Scratch(open_device(device), part), threads=threads)
    awake = np.zeros(slump.shape, dtype=np.bool_)
    awake[1:-1, 1:-1] = True
    done = moved = 0
    while done < iterations and awake.any():
        step = slump.iterate(awake)
        awake, done, moved = step.awake, done + 1, moved + step.moved
    change = (slump.heights() - sheet)[inside]
    whole = np.where(np.isnan(change), 0.0, change).astype(np.int64)
    return WindowRelaxed(whole, _posts_around(awake, rows, cols), done, moved)


def _posts_around(awake: npt.NDArray[np.bool_], rows: int, cols: int) -> Span | None:
    """The posts of all plots that are awake, in one rectangle; a margin of one plot is left out."""
    if not awake.any():
        return None
    at_row, at_col = np.flatnonzero(awake.any(axis=1)), np.flatnonzero(awake.any(axis=0))
    return Span(
        (int(at_row[0]) - 1) * PLOT,
        min(int(at_row[-1]) * PLOT, rows),
        (int(at_col[0]) - 1) * PLOT,
        min(int(at_col[-1]) * PLOT, cols),
    )
