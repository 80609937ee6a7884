"""Agents move as they say, and their needs with them."""

from __future__ import annotations

from terrasim.cache.agent import Agent, ahead
from terrasim.grid import Grid

GRID = Grid(4097, 4097, 1.0)


def test_an_agent_goes_on_as_it_moves() -> None:
    """Ten steps at once are ten steps one by one, in place and height."""
    agent = Agent(100.0, 200.0, 64.0, 0.5, 4.0, -8.0, 0.25)
    once = agent.moved(10)
    for _ in range(10):
        agent = agent.moved()
    assert agent == once
    assert (once.row, once.col, once.height) == (140.0, 120.0, 3.0)


def test_the_level_is_the_whole_part_of_the_height_within_the_terrain() -> None:
    """Below ground it is level 0, beyond the coarsest the coarsest."""
    levels = [Agent(0.0, 0.0, 1.0, height).need(GRID).level for height in (-3.0, 0.99, 1.0, 99.0)]
    assert levels == [0, 0, 1, GRID.top]


def test_what_lies_ahead_comes_soonest_first() -> None:
    """Needs are ordered by time, then by agent."""
    agents = [Agent(0.0, 0.0, 9.0, 0.0, 1.0), Agent(50.0, 0.0, 9.0, 0.0, 1.0, 0.0, 1.0)]
    needs = ahead(agents, GRID, (1, 3))
    assert [(need.row, need.level) for need in needs] == [  # type: ignore[attr-defined]
        (1.0, 0),
        (51.0, 1),
        (3.0, 0),
        (53.0, 3),
    ]
