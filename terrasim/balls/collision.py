"""How balls touch the ground and how a step is taken: chosen, because they cost differently."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, get_args

from terrasim.errors import InputError
from terrasim.kernels.body import Step

Contact = Literal["plane", "vertical"]
Integrator = Literal["event", "projected"]


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
    the ground it is put onto it and its speed turned. Its error is of first order in the step."""

    def __post_init__(self) -> None:
        """Check what was chosen.

        Raises:
            InputError: If it is not one of those there are.
        """
        for name, kinds in (("contact", Contact), ("integrator", Integrator)):
            if (got := getattr(self, name)) not in get_args(kinds):
                raise InputError(f"{name} must be one of {', '.join(get_args(kinds))}, got {got!r}")

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
        if self.integrator == "event":
            now.pull, now.calm = gravity, 0.5 * gravity * dt
        else:
            # A ball at rest meets the ground with what gravity gave it in the step: no bounce.
            now.pull, now.calm = 0.0, 1.5 * gravity * dt
        return now


AS_USUAL = Collision()
"""What balls do if nothing else is said."""
