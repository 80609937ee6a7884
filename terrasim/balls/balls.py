"""Balls: their state, and one step of time.

A ball's place is an int32 cell and a float64 offset within it; its height is float64 metres above
the datum. Nothing in a step depends on how far the cell is from the origin, so a scene moved by
whole cells repeats to the bit. float64 costs little: on one CPU thread a step took 75 to 100 ns a
ball, sorted by place, where float32 offsets with a simpler contact had been measured at 68 to 88;
and elastic bounces at an altitude of 4,000 m keep their energy to 1e-8.

Contact is with the plane of the triangle under the centre. A ball that is large against the cells,
or lies in a valley, may cut into triangles beside it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Self

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.balls.collision import AS_USUAL, Collision
from terrasim.balls.given import numbers, within
from terrasim.balls.moved import Moved
from terrasim.balls.moving import board, leave
from terrasim.balls.reach import Reach, next_reach
from terrasim.balls.sleep import Awake, after_step, settle, stepped
from terrasim.balls.springs import Limits, limits_of, rates_of
from terrasim.cache.needs import Boxes
from terrasim.deform.anchored import Anchor, cells
from terrasim.errors import InputError
from terrasim.grid import Indices
from terrasim.kernels.balls import Tally, stand_balls, step_balls
from terrasim.kernels.balls_detail import stand_balls_on_detail, step_balls_on_detail
from terrasim.kernels.balls_spin import step_spinning_balls, step_spinning_balls_on_detail
from terrasim.kernels.body import Material
from terrasim.kernels.spin import SOLID
from terrasim.launch import launch
from terrasim.terrain import Terrain

Table = npt.NDArray[np.float64]
STILL_ON_SPRINGS = 1e-4
"""Speed up to which a ball on springs rests [m/s]."""


@dataclass
class Balls:
    """State of balls, arrays on the terrain's device with one entry a ball."""

    cell: Any
    """Level-0 cell (row, col), vec2i. It may lie off the terrain, where the edge goes on."""
    offset: Any
    """Centre from the cell's (x-, y-) post [m], vec2d, 0 to below the spacing."""
    z: Any
    """Centre above the datum [m], float64."""
    velocity: Any
    """Velocity [m/s], vec3d."""
    material: Any
    """Radius [m], restitution and friction, ``kernels.body.Material``."""
    tally: Any
    """What happened to each ball since it was made, ``kernels.balls.Tally``."""
    spin: Any = None
    """Spin [rad/s], vec3d; None if the balls have none, and it takes no memory."""
    rolling: Any = None
    """Coefficient of rolling friction, float64; None without spin."""
    mass: Any = None
    """Mass [kg], float64; None if nothing asks for it."""
    spring: Any = None
    """Stiffness [1/s^2] and damping [1/s] of a kilogram, vec2d; None without springs."""
    limits: Limits | None = None
    """What their springs allow."""
    collision: Collision = AS_USUAL
    """How they meet the ground."""
    sub_steps: int = 0
    """Steps that were made because one was over the limit of explicit springs."""
    made_implicit: int = 0
    """Steps that were taken implicitly because of it."""
    reach: Reach | None = None
    """Ground required for the coming steps. Make it None after changing cells or velocities."""
    moved: Moved | None = None
    """How far the ground moved under them since the last step, where it did; see ``moving``."""
    awake: Awake | None = None
    """Which of them are stepped, and in what order; None for all as they are. Then arrays are only
    as they should be after :func:`terrasim.balls.sleep.settle`."""

    @property
    def count(self) -> int:
        """Number of balls."""
        return int(self.cell.shape[0])

    @classmethod
    def at(
        cls,
        terrain: Terrain,
        positions: npt.ArrayLike,
        velocities: npt.ArrayLike = 0.0,
        *,
        radius: npt.ArrayLike,
        restitution: npt.ArrayLike = 0.5,
        friction: npt.ArrayLike = 0.5,
        spin: npt.ArrayLike | None = None,
        rolling: npt.ArrayLike | None = None,
        mass: npt.ArrayLike | None = None,
        collision: Collision = AS_USUAL,
        anchor: Anchor = (0, 0),
        above_ground: bool = False,
    ) -> Self:
        """Balls at places.

        Args:
            terrain: The terrain they are for.
            positions: Centres, shape ``(count, 3)``: x and y in metres from the anchor, z in world
                metres, or above touching the ground if ``above_ground``.
            velocities: Velocities [m/s], shape ``(count, 3)`` or what broadcasts to it.
            radius: Radius [m], above 0, one or ``count``; restitution and friction likewise.
            restitution: Normal speed after an impact over that before, 0 to 1.
            friction: Coulomb's coefficient, at least 0.
            spin: Spin [rad/s], shape ``(count, 3)`` or what broadcasts to it; None for balls
                without.
            rolling: Coefficient of rolling friction, at least 0, one or ``count``: a ball stays on
                slopes whose tangent is at most that. Only with spin.
            mass: Mass [kg], above 0, one or ``count``; springs need it.
            collision: How they meet the ground.
            anchor: Level-0 post (row, column) that x and y start from; it need not lie on the
                terrain. With an anchor nearby, places are as precise far away as at the origin.
            above_ground: Whether z counts from where a ball touches the ground below.

        Returns:
            The balls. One that starts below the ground is lifted out of it by the first step.

        Raises:
            InputError: If a number is NaN, infinite or out of its range, or a shape does not fit.
        """
        place = numbers(positions, "positions", (-1, 3))
        count = len(place)
        speed = numbers(velocities, "velocities", (count, 3))
        material = np.zeros(count, dtype=_record(Material))
        material["radius"] = within(radius, "radius", count, math.ulp(0.0), math.inf)
        material["restitution"] = within(restitution, "restitution", count, 0.0, 1.0)
        material["friction"] = within(friction, "friction", count, 0.0, math.inf)
        grid = terrain.grid
        row, y = cells(place[:, 1], anchor[0], grid.spacing, "y")
        col, x = cells(place[:, 0], anchor[1], grid.spacing, "x")
        device = terrain.device
        balls = cls(
            wp.array(np.stack([row, col], axis=1), dtype=wp.vec2i, device=device),
            wp.array(np.stack([x, y], axis=1), dtype=wp.vec2d, device=device),
            wp.array(
                place[:, 2] - (0.0 if above_ground else grid.datum), dtype=wp.float64, device=device
            ),
            wp.array(speed, dtype=wp.vec3d, device=device),
            wp.array(material, dtype=Material, device=device),
            wp.zeros(count, dtype=Tally, device=device),
            collision=collision,
        )
        _spin(balls, spin, rolling)
        _weigh(balls, mass)
        if collision.sleep:
            # On springs a ball comes to rest ever more slowly.
            balls.awake = Awake(still=STILL_ON_SPRINGS if collision.sprung else 0.0)
        if above_ground:
            _stand(terrain, balls)
        return balls

    def positions(self, terrain: Terrain, anchor: Anchor = (0, 0)) -> Table:
        """Centres, shape ``(count, 3)``: x and y [m] from the anchor post, world z [m]."""
        settle(self)
        grid = terrain.grid
        steps = self.cell.numpy().astype(np.int64)[:, ::-1] - np.array(anchor[::-1])
        place = steps * grid.spacing + self.offset.numpy()
        return np.column_stack([place, self.z.numpy() + grid.datum])

    def copy(self, which: Indices | None = None) -> Self:
        """A copy of all balls, or of those with the given numbers."""
        settle(self)
        chosen = np.arange(self.count) if which is None else which
        arrays: dict[str, Any] = {}
        for name, array in vars(self).items():
            if not isinstance(array, wp.array):
                continue
            arrays[name] = wp.array(array.numpy()[chosen], dtype=array.dtype, device=array.device)
        return replace(self, reach=None, moved=None, awake=None, **arrays)


