"""Other engines that a study may be held against.

Each is a module with a function ``follow(setup, times_s) -> Frames``: the balls of ``setup``
(:class:`terrasim.scenario.simulation.Setup`) let go as a run lets them go, at the times asked for.
It is imported in a process of its own, and only when a study names it. What is not installed it
says with an :class:`InputError`.
"""

from __future__ import annotations

from importlib import import_module
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from terrasim.study.frames import Frames

ENGINES: dict[str, str] = {}
"""Modules by the engine's name."""


class Engine(Protocol):
    """What such a module holds."""

    def follow(self, setup: Any, times_s: npt.NDArray[np.float64]) -> Frames:
        """Places and velocities of the balls at some times, the first of them 0."""


def engine(name: str) -> Engine:
    """Import an engine's module."""
    module: Any = import_module(ENGINES[name])
    return module  # type: ignore[no-any-return]
