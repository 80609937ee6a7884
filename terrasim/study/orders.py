"""What the figures say: orders of convergence, and which variants nothing else beats."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

STEPS: dict[str, Callable[[float], float]] = {
    "dt_s": lambda value: value,
    "spacing": lambda value: value,
    "factor": lambda value: 1.0 / value if value else 0.0,
    "level": lambda value: 2.0**value,
}
"""Knobs that stand for a step or a spacing, by the last word of their path."""
NAMES = {"factor": "1 / {}", "level": "spacing of {}, over that of level 0"}
"""What such a step is called where it is not the knob itself."""
FLAT = 0.2
"""An error whose fitted power is smaller does not depend on the knob."""


@dataclass(frozen=True)
class Order:
    """A power law ``error = size * step ** order`` through some points."""

    order: float
    """The power."""
    spread: float
    """Standard error of it; 0 with two points."""
    size: float
    """The error at a step of 1."""
    points: int
    """How many it goes through."""

    @property
    def text(self) -> str:
        """What a person reads."""
        if abs(self.order) < FLAT:
            return "does not depend on it"
        if self.order < 0.0:
            return "rounding alone: smaller steps gather more of it"
        spread = f" ± {self.spread:.2f}" if self.points > 2 else ""
        return f"order {self.order:.2f}{spread} ({self.points} points)"


def step_of(knob: str, value: Any) -> float | None:
    """The step or spacing that a knob's value stands for; None if it is none."""
    step = STEPS.get(knob.rsplit(".", maxsplit=1)[-1])
    number = isinstance(value, int | float) and not isinstance(value, bool)
    found = step(value) if step is not None and number else 0.0
    return found if found > 0.0 else None


def step_name(knob: str) -> str:
    """What :func:`step_of` gives, in words."""
    return NAMES.get(knob.rsplit(".", maxsplit=1)[-1], "{}").format(knob)


def fit_order(steps: Sequence[float], errors: Sequence[float | None]) -> Order | None:
    """Fit a power law by least squares of the logarithms; None with fewer than two points."""
    known = [
        (math.log(step), math.log(error))
        for step, error in zip(steps, errors, strict=True)
        if error is not None and error > 0.0 and math.isfinite(error)
    ]
    if len({x for x, _ in known}) < 2:
        return None
    x, y = np.array(known).T
    dx = x - x.mean()
    order = float(dx @ y / (dx @ dx))
    shift = float(y.mean() - order * x.mean())
    rest = y - shift - order * x
    free = len(x) - 2
    spread = math.sqrt(float(rest @ rest) / free / float(dx @ dx)) if free > 0 else 0.0
    return Order(order, spread, math.exp(shift), len(x))


def pareto(costs: Sequence[float | None], errors: Sequence[float | None]) -> list[int]:
    """Numbers of the variants than which no other is both as cheap and as exact, by cost."""
    known = [
        (cost, error, i)
        for i, (cost, error) in enumerate(zip(costs, errors, strict=True))
        if cost is not None and error is not None and math.isfinite(error)
    ]
    front, best = [], math.inf
    for _, error, i in sorted(known):
        if error < best:
            front.append(i)
            best = error
    return front
