"""Where balls were at some times, and what a study compares them by."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


def _none(*shape: int) -> Floats:
    return np.zeros(shape)


@dataclass(frozen=True)
class Frames:
    """Balls at some times; for a scenario without balls the heights it samples, at its end."""

    times_s: Floats
    """Times [s], rising, shape ``(frames,)``."""
    places: Floats
    """Centres: east and north of the anchor, world z [m], shape ``(frames, balls, 3)``."""
    velocities: Floats
    """Velocities [m/s], shape ``(frames, balls, 3)``."""
    heights: Floats = field(default_factory=lambda: _none(0))
    """Sampled heights at the end [m], shape ``(places,)``; NaN in holes."""
    ground: Floats = field(default_factory=lambda: _none(0))
    """World z of the surface under each ball at first [m], shape ``(balls,)``."""
    normal: Floats = field(default_factory=lambda: _none(0, 3))
    """Its upward unit normal, shape ``(balls, 3)``."""
    material: Floats = field(default_factory=lambda: _none(0, 4))
    """Radius [m], restitution, friction and rolling friction, shape ``(balls, 4)``."""

    def save(self, path: Path) -> None:
        """Write them into one file."""
        arrays = {one.name: getattr(self, one.name) for one in fields(self)}
        with path.open("wb") as file:
            np.savez_compressed(file, **arrays)

    @classmethod
    def load(cls, path: Path) -> Frames:
        """Read what was saved."""
        with np.load(path, allow_pickle=False) as file:
            return cls(**{one.name: file[one.name] for one in fields(cls)})
