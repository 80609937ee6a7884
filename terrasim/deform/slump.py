"""Ground in memory that slumps: a rectangle of posts, worked on in parts that fit a cache.

Each part is worked on with a margin in scratch arrays for one iteration, and changes only its own
plots: how the parts are cut changes nothing.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.kernels import relaxation as kernels
from terrasim.kernels.relaxation import PLOT, SWEEPS
from terrasim.launch import launch

Heights = npt.NDArray[np.float64]
Plots = npt.NDArray[np.bool_]

START = 3.0
"""How much steeper than its angle of repose a cell must be to begin to slump [counts a post].

Rounding to counts makes a slope steeper by at most the root of two; more keeps what one iteration
rounds from waking the next.
"""
STEP = 0.2
"""Part of drop and excess that flows along an edge in a sweep; 0.25 would swing for ever."""
CARRY = 0.75
"""How much of what a steady excess would have brought a flow up to it may reach."""
FINEST = 2**20
"""Parts of a count of 10 micrometres at most: heights in parts are then exact in a float64."""
PARTS = 4096
"""Parts of a count that flows are counted in where that is not too fine."""
PART_PLOTS = 10
"""Plots along a side of a part on the CPU: with its margin 400 posts a side, 4 MB."""
CUDA_PART_PLOTS = 62
"""Plots along a side of a part on CUDA: 120 MB."""


@dataclass(frozen=True)
class Repose:
    """How steep ground stays."""

    angle_deg: float
    """Angle of repose [degrees], 0 to 89."""
    spacing: float
    """Distance between neighbouring posts [m]."""
    per_metre: float
    """Counts in a metre."""

    @property
    def slope(self) -> float:
        """Difference of neighbouring posts at the angle of repose [counts]."""
        return math.tan(math.radians(self.angle_deg)) * self.spacing * self.per_metre

    @property
    def parts(self) -> int:
        """Parts of a count that flows are counted in: a power of two."""
        finer = max(1, math.ceil(self.per_metre / 100_000))
        return min(PARTS, 1 << max(0, (FINEST // finer).bit_length() - 1))


class Moved(NamedTuple):
    """What an iteration did."""

    moved: int
    """Sum of what flowed along all edges [counts]."""
    removed: int
    """Sum of the falls [counts]."""
    added: int
    """Sum of the rises [counts]."""
    posts: int
    """Posts whose height changed."""
    awake: Plots
    """Plots to or from which something flowed, shape as the plots given."""


class Scratch:
    """Arrays of a part that is being worked on; what is in them does not matter."""

    def __init__(self, device: Any, part: int | None = None) -> None:
        """Allocate them.

        Args:
            device: Warp device.
            part: Plots along a side of a part, at least 1; the bits do not depend on it.
        """
        self.device = device
        self.part = part or (CUDA_PART_PLOTS if device.is_cuda else PART_PLOTS)
        self.across = self.part + 4
        """Plots along a side of the arrays: a part, the plots around it, which are worked on too,
        and those around these, which are only read and need not be known."""
        self.run = 1 if device.is_cuda else PLOT
        """Posts that a thread works on."""
        size = (self.across * PLOT) ** 2
        self.height: Any = wp.empty(size, dtype=wp.float64, device=device)
        self.flows = [self._blank(size) for _ in range(4)]
        """To the east and the north, in a sweep and in an iteration."""
        self.excess = self._blank(size)
        self.items: Any = wp.array(
            np.arange(size // self.run, dtype=np.int32), dtype=wp.int32, device=device
        )
        """Numbers of runs."""

    def _blank(self, size: int) -> Any:
        return wp.empty(size, dtype=wp.float32, device=self.device)


class Slump:
    """A rectangle of posts on the device."""

    def __init__(
        self, heights: Heights, repose: Repose, scratch: Scratch, *, threads: int = 1
    ) -> None:
        """Send the posts to the device.

        Args:
            heights: Heights [counts], whole numbers, NaN for holes; rows and columns are multiples
                of ``PLOT``.
            repose: How steep the ground stays.
            scratch: Arrays to work in.
            threads: CPU threads a launch may be split over.
        """
        self.shape = heights.shape[0] // PLOT, heights.shape[1] // PLOT
        """Plots along y and along x."""
        self._scratch, self._threads, self._part = scratch, threads, scratch.part
        self._runs = PLOT * PLOT // scratch.run
        self._sheet = _field(heights.shape[1], scratch.run, repose)
        self._field = _field(scratch.across * PLOT, scratch.run, repose)
        self._count = self._array(heights.ravel(), wp.float64)
        self._gain: Any = wp.empty(heights.size, dtype=wp.float64, device=scratch.device)

    def heights(self) -> Heights:
        """Heights as they are now [counts], shape ``(rows, cols)``; NaN for holes."""
        found: Heights = self._count.numpy().reshape(self.shape[0] * PLOT, self.shape[1] * PLOT)
        return found

    def iterate(self, awake: Plots, own: Plots | None = None) -> Moved:
        """One iteration.

        Args:
            awake: Plots in which something may be too steep, shape ``shape``.
            own: Plots that may change; without, all within reach of those awake. The plots around
                those awake must be there if they may change, and the plots around both.
        """
        near = widened(awake)
        mine = near if own is None else near & own
        flags = self._array(np.pad(awake, 1).astype(np.int32), wp.int32)
        found = np.zeros(self.shape, dtype=np.bool_)
        sums = np.zeros(4, dtype=np.int64)
        parts = [(corner, self._inner(mine, corner)) for corner in _corners(mine, self._part)]
        for corner, inner in parts:
            plots = np.argwhere(inner)
            around = np.argwhere(widened(inner) & near)
            tally = self._work(corner, plots, around, flags)
            found[inner] = tally["awake"].any(axis=1)
            sums += [int(tally[name].sum(dtype=np.int64)) for name in _SUMS]
        # A part reads the posts around it as they were.
        for _, inner in parts:
            plots = np.argwhere(inner)
            shared = [self._sheet, self._starts(plots), self._gain]
            self._launch(kernels.settle, plots, shared, [self._count])
        moved, removed, added, posts = sums.tolist()
        return Moved(moved, removed, added, posts, found)

    def _inner(self, plots: Plots, corner: tuple[int, int]) -> Plots:
        """Those of the plots that lie in a part."""
        found = np.zeros_like(plots)
        part = tuple(slice(first, first + self._part) for first in corner)
        found[part] = plots[part]
        return found

    def _work(
        self,
        corner: tuple[int, int],
        inner: npt.NDArray[Any],
        around: npt.NDArray[Any],
        flags: Any,
    ) -> npt.NDArray[Any]:
        """All sweeps of a part; what flowed becomes the gain of its inner plots."""
        offset = np.subtract((2, 2), corner)
        field, width = self._field, self._sheet.width
        scratch = self._scratch
        plots = self._starts(around + offset, scratch.across)
        height, excess, flows = scratch.height, scratch.excess, scratch.flows
        self._launch(
            kernels.begin,
            around,
            [field, plots, width, self._starts(around), self._count],
            [height, *flows, excess],
        )
        for sweep in range(1, SWEEPS + 1):
            self._launch(kernels.find_excess, around, [field, plots, height], [excess])
            shared = [field, plots, height, excess, _pace(sweep)]
            self._launch(kernels.find_flows, around, shared, flows)
            self._launch(kernels.move, around, [field, plots, *flows[:2]], [height])
        at = self._array((inner + 1) * PLOT, wp.vec2i)
        tally: Any = wp.empty(len(inner) * self._runs, dtype=kernels.Tally, device=scratch.device)
        launch(
            kernels.finish,
            len(inner) * self._runs,
            shared=[
                *(field, self._starts(inner + offset, scratch.across), *flows[2:], flags, at),
                *(width, self._starts(inner), self._gain),
            ],
            items=[scratch.items[: len(inner) * self._runs], tally],
            device=scratch.device,
            threads=self._threads,
        )
        found: npt.NDArray[Any] = tally.numpy().reshape(len(inner), self._runs)
        return found

    def _launch(
        self, kernel: Any, plots: npt.NDArray[Any], shared: list[Any], changed: list[Any]
    ) -> None:
        """Launch over the runs of some plots; what is changed comes last among the arguments."""
        runs = len(plots) * self._runs
        launch(
            kernel,
            runs,
            shared=[*shared, *changed],
            items=[self._scratch.items[:runs]],
            device=self._scratch.device,
            threads=self._threads,
        )

    def _starts(self, plots: npt.NDArray[Any], across: int | None = None) -> Any:
        """First posts of plots in an array that is ``across`` plots wide."""
        width = (across or self.shape[1]) * PLOT
        return self._array(
            (plots[:, 0] * (PLOT * width) + plots[:, 1] * PLOT).astype(np.int32), wp.int32
        )

    def _array(self, values: npt.NDArray[Any], dtype: Any) -> Any:
        if values.dtype == np.int64:
            values = values.astype(np.int32)
        return wp.array(values, dtype=dtype, device=self._scratch.device)


_SUMS = ("moved", "removed", "added", "posts")


def widened(plots: Plots) -> Plots:
    """Plots and the eight around each, as far as the map goes."""
    padded = np.pad(plots, 1)
    rows = padded[:-2] | padded[1:-1] | padded[2:]
    found: Plots = rows[:, :-2] | rows[:, 1:-1] | rows[:, 2:]
    return found


def _corners(plots: Plots, part: int) -> Iterator[tuple[int, int]]:
    """First plots of the parts that hold any of the plots."""
    for row in range(0, plots.shape[0], part):
        for col in range(0, plots.shape[1], part):
            if plots[row : row + part, col : col + part].any():
                yield row, col


def _pace(sweep: int) -> Any:
    pace: Any = kernels.Pace()
    pace.keep = (sweep - 1) / sweep
    # Excess is summed over the two cells beside an edge: half of each counts.
    pace.gain = 0.5 * STEP * (2 * sweep - 1) / sweep
    pace.limit = 0.5 * STEP * sweep * CARRY
    return pace


def _field(width: int, run: int, repose: Repose) -> Any:
    field: Any = kernels.Field()
    field.width, field.run, field.parts = width, run, repose.parts
    field.repose = repose.slope * repose.parts
    field.start = ((repose.slope + START) * repose.parts) ** 2
    return field
