"""Ground that moves under balls: it throws and carries them.

An edit is at once unless it is said to move: the ground is elsewhere, it has no speed, and a ball
under it is lifted out without any. What changes the ground within :func:`moving` moves it: between
two steps it goes from one height to the other at the constant rate ``rise / dt`` [m/s].
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import warp as wp

from terrasim.balls.moved import Moved
from terrasim.balls.reach import next_reach
from terrasim.balls.sleep import rejoin, wake
from terrasim.launch import launch
from terrasim.terrain import Terrain

if TYPE_CHECKING:
    from terrasim.balls.balls import Balls


@contextmanager
def moving(terrain: Terrain, balls: Balls) -> Iterator[None]:
    """Let the ground move under balls: what changes it within takes the coming step's time.

    ``with moving(terrain, balls): advance_dynamics(...)``, then ``step(...)``. It may be entered
    several times before a step, and the rises add up; what is done outside of it has no speed.

    The ground under a ball goes up at its rise over the step's length. A ball that lies on it has
    the ground's speed along the normal at once, without a bounce: it is carried, and leaves the
    ground when that slows down by more than gravity slows a ball. So from ground that stops it is
    thrown with the ground's speed, and no higher than ``u^2 / 2 g``. One that meets it in flight
    bounces relative to it. Ground that sinks slower than gravity takes a ball along.

    Slumping has the speed that its iterations in a step give it: many of them in a short step throw
    balls far. Let it slump outside of this where it is to be at once.

    The rate is that under a ball's centre at the step's start, for all its way in the step: the
    error is first order in ``dt`` where the rate differs from place to place. Holes and ground
    that a coarser level stands in for have none.

    Args:
        terrain: The terrain.
        balls: The balls; all changes of their state between here and the step are lost on it.
    """
    if balls.count == 0:
        yield
        return
    from terrasim.kernels.rise import AFTER, AGAIN, FIRST, Rise

    rejoin(balls)
    if balls.reach is None or balls.awake is not None:
        # Those that sleep have had no ground required for them.
        around = next_reach(terrain.grid, balls.cell, _nothing, 0.0, 0.0, None)
        terrain.cache.require([around.boxes])
    when = AGAIN
    if balls.moved is None:
        balls.moved = Moved(wp.zeros(balls.count, dtype=Rise, device=terrain.device))
        when = FIRST
    _look(terrain, balls, balls.moved, when)
    yield
    _look(terrain, balls, balls.moved, AFTER)
    rises = balls.moved.rises.numpy()
    balls.moved.most = float(np.abs(rises["rise"]).max())
    wake(balls, (rises["rise"] != 0.0) | (rises["lift"] != 0.0))


def board(terrain: Terrain, balls: Balls, step: Any) -> Any:
    """See balls from the ground that moved under them.

    Args:
        terrain: The terrain.
        balls: The balls; ``moved`` is used up.
        step: The step, ``kernels.body.Step``.

    Returns:
        The ground's rates [m/s], for :func:`leave`; None if it did not move.
    """
    moved, balls.moved = balls.moved, None
    if moved is None or (moved.most == 0.0 and not moved.rises.numpy()["lift"].any()):
        return None
    if terrain.lattice.factor > 1:
        from terrasim.kernels.rise_detail import board_on_detail as kernel
    else:
        from terrasim.kernels.rise import board as kernel
    # Friction of spinning balls goes by their slip; here, before the step itself, it is left out.
    rubs = 1.0 if balls.spin is None else 0.0
    rates = wp.empty(balls.count, dtype=wp.float64, device=terrain.device)
    launch(
        kernel,
        balls.count,
        shared=[terrain.pool, terrain.required, terrain.lattice, step, rubs],
        items=[
            balls.material,
            moved.rises,
            balls.cell,
            balls.offset,
            balls.z,
            balls.velocity,
            rates,
        ],
        device=terrain.device,
        threads=terrain.threads,
    )
    return rates


def leave(terrain: Terrain, balls: Balls, rates: Any) -> None:
    """See balls from the datum again, after a step."""
    if rates is None:
        return
    from terrasim.kernels.rise import leave_ground

    launch(
        leave_ground,
        balls.count,
        shared=[],
        items=[rates, balls.velocity],
        device=terrain.device,
        threads=terrain.threads,
    )


def _look(terrain: Terrain, balls: Balls, moved: Moved, when: int) -> None:
    """Look at the ground under balls."""
    if terrain.lattice.factor > 1:
        from terrasim.kernels.rise_detail import look_at_detail as kernel
    else:
        from terrasim.kernels.rise import look as kernel
    launch(
        kernel,
        balls.count,
        shared=[terrain.pool, terrain.required, terrain.lattice, balls.collision.upright, when],
        items=[balls.material, balls.cell, balls.offset, balls.z, moved.rises],
        device=terrain.device,
        threads=terrain.threads,
    )


def _nothing() -> float:
    """How fast balls are while the ground is changed."""
    return 0.0
