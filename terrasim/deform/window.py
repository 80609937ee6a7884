"""Heights of level 0 as they are now, as exact whole numbers."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from terrasim.counts import HOLE
from terrasim.errors import InputError
from terrasim.grid import Span
from terrasim.output.window import read_window as read_posts
from terrasim.terrain import Terrain

Heights = npt.NDArray[np.int64]

NO_GROUND = -(2**63)
"""What stands for a hole: the smallest int64."""


def read_window(
    terrain: Terrain, row: int, col: int, rows: int, cols: int, detail: bool = False
) -> Heights:
    """Heights of a rectangle of posts.

    Their blocks are brought in, as many at a time as the pool holds, so call it between steps.

    Args:
        terrain: The terrain.
        row: First row: of level-0 posts, or of detail posts if ``detail``.
        col: First column likewise.
        rows: Number of rows.
        cols: Number of columns.
        detail: Base and detail together, on the posts of the detail grid.

    Returns:
        Counts, int64, shape ``(rows, cols)``: of 10 micrometres, or that divided by the detail's
        factor if ``detail``. ``NO_GROUND`` marks a hole. Posts beyond the terrain repeat its edge.

    Raises:
        InputError: If ``detail`` is asked of a terrain without a detail grid.
    """
    if detail:
        raise InputError("this terrain has no detail grid; open it with a detail factor")
    posts = read_posts(terrain, 0, Span(row, row + rows, col, col + cols))
    return np.where(posts == HOLE, NO_GROUND, posts.astype(np.int64))
