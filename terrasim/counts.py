"""Heights are counted: an int32 number of 10 micrometres above the terrain's datum."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from terrasim.errors import InputError

COUNT_M = 1e-5
"""Height of one count [m]."""
COUNTS_PER_M = 100_000
"""Counts in a metre."""
HOLE = -(2**31)
"""The int32 that marks a post without ground."""
MAX_COUNT = 2**31 - 1
"""The largest height in counts; the lowest is its negative."""

Counts = npt.NDArray[np.int32]
Metres = npt.NDArray[np.float64]


def to_counts(height: npt.ArrayLike, datum: float = 0.0) -> Counts:
    """Round heights to counts above the datum.

    Args:
        height: Heights [m], any shape. NaN becomes a hole.
        datum: Height of count 0 [m].

    Returns:
        Counts, same shape, int32.

    Raises:
        InputError: If a height is infinite or further than 21,474 m from the datum.
    """
    scaled = np.rint((np.asarray(height, dtype=np.float64) - datum) * COUNTS_PER_M)
    hole = np.isnan(scaled)
    if not hole.any():
        _check_range(scaled, datum)
        return scaled.astype(np.int32)
    filled = np.where(hole, 0.0, scaled)
    _check_range(filled, datum)
    counts = filled.astype(np.int32)
    counts[hole] = HOLE
    return counts


def to_metres(counts: npt.ArrayLike, datum: float = 0.0) -> Metres:
    """Heights [m] of counts above the datum, float64; holes become NaN."""
    values = np.asarray(counts)
    return np.where(values == HOLE, np.nan, values * COUNT_M + datum)


def _check_range(scaled: Metres, datum: float) -> None:
    if scaled.size == 0:
        return
    for worst in (float(scaled.min()), float(scaled.max())):
        if abs(worst) > MAX_COUNT:
            raise InputError(
                f"height {worst * COUNT_M + datum:g} m is out of range: heights lie within "
                f"21474 m of the datum ({datum:g} m); set a datum nearer to them"
            )
