"""Agents of a scenario: where they are along their paths at a time."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

from terrasim.cache.agent import Agent
from terrasim.scenario.actors import AgentPath


def agent_at(
    one: AgentPath, time_s: float, dt_s: float, anchor: tuple[int, int], spacing: float
) -> Agent:
    """An agent at a time.

    Args:
        one: Its path.
        time_s: Time [s].
        dt_s: Time step [s], in which its motion is given.
        anchor: Row and column of the anchor post.
        spacing: Distance between level-0 posts [m].
    """
    (x, y), (east, north) = along(one.path, one.speed_m_s * time_s)
    pace = one.speed_m_s * dt_s / spacing
    return Agent(
        row=anchor[0] + y / spacing,
        col=anchor[1] + x / spacing,
        radius=one.radius,
        height=one.level + 0.5 + one.climb_levels_per_s * time_s,
        rows_per_step=north * pace,
        cols_per_step=east * pace,
        climb_per_step=one.climb_levels_per_s * dt_s,
    )


def along(
    path: Sequence[tuple[float, float]], distance: float
) -> tuple[tuple[float, float], tuple[float, float]]:
    """Place on a path at a distance from its beginning, and the direction there.

    Beyond the end it is the last place, without a direction.
    """
    left = distance
    for (x0, y0), (x1, y1) in pairwise(path):
        length = math.hypot(x1 - x0, y1 - y0)
        if left < length:
            east, north = (x1 - x0) / length, (y1 - y0) / length
            return (x0 + left * east, y0 + left * north), (east, north)
        left -= length
    return (path[-1][0], path[-1][1]), (0.0, 0.0)
