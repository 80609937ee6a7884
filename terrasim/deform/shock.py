"""A shock: a stamp that is let go and crosses the ground as a wave."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from terrasim.counts import MAX_COUNT
from terrasim.deform.anchored import Anchor
from terrasim.deform.clock import Clock, check_duration
from terrasim.deform.dynamics import End, Field, State, array_of, check_detail, check_end
from terrasim.deform.given import Given
from terrasim.deform.patch import Patch
from terrasim.deform.shapes.checks import check_fields, check_size, refuse
from terrasim.deform.stamp_rises import Extent, posts_within, rises
from terrasim.deform.stamps import Stamp
from terrasim.deform.target import Target
from terrasim.deform.waves import Wave, check_step, check_wave
from terrasim.grid import Span


@dataclass(frozen=True)
class Shock:
    """A wave on a rectangle of ground, ``u_tt + 2 damping u_t = speed^2 laplace(u)``.

    The rectangle's edges reflect it. What of the rectangle lies beyond the terrain is cut off.
    """

    x: float
    """Middle of the rectangle, metres east of the anchor post."""
    y: float
    """Middle of the rectangle, metres north of the anchor post."""
    size_x: float
    """Width of the rectangle along x [m]."""
    size_y: float
    """Width along y [m]."""
    speed_m_s: float
    """Speed of the wave [m/s]."""
    duration_s: float
    """How long it lasts [s]."""
    damping_1_s: float = 0.0
    """Its amplitude falls as exp(-damping t) [1/s]."""
    displacement: Stamp | None = None
    """The shape it begins as: a stamp of mode add."""
    velocity: Stamp | None = None
    """The vertical velocity it begins with: a stamp of mode add whose heights are m/s."""
    zero_mean: bool = False
    """Take the mean of the velocity off it, so that the mean height of the rectangle stays."""
    substeps: int = 1
    """Steps of the wave in each step of time."""
    detail: bool = False
    """Whether it crosses the detail grid instead of the terrain's own posts."""

    name: ClassVar[str] = "shock"

    def __post_init__(self) -> None:
        """Refuse what is no such shock."""
        check_fields(self, self.name)
        for field in ("size_x", "size_y"):
            check_size(getattr(self, field), self.name, field)
        check_wave(self.name, self.speed_m_s, self.damping_1_s)
        check_duration(self.name, self.duration_s)
        if self.substeps < 1:
            refuse(self.name, "substeps", "be at least 1", self.substeps)
        if self.displacement is None and self.velocity is None:
            refuse(self.name, "displacement", "be given where there is no velocity", None)
        for field in ("displacement", "velocity"):
            stamp = getattr(self, field)
            if stamp is not None and not isinstance(stamp, Stamp):
                refuse(self.name, field, "be a stamp", repr(stamp))
            if stamp is not None and stamp.mode != "add":
                refuse(self.name, field, "be of mode add", stamp.mode)

    @property
    def extent(self) -> Extent:
        """Its rectangle: west, south, east and north end [m from its place]."""
        half_x, half_y = self.size_x / 2.0, self.size_y / 2.0
        return (-half_x, -half_y, half_x, half_y)

    @property
    def reach(self) -> float:
        """Half its longer side [m]."""
        return max(self.size_x, self.size_y) / 2.0

    @property
    def volume(self) -> float:
        """Not known before it has run."""
        return math.nan

    def span(self, target: Target, anchor: Anchor = (0, 0)) -> Span:
        """Posts of its rectangle on the terrain; empty if there are none.

        Raises:
            InputError: If it is to change others than the target's.
        """
        check_detail(self.name, self.detail, target)
        return posts_within(target, anchor, self.x, self.y, self.extent)

    def check_step(self, dt_s: float, spacing: float) -> float:
        """Refuse a step of time at which it would be unstable; returns ``c dt / dx``.

        Args:
            dt_s: Step of time [s].
            spacing: Distance between its posts [m].

        Raises:
            InputError: With the largest step there may be.
        """
        return check_step(self.name, dt_s, self.substeps, self.speed_m_s, spacing)


