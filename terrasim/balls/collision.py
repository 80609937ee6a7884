"""How balls touch the ground and how a step is taken: chosen, because they cost differently."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

from terrasim.balls.springs import ALLOWED, sub_steps
from terrasim.errors import InputError
from terrasim.kernels.body import Step

Contact = Literal["plane", "vertical"]
Integrator = Literal["event", "projected", "spring", "implicit"]
OverLimit = Literal["refuse", "substep", "implicit"]


@dataclass(frozen=True)
class Collision:
    """What balls do when they meet the ground."""

    contact: Contact = "plane"
    """``plane``: a ball touches the plane of the triangle under its centre. ``vertical``: it
    touches what lies a radius under its centre, whatever the slope there; on a slope it stands too
    low, by its radius times what the secant of the slope is over 1."""
    integrator: Integrator = "event"
    """``event``: exact flight between impacts, each at its time. ``projected``: semi-implicit
    Euler; gravity acts at the start of a step, then the ball goes straight on, and where it meets
    the ground it is put onto it and its speed turned. Its error is of first order in the step.
    ``spring``: a spring and a damper push the ball out of the ground, by the force at the step's
    start; ``implicit``: by that at its end, which is stable at any step and adds no energy on a
    plane; from one triangle to the next it may."""
    stiffness: float | None = None
    """Stiffness of springs [N/m]."""
    damping: float | None = None
    """Damping of springs [N s/m]; by default what gives each ball's restitution."""
    over_limit: OverLimit = "refuse"
    """What to do about a step over a fifth of the explicit limit of ``spring``: refuse it, part it
    into smaller ones, or take it implicitly."""

    sleep: bool = False
    """Whether balls that rest are left out of steps until the ground under them changes."""

    def __post_init__(self) -> None:
        """Check what was chosen.

        Raises:
            InputError: If it is not one of those there are, or a number is out of its range.
        """
        choices = (("contact", Contact), ("integrator", Integrator), ("over_limit", OverLimit))
        for name, kinds in choices:
            if (got := getattr(self, name)) not in get_args(kinds):
                raise InputError(f"{name} must be one of {', '.join(get_args(kinds))}, got {got!r}")

        for name, unit in (("stiffness", "N/m"), ("damping", "N s/m")):
            value = getattr(self, name)
            if value is None:
                continue
            if not self.sprung:
                raise InputError(
                    f"{name} is of springs: it needs integrator = 'spring' or 'implicit', "
                    f"got {self.integrator!r}"
                )
            if not (math.isfinite(value) and value >= 0.0):
                raise InputError(f"{name} must be at least 0 {unit} and finite, got {value}")
        if self.sprung and self.stiffness is None:
            raise InputError(f"integrator = {self.integrator!r} needs a stiffness [N/m]")

    @property
    def sprung(self) -> bool:
        """Whether balls touch the ground by springs."""
        return self.integrator in {"spring", "implicit"}

    def parts(self, dt: float, limit: float) -> tuple[int, bool]:
        """Into how many steps one is parted, and whether they are taken implicitly.

        Args:
            dt: The step [s].
            limit: The step at which explicit stepping becomes unstable [s].

        Raises:
            InputError: If the step is over the limit and to be refused, or would be too many.
        """
        over = self.integrator == "spring" and dt > ALLOWED * limit
        if not over:
            return 1, self.integrator == "implicit"
        if self.over_limit == "refuse":
            raise InputError(
                f"dt = {dt:g} s is over {ALLOWED:g} of the explicit limit of {limit:.4g} s of "
                f"stiffness, damping and mass: take at most {ALLOWED * limit:.4g} s, or "
                "over_limit = 'substep' or 'implicit'"
            )
        return (1, True) if self.over_limit == "implicit" else (sub_steps(limit, dt), False)

    @property
    def upright(self) -> int:
        """1 for contact by the height under the centre alone."""
        return int(self.contact == "vertical")

    def step(self, dt: float, gravity: float) -> Any:
        """A step of time, ``kernels.body.Step``.

        Args:
            dt: Length of the step [s], above 0.
            gravity: Downward acceleration [m/s^2], at least 0.

        Raises:
            InputError: If one is out of its range.
        """
        if not (math.isfinite(dt) and dt > 0.0):
            raise InputError(f"dt must be above 0 s and finite, got {dt}")
        if not (math.isfinite(gravity) and gravity >= 0.0):
            raise InputError(f"gravity must be at least 0 m/s^2 and finite, got {gravity}")
        now: Any = Step()
        now.dt, now.gravity, now.upright = dt, gravity, self.upright
        if self.integrator != "projected":
            now.pull, now.calm = gravity, 0.5 * gravity * dt
        else:
            # A ball at rest meets the ground with what gravity gave it in the step: no bounce.
            now.pull, now.calm = 0.0, 1.5 * gravity * dt
        return now


AS_USUAL = Collision()
"""What balls do if nothing else is said."""
