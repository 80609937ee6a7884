"""Colours of ground by its height and by what was done to it, for pictures and stages alike."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Colours = npt.NDArray[np.float64]
"""Red, green and blue, 0 to 1, along the last axis."""

RAMP: Colours = np.array(
    [
        [0.40, 0.56, 0.40],
        [0.62, 0.72, 0.46],
        [0.88, 0.84, 0.60],
        [0.80, 0.66, 0.46],
        [0.62, 0.49, 0.40],
        [0.90, 0.88, 0.85],
    ]
)
"""From low to high: woods, meadows, dry grass, soil, rock, pale rock."""
LOWERED = (0.24, 0.30, 0.72)
RAISED = (0.88, 0.38, 0.10)
FAINTEST_M = 0.02
"""Deformations below this are not tinted [m]."""


def ramp(part: npt.NDArray[np.float64]) -> Colours:
    """Colours of heights given as a part of their range, 0 to 1, shape ``(..., 3)``."""
    steps = np.linspace(0.0, 1.0, len(RAMP))
    return np.stack([np.interp(part, steps, RAMP[:, i]) for i in range(3)], axis=-1)


def tinted(colours: Colours, change: npt.NDArray[np.float64], most: float) -> Colours:
    """Colours with lowered and raised ground tinted, stronger the more it moved.

    Args:
        colours: Colours, shape ``(..., 3)``.
        change: What was added [m], shape ``(...)``; NaN counts as nothing.
        most: The largest change there is [m].
    """
    if most <= FAINTEST_M:
        return colours
    size = np.minimum(np.abs(np.nan_to_num(change)) / most, 1.0)
    strength = np.where(size * most > FAINTEST_M, 0.65 * np.sqrt(size), 0.0)[..., None]
    lowered = (np.nan_to_num(change) < 0.0)[..., None]
    tint = np.where(lowered, np.array(LOWERED), np.array(RAISED))
    mixed: Colours = (1.0 - strength) * colours + strength * tint
    return mixed
