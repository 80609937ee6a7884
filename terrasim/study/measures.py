"""What a study can measure."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from terrasim.study.frames import Floats, Frames

Seen = dict[str, Any]
"""What a variant's process found, by name."""


@dataclass(frozen=True)
class Measure:
    """Something that is measured."""

    unit: str
    """Its unit; empty for a plain number."""
    meaning: str
    """What it is, in words."""
    found: Callable[[Seen], Any] | None = None
    """Its value in what a variant's process found; None if it needs a reference."""
    referred: Callable[[Frames, Frames], float | None] | None = None
    """Its value from what was seen and what should have been seen."""
    accuracy: bool = False
    """Whether less of it is better, as is drawn against run time."""


def shared_times(seen: Frames, true: Frames) -> tuple[Any, Any]:
    """Numbers of the frames that two hold at the same time."""
    close = np.isclose(seen.times_s[:, None], true.times_s[None, :], rtol=1e-9, atol=1e-12)
    mine, theirs = np.nonzero(close)
    return mine, theirs


def _apart(seen: Frames, true: Frames) -> Floats:
    """Distances of places at shared times [m], shape ``(frames, balls)``; of heights, one frame."""
    if not seen.places.size:
        return np.abs(seen.heights - true.heights)[None, :]
    mine, theirs = shared_times(seen, true)
    found: Floats = np.linalg.norm(seen.places[mine] - true.places[theirs], axis=-1)
    return found


def _end_error(seen: Frames, true: Frames) -> float | None:
    return _largest(_apart(seen, true)[-1:])


def _end_rms(seen: Frames, true: Frames) -> float | None:
    apart = _apart(seen, true)[-1:]
    known = apart[np.isfinite(apart)]
    return float(np.sqrt(np.mean(known**2))) if known.size else None


def _path_error(seen: Frames, true: Frames) -> float | None:
    return _largest(_apart(seen, true))


def _speed_error(seen: Frames, true: Frames) -> float | None:
    mine, theirs = shared_times(seen, true)
    apart = np.linalg.norm(seen.velocities[mine] - true.velocities[theirs], axis=-1)
    return _largest(apart[-1:])


def _largest(values: Floats) -> float | None:
    # A hole has no height in either.
    known = values[np.isfinite(values)]
    return float(known.max()) if known.size else None


def _of(name: str) -> Callable[[Seen], Any]:
    return lambda seen: seen.get(name)


def _per_step(seen: Seen) -> float | None:
    return seen["run_time"] / seen["steps"] if seen["steps"] else None


def _per_ball_step(seen: Seen) -> float | None:
    done = seen["steps"] * seen["balls"]
    return 1e9 * seen["step_time"] / done if done else None


_COUNTED = {
    "impacts": "times that balls struck the ground",
    "projected": "times that balls were lifted out of the ground",
    "held": "steps in which a ball met too many events",
    "off": "steps that took a ball beyond the terrain",
    "hole": "steps that took a ball over a hole",
    "coarse": "steps in which a coarser level stood in",
    "at_rest": "balls slower than 1 mm/s at the end",
}

MEASURES: dict[str, Measure] = {
    "error": Measure(
        "m", "largest distance from the reference at the end", None, _end_error, True
    ),
    "error_rms": Measure("m", "root mean square of that distance", None, _end_rms, True),
    "error_path": Measure(
        "m", "largest distance from the reference at any frame", None, _path_error, True
    ),
    "error_velocity": Measure(
        "m/s", "largest difference of velocity from the reference at the end", None, _speed_error,
        True,
    ),
    "energy_drift": Measure(
        "", "largest change of a ball's energy, over its largest kinetic energy",
        _of("energy_drift"), accuracy=True,
    ),
    "energy_gain": Measure(
        "", "most that a ball's energy rose again, over its largest kinetic energy",
        _of("energy_gain"), accuracy=True,
    ),
    "penetration": Measure(
        "m", "deepest that a ball stood in the plane of the triangle under it after a step",
        _of("penetration"), accuracy=True,
    ),
    "below": Measure(
        "", "balls whose centre was below the surface after a step", _of("below"),
    ),
    "fastest": Measure("m/s", "speed of the fastest ball at the end", _of("fastest")),
    "run_time": Measure("s", "wall time of all steps and samples", _of("run_time")),
    "cpu_time": Measure("s", "CPU time of all threads in that", _of("cpu_time")),
    "run_time_per_step": Measure("s", "wall time of a step", _per_step),
    "run_time_per_ball_step": Measure(
        "ns", "wall time of moving one ball by one step", _per_ball_step
    ),
    "memory": Measure("B", "most memory that the process held", _of("memory")),
    "device_memory": Measure("B", "most that Warp's allocator counted", _of("device_memory")),
    "stalls": Measure("", "steps that waited for ground", _of("stalls")),
    **{name: Measure("", meaning, _of(name)) for name, meaning in _COUNTED.items()},
}  # fmt: skip
"""Every measure by its name."""

REFERRED = frozenset(name for name, one in MEASURES.items() if one.referred is not None)
"""Those that need a reference."""
LOOKED = frozenset({"energy_drift", "energy_gain", "penetration", "below"})
"""Those that are looked at after every step."""
ACCURACY = tuple(name for name, one in MEASURES.items() if one.accuracy)
"""Those that are drawn against run time."""


def measured(
    names: tuple[str, ...], found: Seen, seen: Frames | None, true: Frames | None
) -> dict[str, float | None]:
    """Values of measures by name; None where one does not apply."""
    values: dict[str, float | None] = {}
    for name in names:
        one = MEASURES[name]
        if one.referred is None:
            assert one.found is not None
            value = one.found(found)
        else:
            value = one.referred(seen, true) if seen is not None and true is not None else None
        values[name] = None if value is None else float(value)
    return values
