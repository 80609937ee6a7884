"""A stamp that grows or decays: its whole shape times a factor that changes over time."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, Self

import numpy as np
import numpy.typing as npt

from terrasim.counts import MAX_COUNT
from terrasim.deform.anchored import Anchor
from terrasim.deform.clock import Clock, check_duration
from terrasim.deform.dynamics import End, Field, State, array_of, check_detail, check_end
from terrasim.deform.given import Given
from terrasim.deform.patch import Patch
from terrasim.deform.profiles import Linear, Profile
from terrasim.deform.shapes.checks import check_fields, refuse
from terrasim.deform.stamp_rises import posts_within, rises
from terrasim.deform.stamps import Stamp
from terrasim.deform.target import Target
from terrasim.grid import Span


@dataclass(frozen=True)
class Growth:
    """A stamp of mode add times a profile over time.

    Where the profile is 1 the ground has what applying the stamp adds, to the bit.
    """

    stamp: Stamp
    """The stamp, of mode add; its ``detail`` says which posts change."""
    duration_s: float
    """How long it lasts [s]."""
    profile: Profile = field(default_factory=Linear)
    """How much of it there is, over the part of the duration that has gone."""

    name: ClassVar[str] = "growth"

    def __post_init__(self) -> None:
        """Refuse what is no such growth."""
        check_fields(self, self.name)
        check_duration(self.name, self.duration_s)
        if not isinstance(self.stamp, Stamp):
            refuse(self.name, "stamp", "be a stamp", repr(self.stamp))
        if self.stamp.mode != "add":
            refuse(self.name, "stamp", "be of mode add", self.stamp.mode)
        if not isinstance(self.profile, Profile):
            refuse(self.name, "profile", "be a profile", repr(self.profile))

    @property
    def detail(self) -> bool:
        """Whether it changes the detail grid instead of the terrain's own posts."""
        return self.stamp.detail

    def span(self, target: Target, anchor: Anchor = (0, 0)) -> Span:
        """Posts of the terrain that it may change; empty if there are none.

        Raises:
            InputError: If it is to change others than the target's.
        """
        check_detail(self.name, self.detail, target)
        return posts_within(target, anchor, self.stamp.x, self.stamp.y, self.stamp.extent)


class RunningGrowth:
    """A stamp while it grows or decays."""

    def __init__(
        self,
        growth: Growth,
        target: Target,
        anchor: Anchor = (0, 0),
        *,
        device: Any = "cpu",
        threads: int = 1,
    ) -> None:
        """Prepare it; the ground gets what it begins with when it is first advanced, even by 0 s.

        Args:
            growth: What it is.
            target: Posts it changes: :func:`~terrasim.deform.target.target_of` the terrain.
            anchor: Level-0 post (row, column) that its place starts from.
            device: Warp device to compute its shape on.
            threads: CPU threads.

        Raises:
            InputError: If it touches no post of the terrain, or is higher than heights may be.
        """
        self.growth, self._target = growth, target
        self.clock = Clock(growth.name, growth.duration_s)
        self._steps = 0
        self._given = Given(growth.name, growth.span(target, anchor), detail=growth.detail)
        span = self._given.span
        self._whole = rises(growth.stamp, target, anchor, span, device=device, threads=threads)
        most = growth.profile.largest * float(np.abs(self._whole).max())
        if most > MAX_COUNT:
            rule = f"stay within {MAX_COUNT / target.per_metre:.6g} m at its largest factor"
            refuse(growth.name, "stamp", rule, most / target.per_metre)

    @classmethod
    def from_state(
        cls,
        state: State,
        growth: Growth,
        target: Target,
        anchor: Anchor = (0, 0),
        *,
        device: Any = "cpu",
        threads: int = 1,
    ) -> Self:
        """Go on from what :meth:`state` gave, to the bit.

        Raises:
            InputError: If it is no state of this growth.
        """
        one = cls(growth, target, anchor, device=device, threads=threads)
        shape = one._whole.shape
        one._given.counts = array_of(state, "given", np.int32, shape, growth.name).copy()
        [one.clock.time_s] = array_of(state, "clock", np.float64, (1,), growth.name).tolist()
        [one._steps] = array_of(state, "steps", np.int64, (1,), growth.name).tolist()
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
        if self.done:
            return np.zeros(self._whole.shape)
        rate = self.growth.profile.rate(self.clock.part) / self.growth.duration_s
        return self._whole * (rate / self._target.per_metre)

    def advance(self, dt_s: float) -> Patch | None:
        """Let it go on for a time [s], at most to its end.

        Raises:
            InputError: If the time is negative.
        """
        if self.done:
            return None
        self._steps += self.clock.go(dt_s) > 0.0
        return self._given.bring_to(self._whole * self.growth.profile.factor(self.clock.part))

    def end(self, how: End) -> Patch | None:
        """End it: ``freeze`` leaves the ground as it is, ``vanish`` takes back all it was given."""
        check_end(self.growth.name, how)
        self.clock.time_s = self.clock.duration_s
        return self._given.take_back() if how == "vanish" else None

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """All that it goes on from beside what it is."""
        return {
            "given": self._given.counts.copy(),
            "clock": np.array([self.clock.time_s]),
            "steps": np.array([self._steps], np.int64),
        }

    def summary(self) -> dict[str, Any]:
        """How far it came, ready for JSON."""
        return {
            "kind": self.growth.name,
            "time_s": self.clock.time_s,
            "steps": self._steps,
            "factor": self.growth.profile.factor(self.clock.part),
        }
