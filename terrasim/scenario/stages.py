"""How long each stage of a run takes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass


@dataclass
class Stage:
    """A named part of a run."""

    name: str
    """What is done."""
    wall_s: float = 0.0
    """Wall time [s], without the stages inside it."""
    cpu_s: float = 0.0
    """CPU time of the calling thread [s], likewise."""
    times: int = 0
    """How often."""


class StageTimer:
    """Stages by name, in the order in which they first began.

    A stage inside another counts for itself alone, so their times add up to the whole.
    """

    def __init__(self) -> None:
        """Begin with no stage."""
        self._stages: dict[str, Stage] = {}
        self._open: list[tuple[Stage, float, float]] = []

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Time a part of the run."""
        stage = self._stages.setdefault(name, Stage(name))
        stage.times += 1
        self._pause()
        self._open.append((stage, time.perf_counter(), time.thread_time()))
        try:
            yield
        finally:
            self._pause()
            self._open.pop()
            if self._open:
                outer, _, _ = self._open[-1]
                self._open[-1] = (outer, time.perf_counter(), time.thread_time())

    def wall_s(self, name: str) -> float:
        """Wall time of a stage [s]; 0 if it never ran."""
        return self._stages[name].wall_s if name in self._stages else 0.0

    @property
    def stages(self) -> list[Stage]:
        """All stages."""
        return list(self._stages.values())

    def _pause(self) -> None:
        """Credit the innermost open stage with the time since it was last looked at."""
        if not self._open:
            return
        stage, wall, cpu = self._open[-1]
        stage.wall_s += time.perf_counter() - wall
        stage.cpu_s += time.thread_time() - cpu
