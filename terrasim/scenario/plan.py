"""What a scenario needs before anything of it is made: parts, imports, kernels, buffers.

What is not in the plan is not imported, not compiled and not allocated. Bytes come from formulas
of the scenario alone.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from terrasim.cache.detail_table import section_entries
from terrasim.cache.pool import (
    BLOCK_BYTES,
    BLOCK_POSTS,
    STAGING_SLOTS,
    detail_layers_for,
    layers_for,
)
from terrasim.cache.table import table_entries
from terrasim.detail.grid import DetailGrid
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.kernels.shapes import CRATER
from terrasim.scenario.actors import AgentPath, SampleGroup
from terrasim.scenario.ground import STORE
from terrasim.scenario.images import BLANK
from terrasim.scenario.scenario import Scenario
from terrasim.scenario.terrain import DemGround, Ground, SampleGround, StoreGround
from terrasim.sources.source import Source

DEVICE, HOST = "device", "host"


@dataclass(frozen=True)
class Part:
    """Something a run can do."""

    name: str
    """What it is."""
    used: bool
    """Whether this run does it."""
    why: str
    """What in the scenario decides that."""
    modules: tuple[str, ...] = ()
    """Libraries it imports."""
    kernels: tuple[str, ...] = ()
    """Warp modules it compiles."""


@dataclass(frozen=True)
class Buffer:
    """Memory that is held through the run."""

    name: str
    """What is in it."""
    part: str
    """The part that needs it."""
    place: str
    """``device``, as Warp's allocator counts it, or ``host``."""
    bytes: int
    """Its size."""


@dataclass(frozen=True)
class Plan:
    """All that a scenario needs."""

    scenario: str
    """The scenario's name."""
    device: str
    """The device it runs on."""
    grid: Grid
    """Placement of the posts."""
    synthetic: str
    """What part of the heights is invented; empty if none is."""
    anchor: tuple[int, int]
    """Row and column of the post that places are measured from."""
    steps: int
    """Time steps."""
    parts: tuple[Part, ...]
    """What it does, and what it leaves out."""
    buffers: tuple[Buffer, ...]
    """What it allocates."""

    @property
    def modules(self) -> tuple[str, ...]:
        """Libraries that are imported, each once."""
        used = (name for part in self.parts if part.used for name in part.modules)
        return tuple(dict.fromkeys(used))

    @property
    def kernels(self) -> tuple[str, ...]:
        """Warp modules that are compiled, each once."""
        used = (name for part in self.parts if part.used for name in part.kernels)
        return tuple(dict.fromkeys(used))

    @property
    def left_out(self) -> tuple[Part, ...]:
        """Parts that are not used."""
        return tuple(part for part in self.parts if not part.used)

    def total_bytes(self, place: str) -> int:
        """Bytes of all buffers in a place."""
        return sum(buffer.bytes for buffer in self.buffers if buffer.place == place)

    def as_json(self) -> dict[str, Any]:
        """The plan, ready for JSON."""
        return {
            **asdict(self),
            "left_out": [part.name for part in self.left_out],
            "modules": list(self.modules),
            "kernels": list(self.kernels),
            "device_bytes": self.total_bytes(DEVICE),
            "host_bytes": self.total_bytes(HOST),
        }


def make_plan(scenario: Scenario, source: Source) -> Plan:
    """Turn a scenario into a plan.

    Args:
        scenario: The scenario.
        source: Its terrain's source; only its grid is looked at.

    Raises:
        InputError: If the pool is too small or too large, the anchor lies off the terrain, or
            something asks for a level there is not.
    """
    grid = source.grid
    parts = (
        terrain_part(scenario),
        *ground_parts(scenario),
        *actor_parts(scenario),
        *output_parts(scenario),
    )
    _check_levels(scenario, grid)
    used = {part.name for part in parts if part.used}
    buffers = [
        *pool_buffers(scenario, grid),
        *_dynamic_buffers(scenario, grid),
        *ball_buffers(scenario),
    ]
    return Plan(
        scenario.name,
        scenario.run.device,
        grid,
        source.synthetic,
        anchor_of(scenario, grid),
        scenario.steps,
        parts,
        tuple(buffer for buffer in buffers if buffer.part in used),
    )


