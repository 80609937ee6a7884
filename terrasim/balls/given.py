"""Numbers that balls are made of, checked before anything is allocated."""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from terrasim.errors import InputError

Table = npt.NDArray[np.float64]


def numbers(values: npt.ArrayLike, name: str, shape: tuple[int, int]) -> Table:
    """Finite float64 values of a shape; -1 takes any number of rows."""
    try:
        table = np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name} must be an array of numbers: {error}") from None
    if shape[0] >= 0 and table.shape in {(), (3,), (1, 3)}:
        table = np.broadcast_to(table, shape)
    if table.ndim != 2 or table.shape[1] != 3 or shape[0] not in {-1, len(table)}:
        count = "count" if shape[0] < 0 else shape[0]
        raise InputError(f"{name} must have shape ({count}, 3), got {table.shape}")
    bad = ~np.isfinite(table)
    if bad.any():
        first = int(np.argwhere(bad)[0, 0])
        raise InputError(f"{name}[{first}] must be finite, got {tuple(table[first].tolist())}")
    return np.ascontiguousarray(table)


def within(values: npt.ArrayLike, name: str, count: int, low: float, high: float) -> Table:
    """One finite value a ball, from ``low`` to ``high``."""
    try:
        table = np.broadcast_to(np.asarray(values, dtype=np.float64), (count,))
    except (TypeError, ValueError):
        raise InputError(f"{name} must be one number or {count} of them, got {values!r}") from None
    bad = ~(np.isfinite(table) & (table >= low) & (table <= high))
    if bad.any():
        rule = "above 0" if name in {"radius", "mass"} else f"at least {low:g}"
        rule += f" and at most {high:g}" if math.isfinite(high) else " and finite"
        raise InputError(f"{name} must be {rule}, got {table[bad][0]}")
    return table