class RunningShock:
    """A shock on its way."""

    _step_s: float
    _first_energy: float

    def __init__(
        self,
        shock: Shock,
        target: Target,
        anchor: Anchor = (0, 0),
        *,
        device: Any = "cpu",
        threads: int = 1,
    ) -> None:
        """Prepare it; the ground gets its first shape when it is first advanced, even by 0 s.

        Args:
            shock: What it is.
            target: Posts it crosses: :func:`~terrasim.deform.target.target_of` the terrain.
            anchor: Level-0 post (row, column) that its places start from.
            device: Warp device of its two fields.
            threads: CPU threads that a launch may be split over; the bits are the same.

        Raises:
            InputError: If its rectangle holds no post of the terrain, or its first shape is beyond
                the range of heights.
        """
        span = shock.span(target, anchor)
        self._begin(shock, target, anchor, Given(shock.name, span, detail=shock.detail))
        shape = span.row1 - span.row0, span.col1 - span.col0

        def metres(stamp: Stamp | None) -> Field:
            if stamp is None:
                return np.zeros(shape)
            found = rises(stamp, target, anchor, span, device=device, threads=threads)
            return found / target.per_metre

        displacement, velocity = metres(shock.displacement), metres(shock.velocity)
        highest = float(np.abs(displacement).max()) * target.per_metre
        if highest > MAX_COUNT:
            rule = f"stay within {MAX_COUNT / target.per_metre:.6g} m on these posts"
            refuse(shock.name, "displacement", rule, highest / target.per_metre)
        if shock.zero_mean:
            velocity -= velocity.mean()
        self._wave = self._wave_of(displacement, velocity, device, threads)
        self._first_energy = self._wave.energy()

    @classmethod
    def from_state(
        cls,
        state: State,
        shock: Shock,
        target: Target,
        anchor: Anchor = (0, 0),
        *,
        device: Any = "cpu",
        threads: int = 1,
    ) -> Self:
        """Go on from what :meth:`state` gave, to the bit.

        Raises:
            InputError: If it is no state of this shock.
        """
        span = shock.span(target, anchor)
        shape = span.row1 - span.row0, span.col1 - span.col0
        one = cls.__new__(cls)
        given = array_of(state, "given", np.int32, shape, shock.name)
        kept = Given(shock.name, span, detail=shock.detail, counts=given)
        one._begin(shock, target, anchor, kept)
        displacement = array_of(state, "displacement", np.float64, shape, shock.name)
        velocity = array_of(state, "velocity", np.float64, shape, shock.name)
        clock = array_of(state, "clock", np.float64, (5,), shock.name).tolist()
        one.clock.time_s, one._step_s, one._first_energy, courant, wave_s = map(float, clock)
        [steps] = array_of(state, "steps", np.int64, (1,), shock.name).tolist()
        one._wave = one._wave_of(displacement, velocity, device, threads)
        one._wave.steps, one._wave.courant = steps, courant
        one._wave.time_s = wave_s
        return one

    @property
    def given(self) -> Given:
        """Where it is and what the ground holds of it."""
        return self._given

    @property
    def done(self) -> bool:
        """Whether its time is over."""
        return self.clock.done

    @property
    def speed(self) -> Field:
        """Vertical speed of the ground under it now [m/s], shape of its rectangle."""
        return np.zeros(self._wave.shape) if self.done else self._wave.velocity

    @property
    def displacement(self) -> Field:
        """Heights above rest [m], shape of its rectangle."""
        return self._wave.displacement

    @property
    def wave(self) -> Wave:
        """Its two fields."""
        return self._wave

    def advance(self, dt_s: float) -> Patch | None:
        """Let it go on for a time [s], at most to its end.

        Raises:
            InputError: If the time is negative, or too long for its substeps to be stable.
            RunError: If a height leaves the range of heights.
        """
        if self.done:
            return None
        self.shock.check_step(dt_s, self._target.spacing)
        gone = self.clock.go(dt_s)
        if gone > 0.0:
            self._step_s = gone / self.shock.substeps
            if self._wave.steps == 0:
                self._first_energy = self._wave.energy(self._step_s)
            self._wave.advance(gone, self.shock.substeps)
        return self._given.bring_to(self._wave.displacement * self._target.per_metre)

    def coarse(self) -> Wave:
        """The same wave on every second post, at twice the step, as far as it is now."""
        begun = type(self)(self.shock, self._target, self._anchor)
        shock, wave = self.shock, self._wave
        found = Wave(
            begun.displacement[::2, ::2].copy(),
            begun.wave.velocity[::2, ::2].copy(),
            2.0 * self._target.spacing,
            speed_m_s=shock.speed_m_s,
            damping_1_s=shock.damping_1_s,
        )
        found.advance(wave.time_s, -(-wave.steps // 2))
        return found

    def end(self, how: End) -> Patch | None:
        """End it: ``freeze`` leaves the ground as it is, ``vanish`` takes back all it was given."""
        check_end(self.shock.name, how)
        self.clock.time_s = self.clock.duration_s
        return self._given.take_back() if how == "vanish" else None

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """All that it goes on from."""
        wave = self._wave
        return {
            "displacement": wave.displacement,
            "velocity": wave.velocity,
            "given": self._given.counts.copy(),
            "clock": np.array(
                [self.clock.time_s, self._step_s, self._first_energy, wave.courant, wave.time_s]
            ),
            "steps": np.array([wave.steps], np.int64),
        }

    def summary(self) -> dict[str, Any]:
        """Its steps and what its two fields came to, ready for JSON."""
        wave = self._wave
        return {
            "kind": self.shock.name,
            "time_s": self.clock.time_s,
            "steps": wave.steps,
            "courant": wave.courant,
            "energy_start_m4_s2": self._first_energy,
            "energy_end_m4_s2": wave.energy(self._step_s),
            "mean_m": float(wave.displacement.mean()),
        }

    def _begin(self, shock: Shock, target: Target, anchor: Anchor, given: Given) -> None:
        self.shock, self._target, self._anchor, self._given = shock, target, anchor, given
        self.clock = Clock(shock.name, shock.duration_s)
        self._step_s = 0.0

    def _wave_of(self, displacement: Field, velocity: Field, device: Any, threads: int) -> Wave:
        return Wave(
            displacement,
            velocity,
            self._target.spacing,
            speed_m_s=self.shock.speed_m_s,
            damping_1_s=self.shock.damping_1_s,
            device=device,
            threads=threads,
        )
