"""A window of the ground as another engine's height field: the same posts, the same triangles.

MuJoCo keeps heights as float32 shares, 0 to 1, of the range between the lowest and the highest,
and splits each cell from (x-, y-) to (x+, y+), as the ground is split here. A share is good to
2^-25, so a range of 100 m keeps every post within 3 micrometres: less than the 5 that counts round
to.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from terrasim.counts import COUNT_M
from terrasim.deform.anchored import Anchor
from terrasim.deform.window import NO_GROUND, read_window
from terrasim.errors import InputError
from terrasim.terrain import Terrain

MOST_RANGE = 100.0
"""Largest range of heights in a window [m]."""
MOST_POSTS = 1 << 22
"""Most posts in a window: 2,048 x 2,048."""
MOST_RADIUS = 6.0
"""Largest radius [posts]: MuJoCo stops at 50 contacts of two bodies, in order of rows."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Window:
    """Posts of level 0 around some places."""

    shares: npt.NDArray[np.float32]
    """Heights over ``lowest``, 0 to 1 of ``range``, shape ``(rows, columns)``."""
    lowest: float
    """World z of the lowest post [m]."""
    range: float
    """Metres that a share of 1 stands for."""
    west: float
    """x of the first column [m from the anchor]."""
    south: float
    """y of the first row [m from the anchor]."""
    spacing: float
    """Distance between posts [m]."""

    @property
    def half(self) -> tuple[float, float]:
        """Half of its size along x and y [m]."""
        rows, cols = self.shares.shape
        return 0.5 * (cols - 1) * self.spacing, 0.5 * (rows - 1) * self.spacing

    @property
    def centre(self) -> tuple[float, float]:
        """Its middle [m from the anchor]."""
        return self.west + self.half[0], self.south + self.half[1]

    def holds(self, places: Floats) -> npt.NDArray[np.bool_]:
        """Which places lie over it, shape ``(count,)``, from places ``(count, 2 or more)``."""
        away = np.abs(places[:, :2] - self.centre)
        return np.asarray((away <= self.half).all(axis=1))


def window_of(
    terrain: Terrain, places: Floats, radii: Floats, *, margin: float, anchor: Anchor
) -> Window:
    """Cut the window that balls are dropped on.

    Args:
        terrain: The terrain.
        places: Centres [m from the anchor], shape ``(count, 3)``.
        radii: Radii [m].
        margin: Ground on every side of the outermost places [m].
        anchor: Level-0 post (row, column) that places count from.

    Raises:
        InputError: If the window has a hole, a detail grid, too many posts or too great a range, or
            a ball is too large for its posts.
    """
    spacing = terrain.grid.spacing
    if terrain.lattice.factor > 1:
        raise InputError("a height field for another engine has no detail grid, this terrain has")
    if not margin >= 0.0:
        raise InputError(f"margin must be at least 0 m, got {margin}")
    if radii.max() > MOST_RADIUS * spacing:
        raise InputError(
            f"a radius of {radii.max():g} m is over {MOST_RADIUS:g} posts of {spacing:g} m, where "
            "MuJoCo leaves contacts out; take smaller balls or wider posts"
        )
    first = np.floor((places[:, :2].min(axis=0) - margin) / spacing)
    last = np.ceil((places[:, :2].max(axis=0) + margin) / spacing)
    cols, rows = (int(n) + 1 for n in last - first)
    if rows * cols > MOST_POSTS:
        raise InputError(
            f"a window of {rows:,} x {cols:,} posts is over {MOST_POSTS:,}: put the balls closer"
        )
    west, south = (int(n) for n in first)
    posts = read_window(terrain, anchor[0] + south, anchor[1] + west, rows, cols)
    if (posts == NO_GROUND).any():
        raise InputError("a height field for another engine has no holes, this window has")
    low, high = int(posts.min()), int(posts.max())
    if (high - low) * COUNT_M > MOST_RANGE:
        raise InputError(
            f"heights of the window range over {(high - low) * COUNT_M:.1f} m; float32 heights are "
            f"good to a count up to {MOST_RANGE:g} m: take a smaller window"
        )
    # Level ground has no range, and a height field must have one.
    span = max(high - low, 1)
    return Window(
        ((posts - low) / span).astype(np.float32),
        low * COUNT_M + terrain.grid.datum,
        span * COUNT_M,
        west * spacing,
        south * spacing,
        spacing,
    )
