"""An agent: something that moves over the ground and needs it round itself at one level.

High up it needs a coarser level over a wider area, low down a finer one over a smaller: the radius
is counted in posts of the level. Moving sideways and climbing are the same to the cache.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from terrasim.cache.needs import Disc, Need
from terrasim.grid import Grid


@dataclass(frozen=True)
class Agent:
    """Where an agent is and how it moves a step."""

    row: float
    """Place along y [level-0 posts]."""
    col: float
    """Place along x [level-0 posts]."""
    radius: float
    """Need radius [posts of its level]."""
    height: float = 0.0
    """Its level as a number: the level it needs is the whole part."""
    rows_per_step: float = 0.0
    """Motion along y [level-0 posts a step]."""
    cols_per_step: float = 0.0
    """Motion along x [level-0 posts a step]."""
    climb_per_step: float = 0.0
    """Change of ``height`` a step."""

    def moved(self, steps: float = 1.0) -> Agent:
        """The agent some steps later, if it goes on as it does now."""
        return Agent(
            self.row + steps * self.rows_per_step,
            self.col + steps * self.cols_per_step,
            self.radius,
            self.height + steps * self.climb_per_step,
            self.rows_per_step,
            self.cols_per_step,
            self.climb_per_step,
        )

    def need(self, grid: Grid) -> Disc:
        """What it needs now."""
        level = min(max(math.floor(self.height), 0), grid.top)
        return Disc(self.row, self.col, self.radius, level)


def ahead(agents: Sequence[Agent], grid: Grid, lookahead: Sequence[int]) -> list[Need]:
    """What agents will need, soonest first: the same discs further along their motion.

    Args:
        agents: The agents.
        grid: The terrain's grid.
        lookahead: Numbers of steps to look ahead, ascending.
    """
    return [agent.moved(steps).need(grid) for steps in lookahead for agent in agents]
