"""What deformations that change over time need; only a scene that has some reads this."""

from __future__ import annotations

from terrasim.deform.growth import Growth
from terrasim.deform.shock import Shock
from terrasim.deform.target import Target, target_on
from terrasim.deform.waves import wave_bytes
from terrasim.detail.grid import DetailGrid
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.scenario.images import BLANK
from terrasim.scenario.plan import DEVICE, HOST, Buffer, anchor_of
from terrasim.scenario.scenario import Scenario

PART = "dynamics"


def dynamic_kernels(scenario: Scenario) -> tuple[str, ...]:
    """Warp modules that they compile."""
    kinds = {one.kind for one in scenario.dynamics}
    fine = {one.detail for one in scenario.dynamics}
    found = ["stamp_rises"]
    found += ["waves"] if Shock.name in kinds else []
    found += ["patch"] if False in fine else []
    found += ["patch_detail"] if True in fine else []
    return tuple(f"terrasim.kernels.{name}" for name in found)


def dynamic_buffers(scenario: Scenario, grid: Grid) -> list[Buffer]:
    """Their fields and what they gave to the ground.

    Raises:
        InputError: If one touches no post of the terrain, or its steps would be unstable.
    """
    buffers = []
    for index, one in enumerate(scenario.dynamics, 1):
        what, target = one.deformation(BLANK), target_for(scenario, grid, detail=one.detail)
        name = f"{PART}[{index}]"
        rows, cols = _size(what, target, scenario, grid, name)
        posts = rows * cols
        if isinstance(what, Shock):
            try:
                what.check_step(scenario.run.dt_s, target.spacing)
            except InputError as error:
                raise InputError(f"{name}: {error}") from None
            size = wave_bytes(rows, cols, cuda=scenario.run.device != "cpu")
            buffers.append(Buffer(f"{name}: wave of {rows} x {cols} posts", PART, DEVICE, size))
        else:
            size = 8 * posts
            buffers.append(Buffer(f"{name}: rise of {rows} x {cols} posts", PART, HOST, size))
        buffers.append(Buffer(f"{name}: counts that the ground has", PART, HOST, 4 * posts))
    return buffers


def target_for(scenario: Scenario, grid: Grid, *, detail: bool) -> Target:
    """The posts that something changes, before there is a terrain."""
    factor = scenario.detail.factor if scenario.detail is not None else 1
    return target_on(grid, DetailGrid(grid, factor), detail=detail)


def _size(
    what: Shock | Growth, target: Target, scenario: Scenario, grid: Grid, name: str
) -> tuple[int, int]:
    """Rows and columns of its posts."""
    span = what.span(target, anchor_of(scenario, grid))
    rows, cols = span.row1 - span.row0, span.col1 - span.col0
    if min(rows, cols) < 1:
        raise InputError(
            f"{name}: its rectangle must hold a post of the terrain, got {rows} x {cols} posts; "
            "move it or make it larger"
        )
    return rows, cols
