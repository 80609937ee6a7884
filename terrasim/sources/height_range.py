"""Heights in metres that a source is given: finite, and within what counts can say."""

from __future__ import annotations

import math

from terrasim.counts import COUNTS_PER_M, MAX_COUNT
from terrasim.errors import InputError
from terrasim.grid import Grid


def count_of(name: str, height: float, grid: Grid) -> int:
    """A height [m] as a count above the grid's datum; refused when out of range."""
    check_finite(name, height)
    count = round((height - grid.datum) * COUNTS_PER_M)
    if abs(count) > MAX_COUNT:
        raise InputError(
            f"{name} {height:g} m is out of range: heights lie within 21474 m of the datum "
            f"({grid.datum:g} m); set a datum nearer to them"
        )
    return count


def check_reach(height: float, reach: float, grid: Grid) -> None:
    """Refuse heights that can leave the range on either side."""
    count = count_of("height", height, grid)
    if abs(count) + abs(reach) * COUNTS_PER_M >= MAX_COUNT:
        raise InputError(
            f"heights of {height:g} m and {abs(reach):g} m more or less are out of range: they lie "
            f"within 21474 m of the datum ({grid.datum:g} m); set a datum nearer to them"
        )


def check_finite(name: str, value: float) -> None:
    """Refuse NaN and infinity."""
    if not math.isfinite(value):
        raise InputError(f"{name} must be finite, got {value}")
