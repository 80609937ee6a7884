"""Springs and dampers of balls: what a step may be, and what damping gives a restitution.

Explicit stepping of a spring that only pushes gains energy at any step, so it is allowed up to a
fifth of the step at which it becomes unstable; there a bounce gains a few parts in a hundred.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from terrasim.errors import InputError

ALLOWED = 0.2
"""Part of the limit up to which a step is taken explicitly."""
LEAST_RESTITUTION = 1e-3
"""Restitution that balls of less are damped for: none at all would need endless damping."""
MOST_STEPS = 100_000
"""Steps that one step is parted into at most."""

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Limits:
    """What the springs of some balls allow."""

    step: float
    """The step at which the first ball becomes unstable if stepped explicitly [s]."""
    push: float
    """No contact speeds a ball up more than this [m/s^2]."""
    radius: float
    """No ball is larger [m]."""

    def kick(self, dt: float) -> float:
        """No contact gives a ball more speed in a step than this [m/s]."""
        return min(self.push * dt, max(self.radius / dt, self.push * min(dt, self.step)))


def explicit_limit(stiffness: Floats, damping: Floats) -> Floats:
    """The step at which a mass on a spring and a damper becomes unstable, stepped explicitly [s].

    ``2 sqrt(m / k)`` for the spring and ``2 m / c`` for the damper; together the step at which
    ``(dt / dt_k)^2 + dt / dt_c`` is 1.

    Args:
        stiffness: Stiffness of a kilogram [1/s^2], at least 0.
        damping: Damping of a kilogram [1/s], at least 0.
    """
    # The positive root of dt^2 k / 4 + dt c / 2 = 1, in the form that does not cancel.
    with np.errstate(divide="ignore"):
        return np.asarray(4.0 / (damping + np.sqrt(damping * damping + 4.0 * stiffness)))


def damping_ratio(restitution: float) -> float:
    """Damping over critical damping that gives a restitution, for a contact that never pulls.

    From ``e = exp(-2 a / tan(a))`` with ``cos(a)`` the ratio, and ``exp(-2 a / tanh(a))`` with
    ``cosh(a)`` it over critical damping: the force ends where the damper would begin to pull.
    """
    wanted = -math.log(max(restitution, LEAST_RESTITUTION))
    under = wanted < 2.0
    # Both sides of critical damping are monotonic in the angle.
    low, high = 0.0, 0.5 * math.pi if under else wanted
    for _ in range(200):
        middle = 0.5 * (low + high)
        if under:
            beyond = 2.0 * middle / math.tan(middle) > wanted
        else:
            beyond = 2.0 * middle / math.tanh(middle) < wanted
        low, high = (middle, high) if beyond else (low, middle)
    angle = 0.5 * (low + high)
    return math.cos(angle) if under else math.cosh(angle)


def rates_of(stiffness: float, damping: float | None, mass: Floats, restitution: Floats) -> Floats:
    """Stiffness [1/s^2] and damping [1/s] of a kilogram, shape ``(count, 2)``.

    Args:
        stiffness: Of a contact [N/m].
        damping: Of a contact [N s/m]; None for what gives each ball's restitution.
        mass: Masses [kg].
        restitution: Restitutions.
    """
    each = stiffness / mass
    if damping is not None:
        return np.column_stack([each, damping / mass])
    kinds, which = np.unique(restitution, return_inverse=True)
    ratio = np.array([damping_ratio(float(one)) for one in kinds])[which]
    return np.column_stack([each, 2.0 * ratio * np.sqrt(each)])


def limits_of(rates: Floats, radius: Floats) -> Limits:
    """What springs allow."""
    step = float(explicit_limit(rates[:, 0], rates[:, 1]).min(initial=math.inf))
    return Limits(
        step, float((rates[:, 0] * radius).max(initial=0.0)), float(radius.max(initial=0))
    )


def sub_steps(limit: float, dt: float) -> int:
    """Into how many steps one is parted so that each may be taken explicitly.

    Raises:
        InputError: If there would be too many.
    """
    count = math.ceil(dt / (ALLOWED * limit) * (1.0 - 1e-12))
    if count > MOST_STEPS:
        raise InputError(
            f"dt = {dt:g} s would take {count} steps of {ALLOWED:g} of the explicit limit of "
            f"{limit:.3g} s, at most {MOST_STEPS} are made; take integrator = 'implicit'"
        )
    return max(count, 1)
