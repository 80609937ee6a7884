"""MuJoCo's model of balls on a window of the ground, and how its contact is made to bounce.

Its contact is a spring and a damper, per unit of mass: natural frequency ``w``, damping ratio
``z``. One that never pulls gives the speed back times
``exp(-z / sqrt(1 - z^2) * (pi - 2 asin z))``, and ``exp(-z / q * log((z + q) / (z - q)))`` with
``q = sqrt(z^2 - 1)`` over critical damping. The step bounds both numbers, as it is explicit in
them. What comes back in steps of finite length strays from that by up to 0.07.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from terrasim.engines.hfield import Floats, Window
from terrasim.errors import InputError

MOST_BALLS = 3000
"""Most balls: compiling 10,000 takes it a minute, and grows with their square."""
STIFFEST = 0.3
"""Largest ``w dt``: a contact takes ten steps or more."""
DAMPEST = 0.5
"""Largest damping rate times ``dt``."""
_LARGEST_RATIO = 5.0
"""Damping ratio that stands for no bounce: 0.009 of the speed come back."""
_FLOOR = 5.0
"""Ground under the lowest post [m]: the field's prisms reach down to there."""
_IMPEDANCE = 0.9
"""How firmly the contact's spring and damper are kept to. A firmer one has nothing to sink into,
and a ball at rest hops by what gravity does in a step; on this one it lies still, 0.01 mm deep."""
_FRICTION_FIRMER = 100
"""How much firmer friction is than the contact: balls creep by micrometres a second."""


@dataclass(frozen=True)
class Spring:
    """A contact's numbers."""

    stiffness: float
    """Acceleration per depth [1/s^2]."""
    damping: float
    """Acceleration per speed [1/s]."""


def bounce_of(ratio: float) -> float:
    """Restitution of a spring and damper that never pull, by damping ratio."""
    if abs(ratio - 1.0) < 1e-9:
        return math.exp(-2.0)
    if ratio < 1.0:
        q = math.sqrt(1.0 - ratio * ratio)
        return math.exp(-ratio / q * (math.pi - 2.0 * math.asin(ratio)))
    q = math.sqrt(ratio * ratio - 1.0)
    return math.exp(-ratio / q * math.log((ratio + q) / (ratio - q)))


def spring_of(restitution: float, dt: float) -> Spring:
    """The stiffest contact that a step bears and that gives so much of the speed back."""
    low, high = 0.0, _LARGEST_RATIO
    for _ in range(60):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if bounce_of(middle) > restitution else (low, middle)
    ratio = 0.5 * (low + high) if restitution < 1.0 else 0.0
    w = min(STIFFEST, DAMPEST / (2.0 * ratio) if ratio > 0.0 else STIFFEST) / dt
    return Spring(w * w, 2.0 * ratio * w)


def model_of(
    window: Window,
    places: Floats,
    radii: Floats,
    *,
    spring: Spring,
    friction: float,
    rolling: float | None,
    gravity: float,
    dt: float,
) -> Any:
    """Compile a model: the window, and balls that touch nothing but it.

    Args:
        window: The ground.
        places: Centres [m from the window's anchor], z in world metres, shape ``(count, 3)``.
        radii: Radii [m], shape ``(count,)``.
        spring: The contact.
        friction: Coulomb's coefficient.
        rolling: Coefficient of rolling friction; None for balls that do not turn.
        gravity: Downward acceleration [m/s^2].
        dt: Step of time [s].

    Returns:
        A ``mujoco.MjModel``. Body ``i + 1`` and geom ``i + 1`` are ball ``i``.

    Raises:
        InputError: If there are too many balls, or MuJoCo is not installed.
    """
    mujoco = mujoco_module()
    if len(places) > MOST_BALLS:
        raise InputError(f"MuJoCo is run beside at most {MOST_BALLS:,} balls, got {len(places):,}")
    rows, cols = window.shares.shape
    x, y = window.centre
    half_x, half_y = window.half
    solver = (
        f'solref="{-spring.stiffness:.17g} {-spring.damping:.17g}" '
        f'solimp="{_IMPEDANCE} {_IMPEDANCE} 0.001"'
    )
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco><option timestep="{dt!r}" gravity="0 0 {-gravity!r}" cone="elliptic" '
        f'impratio="{_FRICTION_FIRMER}">'
        # With the native narrow phase balls that fall fast are sucked into the field.
        '<flag nativeccd="disable"/></option>'
        f"<default><geom {solver}/></default>"
        f'<asset><hfield name="ground" nrow="{rows}" ncol="{cols}" '
        f'size="{half_x!r} {half_y!r} {window.range!r} {_FLOOR}"/></asset>'
        f'<worldbody><geom type="hfield" hfield="ground" pos="{x!r} {y!r} {window.lowest!r}" '
        'contype="2" conaffinity="1"/>'
        f"{''.join(_bodies(places, radii, friction, rolling))}</worldbody></mujoco>"
    )
    # Written after compiling, which would scale it to the range it has.
    model.hfield_data[:] = window.shares.ravel()
    return model


def floor_of(window: Window) -> float:
    """World z of the underside of a window's ground [m]."""
    return window.lowest - _FLOOR


def mujoco_module() -> Any:
    """MuJoCo's module.

    Raises:
        InputError: If it is not installed.
    """
    try:
        import mujoco
    except ImportError:
        raise InputError(
            "MuJoCo is not installed: pip install 'terrasim[mujoco]' to run it beside"
        ) from None
    return mujoco


def _bodies(places: Floats, radii: Floats, friction: float, rolling: float | None) -> Iterator[str]:
    """Balls as XML: their contact counts, whatever the ground's."""
    turns = rolling is not None
    joints = (
        "<freejoint/>"
        if turns
        else "".join(f'<joint type="slide" axis="{axis}"/>' for axis in ("1 0 0", "0 1 0", "0 0 1"))
    )
    condim = 6 if rolling else 3
    for place, radius in zip(places.tolist(), np.broadcast_to(radii, len(places)), strict=True):
        roll = (rolling or 0.0) * radius
        yield (
            f'<body pos="{place[0]!r} {place[1]!r} {place[2]!r}">{joints}'
            f'<geom type="sphere" size="{float(radius)!r}" contype="1" conaffinity="2" '
            f'priority="1" condim="{condim}" friction="{friction!r} 0 {roll:.17g}"/></body>'
        )