def anchor_of(scenario: Scenario, grid: Grid) -> tuple[int, int]:
    """Row and column of the anchor post.

    Raises:
        InputError: If it lies off the terrain.
    """
    if scenario.anchor is None:
        return grid.row + (grid.rows - 1) // 2, grid.col + (grid.cols - 1) // 2
    row, col = scenario.anchor.row, scenario.anchor.col
    if not (grid.row <= row < grid.row + grid.rows and grid.col <= col < grid.col + grid.cols):
        raise InputError(
            f"anchor post ({row}, {col}) lies off the terrain: its rows are {grid.row} to "
            f"{grid.row + grid.rows - 1}, its columns {grid.col} to {grid.col + grid.cols - 1}"
        )
    return row, col


def _check_levels(scenario: Scenario, grid: Grid) -> None:
    actors: list[tuple[str, Sequence[SampleGroup | AgentPath]]]
    actors = [("samples", scenario.samples), ("agents", scenario.agents)]
    for name, group in actors:
        for index, one in enumerate(group, 1):
            if one.level > grid.top:
                raise InputError(
                    f"{name}[{index}].level must be 0 to {grid.top} on this terrain, "
                    f"got {one.level}"
                )


def terrain_part(scenario: Scenario) -> Part:
    """The terrain and its cache."""
    ground: Ground = scenario.terrain
    modules = ["numpy", "warp"]
    if isinstance(ground, StoreGround):
        modules += ["apsw", "zstandard"]
    if isinstance(ground, DemGround | SampleGround):
        modules += ["rasterio"]
    if isinstance(ground, DemGround) and any(_image(name) for name in ground.files):
        modules += ["OpenImageIO"]
    if isinstance(ground, SampleGround):
        modules += ["matplotlib"]
    on_cuda = scenario.run.device != "cpu"
    kernels = ("terrasim.kernels.transfer",) if on_cuda else ()
    return Part("terrain", True, f"terrain.kind = {ground.kind!r}", tuple(modules), kernels)


def ground_parts(scenario: Scenario) -> list[Part]:
    """How the ground changes and lasts."""
    detail, relaxation = scenario.detail, scenario.relaxation
    return [
        Part(
            "detail",
            detail is not None,
            f"detail.factor = {detail.factor}" if detail else "no table [detail]",
        ),
        Part(
            "relaxation",
            relaxation is not None,
            f"relaxation.angle_deg = {relaxation.angle_deg:g}"
            if relaxation
            else "no table [relaxation]",
            kernels=("terrasim.kernels.relaxation",),
        ),
        Part(
            "store",
            scenario.store is not None,
            f"kept in {STORE}" if scenario.store else "no table [store]",
            modules=("apsw", "zstandard"),
        ),
    ]


def actor_parts(scenario: Scenario) -> list[Part]:
    """What happens on the ground."""
    stamps = len(scenario.stamps) + sum(group.count for group in scenario.scatter)
    balls = sum(group.count for group in scenario.balls)
    checked = checked_balls(scenario)
    files = [file for one in (*scenario.stamps, *scenario.scatter) for file in one.files()]
    samples = sum(group.count for group in scenario.samples)
    rerun = checked > 0 and scenario.steps > 0
    from terrasim.scenario.ball_parts import ball_parts

    return [
        Part(
            "stamps",
            stamps > 0,
            _number(stamps, "stamp"),
            modules=("OpenImageIO",) if any(_image(one.path) for one in files) else (),
            kernels=_stamp_kernels(scenario),
        ),
        _dynamics_part(scenario),
        *ball_parts(scenario),
        Part(
            "check at half the step",
            rerun,
            f"{checked} of {balls} balls" if rerun else "no moving balls to check",
        ),
        Part("agents", bool(scenario.agents), _number(len(scenario.agents), "agent")),
        Part(
            "samples", samples > 0, _number(samples, "place"), kernels=("terrasim.kernels.sample",)
        ),
    ]


def output_parts(scenario: Scenario) -> list[Part]:
    """What the run leaves behind."""
    output = scenario.output
    return [
        Part("record and report", True, "always"),
        _output("picture", output.picture, ("matplotlib",)),
        _output("usd", output.usd, ("pxr",)),
        _output("parquet", output.parquet, ("pyarrow",)),
    ]


