"""One look over a raster before anything is written: its range, its gaps, what is refused."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from terrasim.counts import COUNT_M, MAX_COUNT, Metres
from terrasim.dem.height_rows import Heights
from terrasim.errors import InputError

_BAND_SAMPLES = 1 << 21

Progress = Callable[[float, str], None]
"""Takes the fraction done and what is being done."""


@dataclass(frozen=True)
class Survey:
    """What a raster holds."""

    samples: int
    """Number of samples."""
    missing: int
    """Samples without a height."""
    lowest: float
    """Smallest height [m]."""
    highest: float
    """Largest height [m]."""


def survey(name: str, heights: Heights, datum: float, progress: Progress | None = None) -> Survey:
    """Read a raster once, in bands of rows.

    Args:
        name: What to call it in an error.
        heights: The raster.
        datum: World z of count 0 [m].
        progress: Told how far it is.

    Raises:
        InputError: If a height is infinite or out of range, if there is none, or if the file
            cannot be read.
    """
    missing, lowest, highest = 0, np.inf, -np.inf
    step = max(1, _BAND_SAMPLES // heights.cols)
    for row in range(0, heights.rows, step):
        count = min(step, heights.rows - row)
        metres = heights.read(row, count)
        bad = np.isnan(metres)
        missing += int(np.count_nonzero(bad))
        if not bad.all():
            _check(name, metres, datum, row)
            lowest = min(lowest, float(np.nanmin(metres)))
            highest = max(highest, float(np.nanmax(metres)))
        if progress is not None:
            progress((row + count) / heights.rows, "looking the raster over")
    samples = heights.rows * heights.cols
    if missing == samples:
        raise InputError(
            f"{name}: none of its {samples} samples has a height; check its nodata value"
        )
    return Survey(samples, missing, lowest, highest)


def _check(name: str, metres: Metres, datum: float, row: int) -> None:
    """Refuse the first height that no count could hold."""
    limit = MAX_COUNT * COUNT_M
    wrong = np.abs(metres - datum) > limit
    if not wrong.any():
        return
    r, c = np.unravel_index(int(np.argmax(wrong)), wrong.shape)
    raise InputError(
        f"{name}: height {metres[r, c]:g} m at row {row + int(r)}, column {int(c)} is out of "
        f"range: heights are finite and within {limit:.0f} m of the datum ({datum:g} m); "
        "declare it with --nodata-value if it marks missing heights"
    )