@dataclass(frozen=True)
class Totals:
    """What happened to all balls together; fields as in ``kernels.balls.Tally``."""

    impacts: int
    projected: int
    held: int
    off: int
    hole: int
    coarse: int
    error: int
    """Largest error bound [counts] of a level that stood in for level 0."""


def totals(balls: Balls) -> Totals:
    """Sums of the balls' tallies; the largest of their errors."""
    settle(balls)
    tally = balls.tally.numpy()
    names = ("impacts", "projected", "held", "off", "hole", "coarse")
    sums = {name: int(tally[name].sum(dtype=np.int64)) for name in names}
    return Totals(**sums, error=int(tally["error"].max(initial=0)))


def fastest(balls: Balls) -> float:
    """A bound of the balls' speeds if nothing but friction and gravity acts [m/s].

    Friction may turn all of a ball's spin into speed.
    """
    square = np.square(balls.velocity.numpy()).sum(axis=1)
    if balls.spin is not None:
        arm = balls.material.numpy()["radius"][:, None] * balls.spin.numpy()
        square += SOLID * np.square(arm).sum(axis=1)
    return math.sqrt(square.max(initial=0.0))


def reach(terrain: Terrain, balls: Balls, dt: float, *, gravity: float = 9.81) -> Boxes:
    """Ground the balls may touch in the next step, for ``cache.require``; ask once a step."""
    one = stepped(terrain, balls)
    last = one.reach if one.moved is None and one.limits is None else None
    extra = 0.0 if one.moved is None or dt == 0.0 else one.moved.most / dt
    extra += 0.0 if one.limits is None or dt == 0.0 else one.limits.kick(dt)
    speed = partial(fastest, one)
    one.reach = next_reach(terrain.grid, one.cell, speed, dt, gravity, last, extra)
    return one.reach.boxes