def pool_buffers(scenario: Scenario, grid: Grid) -> list[Buffer]:
    """The pool and its pointer tables."""
    layers = layers_for(grid, scenario.pool.bytes)
    fine = _detail_layers(scenario, grid, layers)
    entries = table_entries(grid, layers) + section_entries(layers, fine)
    found = [
        Buffer(f"pool, {layers} blocks", "terrain", DEVICE, layers * BLOCK_BYTES),
        Buffer("error bound of each block", "terrain", DEVICE, 4 * layers),
        Buffer("blocks that queries read", "terrain", DEVICE, layers),
        Buffer("pointer table: resident", "terrain", DEVICE, 4 * entries),
        Buffer("pointer table: required", "terrain", DEVICE, 4 * entries),
    ]
    if fine:
        found.append(Buffer(f"detail, {fine} blocks", "detail", DEVICE, fine * BLOCK_BYTES))
    if scenario.run.device != "cpu":
        pinned = STAGING_SLOTS * 4 * (BLOCK_POSTS + 1)
        found.append(Buffer("pinned staging", "terrain", HOST, pinned))
    return found


def _detail_layers(scenario: Scenario, grid: Grid, layers: int) -> int:
    if scenario.detail is None:
        return 0
    detail = DetailGrid(grid, scenario.detail.factor)
    return detail_layers_for(detail, scenario.detail.bytes, layers)


def _stamp_kernels(scenario: Scenario) -> tuple[str, ...]:
    """What is only added to level 0, in a part of x and a part of y, needs but one of them."""
    shapes = (one.shape(BLANK) for one in (*scenario.stamps, *scenario.scatter))
    plain = all(one.mode == "add" and one.kind <= CRATER and not one.detail for one in shapes)
    found = ("terrasim.kernels.stamps",)
    return found if plain else (*found, "terrasim.kernels.stamp_modes")


def _dynamics_part(scenario: Scenario) -> Part:
    if not scenario.dynamics:
        return Part("dynamics", False, _number(0, "dynamic"))
    from terrasim.scenario.dynamic_parts import dynamic_kernels

    files = [file for one in scenario.dynamics for file in one.files()]
    return Part(
        "dynamics",
        True,
        _number(len(scenario.dynamics), "dynamic"),
        modules=("OpenImageIO",) if any(_image(one.path) for one in files) else (),
        kernels=dynamic_kernels(scenario),
    )


def _dynamic_buffers(scenario: Scenario, grid: Grid) -> list[Buffer]:
    if not scenario.dynamics:
        return []
    from terrasim.scenario.dynamic_parts import dynamic_buffers

    return dynamic_buffers(scenario, grid)


def ball_buffers(scenario: Scenario) -> list[Buffer]:
    """State of the balls, and what is recorded of them."""
    if not scenario.balls:
        return []
    from terrasim.scenario.ball_parts import state_buffers

    recorded = 24 * sum(group.count for group in scenario.balls) * len(frame_steps(scenario))
    return [
        *state_buffers(scenario),
        Buffer("recorded places of balls", "balls", HOST, recorded),
    ]


def checked_balls(scenario: Scenario) -> int:
    """Balls that are run again at half the step."""
    return min(scenario.run.checked_balls, sum(group.count for group in scenario.balls))


def frame_steps(scenario: Scenario) -> Sequence[int]:
    """Steps before which balls are recorded; the last is the end."""
    if scenario.steps == 0:
        return [0]
    every = max(1, round(1.0 / (scenario.output.frames_per_s * scenario.run.dt_s)))
    steps = list(range(0, scenario.steps, every))
    return [*steps, scenario.steps]


def _number(count: int, what: str) -> str:
    return f"{count} {what}{'' if count == 1 else 's'}" if count else f"no {what}s in the scenario"


def _output(name: str, wanted: bool, modules: tuple[str, ...]) -> Part:
    return Part(name, wanted, f"output.{name} = {str(wanted).lower()}", modules)


def _image(name: str) -> bool:
    return name.lower().endswith((".png", ".exr", ".tif", ".tiff"))
