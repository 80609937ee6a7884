"""Looking at a simulation between its steps: places, energy, depth."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.errors import RunError
from terrasim.query import sample_all
from terrasim.scenario.simulation import Setup, Simulation
from terrasim.study.exact.motion import SOLID
from terrasim.study.frames import Frames

Floats = npt.NDArray[np.float64]


def frame_steps(steps: int, frames: int) -> npt.NDArray[np.int64]:
    """Steps before which places are kept: the first, the last, and others evenly between."""
    return np.unique(np.rint(np.linspace(0, steps, frames + 1)).astype(np.int64))


class Watch:
    """What is seen of a simulation's balls."""

    def __init__(self, setup: Setup, simulation: Simulation, wanted: dict[str, Any]) -> None:
        """Look at the start.

        Args:
            setup: What the simulation was made from.
            simulation: The simulation, before its first step.
            wanted: ``frames``, ``watched_balls``, and ``every_step``: whether energy and depth
                are looked at after each.
        """
        self._setup = setup
        self._simulation = simulation
        self._gravity = setup.scenario.run.gravity_m_s2
        self._steps = frozenset(frame_steps(setup.steps, wanted["frames"]).tolist())
        self._every_step = wanted["every_step"]
        self._frames: list[tuple[float, Floats, Floats]] = []
        count = simulation.balls.balls.count if simulation.balls is not None else 0
        few = min(count, wanted["watched_balls"])
        self._few = np.unique(np.linspace(0, max(count - 1, 0), few).astype(np.int64))
        self._below = np.zeros(count, bool)
        self._deepest = 0.0
        self._drift = np.zeros(count)
        self._gain = np.zeros(count)
        self._liveliest = np.zeros(count)
        if simulation.balls is None:
            return
        state = self._state()
        self._ground, self._normal = self._surface(state[0])
        self._first = self._lowest = self._energy(*state)[0]
        self.look()

    def look(self) -> None:
        """Look at the balls as they are now."""
        if self._simulation.balls is None:
            return
        framed = self._simulation.step in self._steps
        if not framed and not self._every_step:
            return
        place, velocity, spin = self._state()
        self._require_finite(place, velocity)
        if framed:
            time_s = self._simulation.time_s
            self._frames.append((time_s, place[self._few], velocity[self._few]))
        ground, normal = self._surface(place)
        # In a hole there is no ground to be below.
        depth = np.nan_to_num(self._radii - (place[:, 2] - ground) * normal[:, 2], nan=0.0)
        self._deepest = max(self._deepest, float(depth.max(initial=0.0)))
        self._below |= place[:, 2] < ground
        energy, kinetic = self._energy(place, velocity, spin)
        self._drift = np.maximum(self._drift, np.abs(energy - self._first))
        self._lowest = np.minimum(self._lowest, energy)
        self._gain = np.maximum(self._gain, energy - self._lowest)
        self._liveliest = np.maximum(self._liveliest, kinetic)

    def frames(self, heights: Floats) -> Frames:
        """The frames that were kept, and heights sampled at the end."""
        if self._simulation.balls is None:
            none = np.zeros((0, 0, 3))
            return Frames(np.zeros(0), none, none, heights)
        times, places, velocities = zip(*self._frames, strict=True)
        few = self._few
        balls = self._simulation.balls.balls
        material = balls.material.numpy()
        rolling: Any = getattr(balls, "rolling", None)
        columns = [material[name].astype(np.float64) for name in _MATERIAL]
        columns.append(np.zeros(balls.count) if rolling is None else rolling.numpy())
        return Frames(
            np.array(times),
            np.stack(places),
            np.stack(velocities),
            heights,
            self._ground[few],
            self._normal[few],
            np.stack(columns, axis=1)[few],
        )

    def found(self) -> dict[str, Any]:
        """Energy, depth and speed, by the names of their measures."""
        if self._simulation.balls is None:
            return {"balls": 0}
        place, velocity, _ = self._state()
        speed = np.linalg.norm(velocity, axis=1)
        ground, normal = self._surface(place)
        gap = (place[:, 2] - ground) * normal[:, 2] - self._radii
        # What never moved had no energy to compare with: its change stands as it is.
        scale = np.where(self._liveliest > 0.0, self._liveliest, 1.0)
        return {
            "balls": len(speed),
            "energy_drift": float((self._drift / scale).max()),
            "energy_gain": float((self._gain / scale).max()),
            "penetration": self._deepest,
            "below": int(np.count_nonzero(self._below)),
            "fastest": float(speed.max()),
            "at_rest": int(np.count_nonzero(speed < 1e-3)),
            "gap": float(np.abs(gap).max()),
        }

    def _require_finite(self, place: Floats, velocity: Floats) -> None:
        """Stop where there is nothing left to measure."""
        bad = ~(np.isfinite(place).all(axis=1) & np.isfinite(velocity).all(axis=1))
        if bad.any():
            first = int(np.argmax(bad))
            raise RunError(
                f"ball {first} is not finite after {self._simulation.time_s:g} s: place "
                f"{place[first].tolist()} m, velocity {velocity[first].tolist()} m/s"
            )

    @property
    def _radii(self) -> Floats:
        radii: Floats = self._simulation.balls.radii
        return radii

    def _state(self) -> tuple[Floats, Floats, Floats | None]:
        moving = self._simulation.balls
        place = moving.places(self._simulation.terrain)
        spin = getattr(moving.balls, "spin", None)
        return place, moving.balls.velocity.numpy(), None if spin is None else spin.numpy()

    def _surface(self, place: Floats) -> tuple[Floats, Floats]:
        """Height and normal of the ground under balls."""
        grid = self._simulation.terrain.grid
        row, col = self._setup.anchor
        origin = np.array([grid.post_x(col), grid.post_y(row)])
        answer = sample_all(self._simulation.terrain, origin + place[:, :2])
        return answer.height, answer.normal

    def _energy(
        self, place: Floats, velocity: Floats, spin: Floats | None
    ) -> tuple[Floats, Floats]:
        """Energy and kinetic energy of each ball for a kilogram [J/kg]."""
        kinetic = 0.5 * np.sum(velocity**2, axis=1)
        if spin is not None:
            kinetic = kinetic + 0.5 * SOLID * self._radii**2 * np.sum(spin**2, axis=1)
        return kinetic + self._gravity * place[:, 2], kinetic


_MATERIAL = ("radius", "restitution", "friction")
