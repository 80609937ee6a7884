"""Balls dropped in MuJoCo and here, on the same posts, to see how far apart they land.

MuJoCo's step moves a ball with the speed at its end, so a ball in free fall is half a step ahead of
the parabola: first contacts differ by about that, whatever the ground.
"""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.balls.balls import Balls, step
from terrasim.deform.anchored import Anchor
from terrasim.engines.comparison import Comparison, Drop
from terrasim.engines.hfield import Floats, Window, window_of
from terrasim.engines.mujoco_model import floor_of, model_of, mujoco_module, spring_of
from terrasim.engines.touch import Touches, flown, meeting
from terrasim.engines.track import Track, track
from terrasim.errors import InputError
from terrasim.query import sample_all
from terrasim.terrain import Terrain

_WALKS = 4
"""Times a first contact is looked up again, where the way there leads over an edge."""


def drop_beside(
    terrain: Terrain,
    places: npt.ArrayLike,
    radii: npt.ArrayLike,
    *,
    restitution: float = 0.3,
    friction: float = 0.5,
    rolling: float | None = 0.1,
    gravity: float = 9.81,
    dt: float = 1e-3,
    duration: float = 5.0,
    margin: float = 10.0,
    anchor: Anchor = (0, 0),
) -> Comparison:
    """Let balls go at rest, here and in MuJoCo, and compare.

    Both have the posts of one window, the same step, and balls that touch the ground only. MuJoCo's
    contact is a damped spring of the same restitution, with an elliptic cone of friction.

    Args:
        terrain: The terrain; the ground under the balls has no detail and no holes.
        places: Centres, shape ``(count, 3)``: x and y [m from the anchor], z in world metres.
        radii: Radii [m], one or ``count``.
        restitution: Normal speed after an impact over that before, 0 to 1. At 0 MuJoCo's contact
            gives 0.009 back.
        friction: Coulomb's coefficient.
        rolling: Coefficient of rolling friction of balls that turn; None for balls that do not.
        gravity: Downward acceleration [m/s^2].
        dt: Step [s].
        duration: Time to run [s].
        margin: Ground around the outermost balls [m].
        anchor: Level-0 post (row, column) that places count from.

    Returns:
        The comparison.

    Raises:
        InputError: If MuJoCo is not installed, a number is out of its range, or the window cannot
            be MuJoCo's: see :func:`terrasim.engines.hfield.window_of`.
    """
    mujoco = mujoco_module()
    spin = None if rolling is None else 0.0
    balls = Balls.at(
        terrain,
        places,
        radius=radii,
        restitution=restitution,
        friction=friction,
        spin=spin,
        rolling=rolling,
        anchor=anchor,
    )
    balls.collision.step(dt, gravity)
    if balls.count == 0 or not duration >= dt:
        raise InputError(
            f"nothing to compare: {balls.count} balls over {duration} s in steps of {dt} s"
        )
    start = balls.positions(terrain, anchor)
    sizes = balls.material.numpy()["radius"].astype(np.float64)
    window = window_of(terrain, start, sizes, margin=margin, anchor=anchor)
    steps = max(1, round(duration / dt))
    began = time.thread_time()
    model = model_of(
        window,
        start,
        sizes,
        spring=spring_of(restitution, dt),
        friction=friction,
        rolling=rolling,
        gravity=gravity,
        dt=dt,
    )
    setup = time.thread_time() - began
    theirs = _theirs(terrain, window, model, steps, setup, anchor)
    ours = _ours(terrain, window, balls, steps, dt, gravity, anchor)
    rows, cols = window.shares.shape
    drop = Drop(
        balls.count,
        dt,
        steps * dt,
        gravity,
        restitution,
        friction,
        rolling,
        rows,
        cols,
        window.spacing,
        window.range,
    )
    return Comparison(drop, ours, theirs, mujoco.__version__)


