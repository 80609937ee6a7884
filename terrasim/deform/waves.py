"""A wave that crosses a rectangle of posts: ``u_tt + 2 gamma u_t = c^2 laplace(u)``.

Leap-frog on the five-point star, velocities half a step from the displacements inside a call and
with them at its ends. It is stable while ``c dt / dx <= 1 / sqrt(2)``; more is refused. What the
damping takes is exact at any step: every wave falls by ``exp(-gamma dt)``. The rectangle's edges
reflect it: they lie half a spacing beyond the outermost posts, so that each post stands for its own
square and the mean of the heights moves only by the mean of the velocities.

Without damping the energy of :meth:`Wave.energy` is the same after every step but for rounding.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.errors import InputError
from terrasim.kernels import waves as kernels
from terrasim.launch import launch

Field = npt.NDArray[np.float64]

COURANT_LIMIT = 1.0 / math.sqrt(2.0)
"""Largest ``c dt / dx`` at which the scheme is stable."""
MOST_POSTS = 2**30
"""Posts of a wave: 24 bytes each."""
_WIDTH = {False: 64, True: 1}
"""Posts that one thread takes, on the CPU and on CUDA."""


class Wave:
    """Two fields on a rectangle of posts: how far each stands from rest, and how fast it moves."""

    def __init__(
        self,
        displacement: Field,
        velocity: Field,
        spacing: float,
        *,
        speed_m_s: float,
        damping_1_s: float = 0.0,
        device: Any = "cpu",
        threads: int = 1,
    ) -> None:
        """Begin from two fields.

        Args:
            displacement: Heights above rest [m], float64, shape ``(rows, cols)``.
            velocity: Vertical velocities [m/s], float64, same shape.
            spacing: Distance between posts [m].
            speed_m_s: Speed ``c`` of the wave [m/s].
            damping_1_s: ``gamma``: the amplitude falls as ``exp(-gamma t)`` [1/s].
            device: Warp device of the fields.
            threads: CPU threads that a launch may be split over; the bits are the same.

        Raises:
            InputError: If a field is empty, holds what is no finite number or has not the other's
                shape, or a number is out of its range.
        """
        check_wave("wave", speed_m_s, damping_1_s)
        if not (math.isfinite(spacing) and spacing > 0.0):
            raise InputError(f"wave: spacing must be above 0 m, got {spacing}")
        self.shape = _shape_of(displacement, velocity)
        self.spacing, self.speed_m_s, self.damping_1_s = spacing, speed_m_s, damping_1_s
        self.time_s = 0.0
        """Time that has gone [s]."""
        self.steps = 0
        """Steps taken."""
        self.courant = 0.0
        """Largest ``c dt / dx`` so far."""
        self._device = wp.get_device(device)
        self._threads = threads
        self._displacement = self._sent(displacement.reshape(-1), wp.float64)
        self._velocity = self._sent(velocity.reshape(-1), wp.float64)
        self._rectangle: Any = kernels.Rectangle()
        self._rectangle.rows, self._rectangle.cols = self.shape
        self._rectangle.width = _WIDTH[self._device.is_cuda]
        self._place = self._sent(_runs(self.shape, self._rectangle.width), wp.vec2i)

    @property
    def displacement(self) -> Field:
        """Heights above rest [m], shape ``(rows, cols)``; a copy."""
        field: Field = self._displacement.numpy().reshape(self.shape).copy()
        return field

    @property
    def velocity(self) -> Field:
        """Vertical velocities [m/s], shape ``(rows, cols)``; a copy."""
        field: Field = self._velocity.numpy().reshape(self.shape).copy()
        return field

    def advance(self, dt_s: float, substeps: int = 1) -> None:
        """Let time go on.

        Args:
            dt_s: By how much [s]; 0 changes nothing.
            substeps: Steps that it is done in.

        Raises:
            InputError: If the time is negative, or a step would be unstable.
        """
        if dt_s == 0.0:
            return
        courant = check_step("wave", dt_s, substeps, self.speed_m_s, self.spacing)
        step = dt_s / substeps
        self.courant = max(self.courant, courant)
        # Half a step's damping, and what the pull of half a step comes to under it: two of these
        # make a whole step's exp(-2 gamma dt).
        keep = math.exp(-self.damping_1_s * step)
        half = step * (1.0 + keep * keep) / (2.0 * (1.0 + keep))
        rate = (self.speed_m_s / self.spacing) ** 2
        self._kick(keep, half * rate)
        for _ in range(substeps - 1):
            self._drift(step)
            self._kick(keep * keep, (1.0 + keep) * half * rate)
        self._drift(step)
        self._kick(keep, half * rate)
        self.steps += substeps
        self.time_s += dt_s

    def energy(self, step_s: float = 0.0) -> float:
        """The energy of the wave [m^4/s^2]: that of a ground of unit mass a square metre.

        ``sum(v^2 + c^2 |grad u|^2 - (dt c^2 laplace(u) / 2)^2) / 2`` times a post's square. The
        last term is what leap-frog steps of ``dt`` keep beside the energy itself.

        Args:
            step_s: The steps' size ``dt`` [s].
        """
        u, v = self.displacement, self.velocity
        slopes = [np.diff(u, axis=axis) / self.spacing for axis in (0, 1)]
        square = sum(float(np.sum(slope * slope)) for slope in slopes)
        pull = laplace(u, self.spacing) * (0.5 * step_s * self.speed_m_s**2)
        total = float(np.sum(v * v)) + self.speed_m_s**2 * square - float(np.sum(pull * pull))
        return 0.5 * self.spacing**2 * total

    def _kick(self, keep: float, pull: float) -> None:
        self._launch(kernels.kick, [keep, pull, self._displacement, self._velocity])

    def _drift(self, step: float) -> None:
        self._launch(kernels.drift, [step, self._velocity, self._displacement])

    def _launch(self, kernel: Any, shared: list[Any]) -> None:
        launch(
            kernel,
            len(self._place),
            shared=[self._rectangle, *shared],
            items=[self._place],
            device=self._device,
            threads=self._threads,
        )

    def _sent(self, values: npt.NDArray[Any], dtype: Any) -> Any:
        return wp.array(values, dtype=dtype, device=self._device)


def wave_bytes(rows: int, cols: int, *, cuda: bool = False) -> int:
    """Bytes on the device of a wave of so many posts."""
    return 16 * rows * cols + 8 * rows * -(-cols // _WIDTH[cuda])


def laplace(field: Field, spacing: float) -> Field:
    """The five-point sum of a field over its spacing squared, as the wave has it."""
    edged = np.pad(field, 1, mode="edge")
    across = (edged[1:-1, :-2] - field) + (edged[1:-1, 2:] - field)
    along = (edged[:-2, 1:-1] - field) + (edged[2:, 1:-1] - field)
    total: Field = (across + along) / spacing**2
    return total


def check_wave(name: str, speed_m_s: float, damping_1_s: float) -> None:
    """Refuse what is no speed, or a damping that would feed the wave.

    Raises:
        InputError: With name, field, rule and value.
    """
    if not (math.isfinite(speed_m_s) and speed_m_s > 0.0):
        raise InputError(f"{name}: speed_m_s must be above 0 m/s and finite, got {speed_m_s}")
    if not (math.isfinite(damping_1_s) and damping_1_s >= 0.0):
        raise InputError(
            f"{name}: damping_1_s must be at least 0 1/s and finite, got {damping_1_s}"
        )


def check_step(name: str, dt_s: float, substeps: int, speed_m_s: float, spacing: float) -> float:
    """Refuse a step at which the scheme is unstable; returns ``c dt / dx``.

    Raises:
        InputError: With name, field, rule and value, the largest step there may be, and how many
            it takes.
    """
    if substeps < 1:
        raise InputError(f"{name}: substeps must be at least 1, got {substeps}")
    if not (math.isfinite(dt_s) and dt_s >= 0.0):
        raise InputError(f"{name}: dt_s must be at least 0 s and finite, got {dt_s}")
    largest = COURANT_LIMIT * spacing / speed_m_s
    if dt_s / substeps > largest:
        raise InputError(
            f"{name}: a step of {dt_s / substeps:.6g} s is over the stability limit of "
            f"{largest:.6g} s (spacing / (speed_m_s sqrt 2), {spacing:g} m and {speed_m_s:g} m/s); "
            f"take at least {math.ceil(dt_s / largest)} substeps"
        )
    return speed_m_s * dt_s / substeps / spacing


def _shape_of(displacement: Field, velocity: Field) -> tuple[int, int]:
    for name, field in (("displacement", displacement), ("velocity", velocity)):
        if field.dtype != np.float64 or field.ndim != 2 or field.size == 0:
            raise InputError(
                f"wave: {name} must be float64, 2-D and not empty, got {field.dtype} {field.shape}"
            )
        if field.size > MOST_POSTS:
            raise InputError(f"wave: at most {MOST_POSTS} posts, got {field.size}; make it smaller")
        if not np.isfinite(field).all():
            raise InputError(f"wave: {name} must be finite, got {field[~np.isfinite(field)][0]}")
    if displacement.shape != velocity.shape:
        raise InputError(
            f"wave: velocity must have the displacement's shape {displacement.shape}, "
            f"got {velocity.shape}"
        )
    rows, cols = displacement.shape
    return rows, cols


def _runs(shape: tuple[int, int], width: int) -> npt.NDArray[np.int32]:
    """Row and first column of each run of posts."""
    rows, first = np.meshgrid(np.arange(shape[0]), np.arange(0, shape[1], width), indexing="ij")
    return np.stack([rows.reshape(-1), first.reshape(-1)], axis=1).astype(np.int32)
