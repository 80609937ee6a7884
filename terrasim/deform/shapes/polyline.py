"""A line of straight pieces: checked, measured, and laid out as the kernel reads it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.deform.shapes.checks import NARROWEST, WIDEST, refuse

MAX_POINTS = 1_000_000
"""Most points of a polyline."""

Points = Sequence[tuple[float, float]]
Floats = npt.NDArray[np.float64]


def check_points(points: Any, stamp: str) -> tuple[tuple[float, float], ...]:
    """Points of a polyline as pairs of floats.

    Args:
        points: Places [m], any sequence of pairs or an array of shape ``(count, 2)``.
        stamp: What to call the stamp in an error.

    Raises:
        InputError: If they are no polyline: fewer than two, too many, not finite, or two in one
            place one after another.
    """
    try:
        count = len(points)
    except TypeError:
        refuse(stamp, "points", "be a list of pairs", points)
    if not 2 <= count <= MAX_POINTS:
        refuse(stamp, "points", f"hold 2 to {MAX_POINTS} places", f"{count}")
    try:
        places = np.asarray(points)
    except ValueError:
        refuse(stamp, "points", "be pairs of numbers", points)
    if places.shape != (count, 2) or places.dtype.kind not in "iuf":
        refuse(stamp, "points", "be pairs of numbers", points)
    places = places.astype(np.float64)
    wrong = ~(np.abs(places) <= WIDEST).all(axis=1)
    if wrong.any():
        first = int(wrong.argmax())
        rule = f"be finite numbers within {WIDEST:g} m"
        refuse(stamp, f"points[{first + 1}]", rule, places[first].tolist())
    close = np.hypot(*np.diff(places, axis=0).T) < NARROWEST
    if close.any():
        first = int(close.argmax()) + 1
        rule = f"lie at least {NARROWEST:g} m from the point before"
        refuse(stamp, f"points[{first + 1}]", rule, places[first].tolist())
    return tuple((x, y) for x, y in places.tolist())


def length(points: Points) -> float:
    """Length of a polyline [m]."""
    return math.fsum(math.dist(a, b) for a, b in pairwise(points))


def turns(points: Points) -> Floats:
    """By how much it turns at each point that joins two pieces [rad], 0 to pi.

    The ends are joined too where they are the same place; that turn comes last.
    """
    legs = np.diff(np.asarray(points), axis=0)
    if is_closed(points):
        legs = np.concatenate((legs, legs[:1]))
    before, after = legs[:-1], legs[1:]
    cross = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    found: Floats = np.arctan2(np.abs(cross), (before * after).sum(axis=1))
    return found


def is_closed(points: Points) -> bool:
    """Whether it ends where it begins."""
    return points[0] == points[-1]


def tree(points: Points) -> Floats:
    """A polyline as ``kernels/swept.py`` reads it: head, points, and the boxes of its tree."""
    places = np.asarray(points)
    segments = len(places) - 1
    leaves = 1 << (segments - 1).bit_length()
    boxes = np.empty((leaves, 4))
    low = np.full((leaves, 2), np.inf)
    high = np.full((leaves, 2), -np.inf)
    low[:segments] = np.minimum(places[:-1], places[1:])
    high[:segments] = np.maximum(places[:-1], places[1:])
    node = leaves
    while node > 1:
        node //= 2
        low, high = np.minimum(low[0::2], low[1::2]), np.maximum(high[0::2], high[1::2])
        boxes[node : 2 * node] = np.concatenate((low, high), axis=1)
    boxes[0] = 0.0
    return np.concatenate(([leaves, segments + 1], places.ravel(), boxes.ravel()))