def _theirs(
    terrain: Terrain, window: Window, model: Any, steps: int, setup_s: float, anchor: Anchor
) -> Track:
    """Run MuJoCo."""
    mujoco = mujoco_module()
    data = mujoco.MjData(model)
    count, gravity = model.nbody - 1, -float(model.opt.gravity[2])
    # A ball that turns has three more numbers in its velocity.
    velocity = data.qvel.reshape(count, -1)[:, :3]
    touches, taken = Touches.none(count), np.zeros(steps)
    for k in range(steps):
        before = velocity.copy()
        start = time.thread_time()
        mujoco.mj_step(model, data)
        taken[k] = time.thread_time() - start
        # Places and contacts are those of before the step.
        contact = data.contact
        if len(contact.dist) and touches.open.any():
            ball = contact.geom[:, 1] - 1
            # The deepest contact of a ball is the exact one; those of other prisms are not.
            order = np.argsort(contact.dist, kind="stable")
            order = order[contact.dist[order] <= 0.0]
            which, first = np.unique(ball[order], return_index=True)
            at, new = order[first], touches.open[which]
            which, at = which[new].astype(np.int64), at[new]
            place, speed = data.xpos[1 + which], before[which]
            later = meeting(contact.dist[at], contact.frame[at, :3], speed, gravity)
            touches.note(which, k * model.opt.timestep, later, flown(place, speed, later, gravity))
    mujoco.mj_forward(model, data)
    place = data.xpos[1:].copy()
    return track(
        touches,
        place,
        velocity,
        height=_ground(terrain, place, anchor)[0],
        floor=floor_of(window),
        inside=window.holds(place),
        step_s=taken,
        setup_s=setup_s,
    )


def _ours(
    terrain: Terrain,
    window: Window,
    balls: Balls,
    steps: int,
    dt: float,
    gravity: float,
    anchor: Anchor,
) -> Track:
    """Run this engine."""
    # A GPU's work shows on the clock alone.
    cpu = not terrain.device.is_cuda
    clock = time.thread_time if cpu else time.perf_counter
    began = clock()
    step(terrain, balls.copy(), dt, gravity=gravity)
    wp.synchronize_device(terrain.device)
    setup = clock() - began
    touches, taken = Touches.none(balls.count), np.zeros(steps)
    radii = balls.material.numpy()["radius"].astype(np.float64)
    for k in range(steps):
        watched = touches.open.any()
        if watched:
            place, speed = balls.positions(terrain, anchor), balls.velocity.numpy().copy()
        start = clock()
        step(terrain, balls, dt, gravity=gravity)
        wp.synchronize_device(terrain.device)
        taken[k] = clock() - start
        if watched:
            struck = balls.tally.numpy()["impacts"] > 0
            which = np.flatnonzero(struck & touches.open)
            if len(which):
                later, centre = _met(
                    terrain, place[which], speed[which], radii[which], gravity, anchor
                )
                touches.note(which, k * dt, later, centre)
    place = balls.positions(terrain, anchor)
    return track(
        touches,
        place,
        balls.velocity.numpy(),
        height=_ground(terrain, place, anchor)[0],
        floor=floor_of(window),
        inside=window.holds(place),
        step_s=taken,
        setup_s=setup,
        cpu=cpu,
    )


def _met(
    terrain: Terrain, place: Floats, speed: Floats, radii: Floats, gravity: float, anchor: Anchor
) -> tuple[Floats, Floats]:
    """When and where balls in flight meet the plane of the triangle under them."""
    later, centre = np.zeros(len(place)), place
    for _ in range(_WALKS):
        height, normal = _ground(terrain, centre, anchor)
        # The plane under the centre, as it is met from where the ball's step begins.
        under = np.column_stack([centre[:, :2], height])
        gap = np.einsum("ij,ij->i", normal, place - under) - radii
        later = meeting(gap, normal, speed, gravity)
        centre = flown(place, speed, later, gravity)
    return later, centre


def _ground(terrain: Terrain, place: Floats, anchor: Anchor) -> tuple[Floats, Floats]:
    """World z of the ground under places [m], and its normals."""
    grid = terrain.grid
    west, south = anchor[1] * grid.spacing + grid.x, anchor[0] * grid.spacing + grid.y
    points = place[:, :2] + (west, south)
    found = sample_all(terrain, points)
    return np.asarray(found.height), np.asarray(found.normal)
