"""How the benches take times: interleaved repeats, the median of their ratios."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence

import numpy as np

Work = Callable[[], object]


def cpu_seconds(works: Sequence[Work], repeats: int = 9) -> list[list[float]]:
    """CPU time of the calling thread for each of several works, taken in turn.

    Args:
        works: What to time; each is run once before, uncounted.
        repeats: Rounds; in each, every work is timed once, so that drift hits all alike.

    Returns:
        Seconds, one list of ``repeats`` a work.
    """
    return _taken(works, repeats, time.thread_time)


def wall_seconds(works: Sequence[Work], repeats: int = 9) -> list[list[float]]:
    """Wall time for each of several works; see :func:`cpu_seconds`."""
    return _taken(works, repeats, time.perf_counter)


def median_ratio(of: Sequence[float], to: Sequence[float]) -> float:
    """Median of the ratios taken round by round."""
    return float(np.median(np.asarray(of) / np.asarray(to)))


def _taken(works: Sequence[Work], repeats: int, clock: Callable[[], float]) -> list[list[float]]:
    for work in works:
        work()
    times: list[list[float]] = [[] for _ in works]
    for _ in range(repeats):
        for work, taken in zip(works, times, strict=True):
            start = clock()
            work()
            taken.append(clock() - start)
    return times
