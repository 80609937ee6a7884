"""The files a scenario asks for: picture, stage, tables."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from terrasim.counts import COUNT_M, HOLE
from terrasim.errors import RunError
from terrasim.grid import Span
from terrasim.output.usd import Place
from terrasim.output.views import Happening, site, views_of
from terrasim.output.window import read_window
from terrasim.scenario.recording import Recording
from terrasim.scenario.samples import Sampled
from terrasim.scenario.schedule import schedule
from terrasim.scenario.simulation import Setup, Simulation, stamps_of

PICTURE, STAGE = "picture.png", "scene.usdc"
BALL_TABLE, SAMPLE_TABLE = "balls.parquet", "samples.parquet"


def happening(setup: Setup, simulation: Simulation, recording: Recording) -> Happening:
    """Where things happened."""
    radii = simulation.balls.radii if simulation.balls is not None else np.zeros(0)
    stamps = stamps_of(schedule(setup.scenario, images=setup.images))
    if simulation.dynamics is not None:
        stamps = [*stamps, *simulation.dynamics.footprints]
    return Happening(stamps, recording.places[:, :, :2], radii)


def write_picture(folder: Path, setup: Setup, simulation: Simulation, recording: Recording) -> None:
    """Draw the ground with what happened on it.

    Raises:
        RunError: If the file cannot be written.
    """
    from terrasim.output.picture import Tracks, draw_picture

    happened = happening(setup, simulation, recording)
    synthetic = setup.source.synthetic
    draw_picture(
        folder / PICTURE,
        views_of(simulation.terrain, setup.anchor, happened),
        title=setup.scenario.name + (f" after {simulation.time_s:g} s" if setup.steps else ""),
        note=f"synthetic heights: {synthetic}" if synthetic else "",
        tracks=Tracks(happened.places, happened.radii) if happened.places.size else None,
    )


def write_stage_file(
    folder: Path, setup: Setup, simulation: Simulation, recording: Recording
) -> None:
    """Write the USD stage.

    Raises:
        RunError: If the file cannot be written.
    """
    from terrasim.output.usd import Clock, write_stage

    assert recording.tiles is not None
    scenario = setup.scenario
    synthetic = setup.source.synthetic
    words = [scenario.description, f"Synthetic heights: {synthetic}." if synthetic else ""]
    write_stage(
        folder / STAGE,
        recording.tiles.prims(0.0, 1.0),
        _ball_prims(setup, simulation, recording),
        Clock(0.0, recording.time_code(simulation.time_s), scenario.output.frames_per_s),
        eye=_camera(setup, simulation, recording),
        documentation=" ".join(filter(None, words)),
    )


def _ball_prims(setup: Setup, simulation: Simulation, recording: Recording) -> Any:
    from terrasim.output.usd import BallPrims

    places = recording.places
    if not places.size:
        return None
    x, y = _anchor_place(setup)
    # About the balls' own height, so that float32 holds them to less than a millimetre.
    height = float(np.round(places[..., 2].mean()))
    positions = {
        recording.time_code(time_s): (frame - [0.0, 0.0, height]).astype(np.float32)
        for time_s, frame in zip(recording.times_s, places, strict=True)
    }
    return BallPrims((x, y, height), simulation.balls.radii.astype(np.float32), positions)


def _camera(
    setup: Setup, simulation: Simulation, recording: Recording
) -> tuple[Place, Place] | None:
    """South of where things happen and above it."""
    square = site(happening(setup, simulation, recording))
    if square is None:
        return None
    x, y = _anchor_place(setup)
    grid = simulation.terrain.grid
    row = setup.anchor[0] + round(square.y / grid.spacing)
    col = setup.anchor[1] + round(square.x / grid.spacing)
    post = int(read_window(simulation.terrain, 0, Span(row, row + 1, col, col + 1))[0, 0])
    ground = grid.datum + (0.0 if post == HOLE else post * COUNT_M)
    target = (x + square.x, y + square.y, ground)
    eye = (x + square.x, y + square.y - 2.2 * square.half, ground + 1.6 * square.half)
    return eye, target


def _anchor_place(setup: Setup) -> tuple[float, float]:
    """World place of the anchor post [m]."""
    grid = setup.source.grid
    return float(grid.post_x(setup.anchor[1])), float(grid.post_y(setup.anchor[0]))


def write_ball_table(folder: Path, recording: Recording) -> None:
    """Balls over time: metres from the anchor, and world height.

    Raises:
        RunError: If the file cannot be written.
    """
    places = recording.places
    frames, count = places.shape[:2]
    _write_table(
        folder / BALL_TABLE,
        {
            "time_s": np.repeat(np.array(recording.times_s), count),
            "ball": np.tile(np.arange(count, dtype=np.int32), frames),
            "east_m": places[..., 0].reshape(-1),
            "north_m": places[..., 1].reshape(-1),
            "z_m": places[..., 2].reshape(-1),
        },
    )


def write_sample_table(folder: Path, sampled: list[Sampled]) -> None:
    """Places that were asked for: metres from the anchor, and world height.

    Raises:
        RunError: If the file cannot be written.
    """
    groups = [np.full(len(one.height), i + 1, np.int32) for i, one in enumerate(sampled)]
    _write_table(
        folder / SAMPLE_TABLE,
        {
            "group": np.concatenate(groups),
            "east_m": np.concatenate([one.places[:, 0] for one in sampled]),
            "north_m": np.concatenate([one.places[:, 1] for one in sampled]),
            "z_m": np.concatenate([one.height for one in sampled]),
            "state": np.concatenate([one.state for one in sampled]),
        },
    )


def _write_table(path: Path, columns: dict[str, Any]) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    try:
        parquet.write_table(pa.table(columns), path)
    except (OSError, pa.ArrowException) as error:
        reason = " ".join(str(error).split())
        raise RunError(f"{path}: the table cannot be written ({reason[:200]})") from None