def step(
    terrain: Terrain, balls: Balls, dt: float, *, gravity: float = 9.81, require: bool = True
) -> None:
    """Move balls by one step of time, in place.

    Flight is exact. An impact is found at its time within the step, on the plane of the triangle
    under the centre: restitution along the normal, Coulomb's friction across it. A ball that would
    be back on the ground within the step stays on it and slides. The error of one step is that of
    the rule for rest and of a slide whose direction turns: first order in ``dt``.

    Args:
        terrain: The terrain.
        balls: The balls.
        dt: Length of the step [s], above 0.
        gravity: Downward acceleration [m/s^2], at least 0.
        require: Require the ground within reach first. Otherwise the caller has required
            :func:`reach`, together with what else the step reads.

    Raises:
        InputError: If ``dt`` or ``gravity`` is out of its range.
    """
    now = balls.collision.step(dt, gravity)
    if balls.count == 0:
        return
    if require:
        terrain.cache.require([reach(terrain, balls, dt, gravity=gravity)])
    one = stepped(terrain, balls)
    rates = board(terrain, one, now)
    if one.limits is None:
        _advance(terrain, one, now)
    else:
        _spring(terrain, balls, one, now)
    leave(terrain, one, rates)
    after_step(terrain, balls)


def _advance(terrain: Terrain, balls: Balls, now: Any) -> None:
    """Launch a step of balls."""
    detail = terrain.lattice.factor > 1
    shared = [terrain.pool, terrain.required, terrain.error, terrain.lattice, now, terrain.used]
    kernel, items = (
        step_balls_on_detail if detail else step_balls,
        [balls.material, balls.cell, balls.offset, balls.z, balls.velocity, balls.tally],
    )
    if balls.spin is not None:
        kernel = step_spinning_balls_on_detail if detail else step_spinning_balls
        items = [
            balls.material,
            balls.rolling,
            balls.cell,
            balls.offset,
            balls.z,
            balls.velocity,
            balls.spin,
            balls.tally,
        ]
    launch(
        kernel,
        balls.count,
        shared=shared,
        items=items,
        device=terrain.device,
        threads=terrain.threads,
    )


def _spring(terrain: Terrain, balls: Balls, one: Balls, now: Any) -> None:
    """Step balls on springs; counts what the limit made of it."""
    from terrasim.kernels.balls_sprung import step_sprung_balls

    assert one.limits is not None
    parts, implicit = balls.collision.parts(now.dt, one.limits.step)
    balls.sub_steps += parts if parts > 1 else 0
    balls.made_implicit += implicit and balls.collision.integrator == "spring"
    now.dt /= parts
    shared = [terrain.pool, terrain.required, terrain.error, terrain.lattice, now, int(implicit)]
    for _ in range(parts):
        launch(
            step_sprung_balls,
            one.count,
            shared=[*shared, terrain.used],
            items=[
                one.material,
                one.spring,
                one.cell,
                one.offset,
                one.z,
                one.velocity,
                one.tally,
            ],
            device=terrain.device,
            threads=terrain.threads,
        )


def _weigh(balls: Balls, mass: npt.ArrayLike | None) -> None:
    """Give balls a mass and springs, if they are to have them."""
    device, collision = balls.cell.device, balls.collision
    if collision.sprung and mass is None:
        raise InputError(f"integrator = {collision.integrator!r} needs the balls' mass [kg]")
    if collision.sprung and balls.spin is not None:
        raise InputError("balls on springs have no spin: take integrator = 'event' or 'projected'")
    if mass is None:
        return
    each = within(mass, "mass", balls.count, math.ulp(0.0), math.inf)
    balls.mass = wp.array(each, dtype=wp.float64, device=device)
    if collision.sprung and collision.stiffness is not None:
        given = balls.material.numpy()
        rates = rates_of(collision.stiffness, collision.damping, each, given["restitution"])
        balls.spring = wp.array(rates, dtype=wp.vec2d, device=device)
        balls.limits = limits_of(rates, given["radius"])


def _spin(balls: Balls, spin: npt.ArrayLike | None, rolling: npt.ArrayLike | None) -> None:
    """Give balls a spin and rolling friction, if they are to have them."""
    if spin is None:
        if rolling is not None:
            raise InputError(
                "rolling friction acts on balls with spin, and these have none; give spin=0.0"
            )
        return
    device = balls.cell.device
    table = numbers(spin, "spin", (balls.count, 3))
    resists = within(0.0 if rolling is None else rolling, "rolling", balls.count, 0.0, math.inf)
    balls.spin = wp.array(table, dtype=wp.vec3d, device=device)
    balls.rolling = wp.array(resists, dtype=wp.float64, device=device)


def _stand(terrain: Terrain, balls: Balls) -> None:
    """Turn heights above touching the ground into heights above the datum."""
    terrain.cache.require([reach(terrain, balls, 0.0, gravity=0.0)])
    launch(
        stand_balls_on_detail if terrain.lattice.factor > 1 else stand_balls,
        balls.count,
        shared=[terrain.pool, terrain.required, terrain.lattice, balls.collision.upright],
        items=[balls.material, balls.cell, balls.offset, balls.z],
        device=terrain.device,
        threads=terrain.threads,
    )


def _record(struct: Any) -> Any:
    return struct.numpy_dtype()
