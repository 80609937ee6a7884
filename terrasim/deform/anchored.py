"""Places given in metres from an anchor post, as a cell and a place within it."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from terrasim.errors import InputError
from terrasim.grid import MAX_INDEX, Indices

Anchor = tuple[int, int]
"""Indices of a level-0 post, row and column. It need not lie on the terrain."""


def cells(
    metres: npt.NDArray[np.float64], anchor: int, spacing: float, name: str
) -> tuple[Indices, npt.NDArray[np.float64]]:
    """Cells of places along one axis, and the places within them.

    Only the distance from the anchor enters the arithmetic, so a place keeps its precision
    wherever the anchor lies, and its bits when everything moves by whole cells.

    Args:
        metres: Distances from the anchor post [m], shape ``(count,)``.
        anchor: Index of the anchor post.
        spacing: Distance between posts [m].
        name: What to call the distances in an error.

    Returns:
        Cell indices, int64, and distances from the cell's first post [m], 0 to ``spacing``.

    Raises:
        InputError: If a distance is not finite or leads beyond the posts that can be numbered.
    """
    if not np.isfinite(metres).all():
        raise InputError(f"{name} must be finite, got {metres[~np.isfinite(metres)][0]}")
    steps = np.floor(metres / spacing)
    far = np.abs(steps + anchor) > MAX_INDEX
    if far.any():
        raise InputError(
            f"{name} = {metres[far][0]:g} m from post {anchor} lies beyond the {MAX_INDEX} posts "
            "that can be numbered; choose a nearer anchor"
        )
    inside = np.clip(metres - steps * spacing, 0.0, spacing)
    return steps.astype(np.int64) + anchor, inside
