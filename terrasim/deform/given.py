"""What something that changes over time has given to the ground so far, in whole counts.

It says its total at each time and never a difference: the total is rounded, and what the ground
gets is the difference to the total it has. So slow changes lose nothing, nothing drifts, and what
was given can be taken back to the bit.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from terrasim.counts import MAX_COUNT, Counts
from terrasim.deform.patch import Patch
from terrasim.errors import InputError, RunError
from terrasim.grid import Span

Field = npt.NDArray[np.float64]


class Given:
    """Counts that the posts of a rectangle were given."""

    def __init__(
        self, name: str, span: Span, *, detail: bool, counts: Counts | None = None
    ) -> None:
        """Begin with nothing, or with what was given before.

        Args:
            name: What errors call it.
            span: The rectangle: level-0 posts, or those of the detail grid if ``detail``.
            detail: Whether they are the detail grid's.
            counts: What was given, int32, shape of the span.

        Raises:
            InputError: If the rectangle is empty, or the counts are no such counts.
        """
        shape = span.row1 - span.row0, span.col1 - span.col0
        if min(shape) < 1:
            raise InputError(
                f"{name}: its rectangle must hold a post of the terrain, got {shape[0]} x "
                f"{shape[1]} posts; move it or make it larger"
            )
        if counts is None:
            counts = np.zeros(shape, np.int32)
        if counts.shape != shape or counts.dtype != np.int32:
            raise InputError(
                f"{name}: given must be int32 of shape {shape}, got {counts.dtype} {counts.shape}"
            )
        self.name, self.span, self.detail = name, span, detail
        self.counts = counts.copy()
        """What the ground holds of it, int32, shape of the span."""

    def bring_to(self, total: Field) -> Patch | None:
        """The patch that brings the ground to a total; None if it holds that already.

        Args:
            total: Counts, not rounded, shape of the span.

        Raises:
            RunError: If a total, or a change at once, is beyond the range of heights. Nothing is
                noted then.
        """
        wanted = np.rint(total)
        change = wanted - self.counts
        for what, values in (("height", wanted), ("change at once", change)):
            if not np.abs(values).max() <= MAX_COUNT:
                raise RunError(
                    f"{self.name}: a {what} of {np.abs(values).max():.6g} counts is beyond the "
                    f"range of {MAX_COUNT}; make it lower"
                )
        patch = self._patch(change.astype(np.int32))
        self.counts = wanted.astype(np.int32)
        return patch

    def take_back(self) -> Patch | None:
        """The patch that takes back all that was given; None if that is nothing."""
        return self.bring_to(np.zeros(self.counts.shape))

    def correct(self, patch: Patch, taken: Counts) -> None:
        """Note that the ground took less of a patch than it was offered.

        Args:
            patch: What it was offered.
            taken: What it took, shape of the patch.
        """
        row, col = patch.row - self.span.row0, patch.col - self.span.col0
        rows, cols = patch.counts.shape
        self.counts[row : row + rows, col : col + cols] -= patch.counts - taken

    def _patch(self, change: Counts) -> Patch | None:
        """A change as a patch of no more posts than change."""
        rows = np.flatnonzero(change.any(axis=1))
        if not len(rows):
            return None
        cols = np.flatnonzero(change.any(axis=0))
        part = change[rows[0] : rows[-1] + 1, cols[0] : cols[-1] + 1]
        return Patch(
            self.span.row0 + int(rows[0]), self.span.col0 + int(cols[0]), part.copy(), self.detail
        )
