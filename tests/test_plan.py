"""A plan says what a run will need, to the byte, and a run takes no more."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from terrasim.errors import InputError
from terrasim.scenario.device_memory import counted_memory
from terrasim.scenario.plan import DEVICE, HOST, frame_steps, make_plan
from terrasim.scenario.run import plan_file, run_file
from terrasim.scenario.scenario import Scenario, parse_scenario
from terrasim.scenario.simulation import Setup, Simulation
from terrasim.scenario.stages import StageTimer

SCENARIOS = sorted((Path(__file__).resolve().parents[1] / "scenarios").glob("*.toml"))
FLAT = {"kind": "flat", "rows": 600, "cols": 600, "spacing": 1.0}
REGION = {"size_x": 50.0, "size_y": 50.0}
BALLS = [{"count": 700, "region": REGION, "radius": 0.3}]
CRATER = {"kind": "crater", "x": 1.0, "y": 2.0, "radius": 3.0, "depth": 1.0}
SHOCK = {
    "kind": "shock", "size_x": 50.0, "size_y": 50.0, "speed_m_s": 9.0, "duration_s": 0.1,
    "end": "freeze", "displacement": {"kind": "cone", "x": 0, "y": 0, "radius": 5, "height": 1},
}  # fmt: skip
EVERYTHING = {
    "detail": {"factor": 4},
    "relaxation": {"angle_deg": 35.0},
    "store": {},
    "stamps": [CRATER],
    "dynamics": [SHOCK],
    "balls": [BALLS[0] | {"spin": [0.0, 0.0, 1.0]}],
    "collision": {"sleep": True},
    "pairs": {},
    "samples": [{"count": 3, "region": REGION}],
    "agents": [{"path": [[0, 0]], "radius": 9.0}],
    "run": {"duration_s": 0.1},
    "output": {"picture": True, "usd": True, "parquet": True},
}


def scenario_of(**more: Any) -> Scenario:
    """A scenario on flat ground."""
    return parse_scenario({"terrain": FLAT, **more})


def test_what_the_scenario_does_not_ask_for_is_left_out() -> None:
    scenario = scenario_of()
    plan = make_plan(scenario, scenario.terrain.source(Path()))
    left = {part.name for part in plan.left_out}
    assert left == {
        "detail", "relaxation", "store", "stamps", "dynamics", "balls", "balls on moving ground",
        "springs", "spin", "sleep", "balls against balls", "check at half the step", "agents",
        "samples", "picture", "usd", "parquet",
    }  # fmt: skip
    assert set(plan.modules) == {"numpy", "warp"}
    assert plan.kernels == ()
    assert {buffer.part for buffer in plan.buffers} == {"terrain"}


def test_what_it_asks_for_is_in() -> None:
    scenario = scenario_of(**EVERYTHING)
    plan = make_plan(scenario, scenario.terrain.source(Path()))
    # Balls spin, or they are on springs.
    assert [part.name for part in plan.left_out] == ["springs"]
    assert {"pxr", "matplotlib", "pyarrow"} <= set(plan.modules)
    assert {"terrasim.kernels.balls_spin", "terrasim.kernels.stamps"} <= set(plan.kernels)
    assert "terrasim.kernels.balls" not in plan.kernels
    assert any(buffer.part == "balls" for buffer in plan.buffers)


SPRINGS = {"integrator": "implicit", "stiffness": 1e5}


@pytest.mark.parametrize(
    ("more", "kernel", "parts"),
    [
        ({}, "balls", set()),
        ({"detail": {"factor": 4}}, "balls_detail", set()),
        ({"balls": [BALLS[0] | {"mass": 1.0}], "collision": SPRINGS}, "balls_sprung", {"springs"}),
        ({"balls": [BALLS[0] | {"rolling_friction": 0.1}]}, "balls_spin", {"spin"}),
        ({"collision": {"sleep": True}}, "ball_sleep", {"sleep"}),
        ({"pairs": {}}, "ball_pairs", {"balls against balls"}),
    ],
)
def test_balls_have_kernels_and_bytes_of_what_they_are_asked_for(
    more: dict[str, Any], kernel: str, parts: set[str]
) -> None:
    scenario = scenario_of(**({"balls": BALLS} | more))
    plan = make_plan(scenario, scenario.terrain.source(Path()))
    optional = {"springs", "spin", "sleep", "balls against balls"}
    assert optional - {part.name for part in plan.left_out} == parts
    assert f"terrasim.kernels.{kernel}" in plan.kernels
    assert {one.part for one in plan.buffers} & {"springs", "spin"} == parts & {"springs", "spin"}


TRENCH = {
    "kind": "trench", "x": 0.0, "y": 0.0, "points": [[-5.0, 0.0], [5.0, 0.0]],
    "depth": 1.0, "width": 2.0,
}  # fmt: skip


@pytest.mark.parametrize(
    "stamps",
    [[CRATER | {"mode": "dig", "z": 1.0}], [TRENCH], [CRATER | {"detail": True}]],
)
def test_the_kernel_of_all_modes_is_in_for_stamps_that_need_it(stamps: list[Any]) -> None:
    scenario = scenario_of(detail={"factor": 4}, stamps=stamps)
    plan = make_plan(scenario, scenario.terrain.source(Path()))
    assert {"terrasim.kernels.stamps", "terrasim.kernels.stamp_modes"} <= set(plan.kernels)
    scenario = scenario_of(detail={"factor": 4}, stamps=[CRATER])
    plan = make_plan(scenario, scenario.terrain.source(Path()))
    assert "terrasim.kernels.stamp_modes" not in plan.kernels


def test_every_part_says_why() -> None:
    for more in ({}, EVERYTHING):
        scenario = scenario_of(**more)
        plan = make_plan(scenario, scenario.terrain.source(Path()))
        assert all(part.why for part in plan.parts)


@pytest.mark.parametrize("pool_bytes", [1 << 21, 1 << 24, 1 << 30])
@pytest.mark.parametrize("balls", [0, 1, 700])
@pytest.mark.parametrize("asked", [{}, {"mass": 1.0, "spin": [0, 0, 1]}, {"mass": 1.0}])
def test_planned_bytes_are_those_the_allocator_counts(
    pool_bytes: int, balls: int, asked: dict[str, Any]
) -> None:
    """The bar is 1 %; formulas of whole arrays leave nothing to be off by."""
    more: dict[str, Any] = {"pool": {"bytes": pool_bytes}, "run": {"duration_s": 0.05}}
    if balls:
        more["balls"] = [BALLS[0] | {"count": balls} | asked]
        more["collision"] = SPRINGS if asked == {"mass": 1.0} else {}
    scenario = scenario_of(**more)
    source = scenario.terrain.source(Path())
    plan = make_plan(scenario, source)
    setup = Setup(scenario, source, plan.anchor)
    with counted_memory() as memory, Simulation(setup, StageTimer()) as simulation:
        assert memory.held == plan.total_bytes(DEVICE)
        simulation.run()
        assert memory.held == plan.total_bytes(DEVICE)


def test_a_plan_of_a_large_terrain_allocates_nothing() -> None:
    huge = {**FLAT, "rows": 1_000_000, "cols": 1_000_000}
    scenario = parse_scenario({"terrain": huge, "pool": {"bytes": 1 << 30}})
    with counted_memory() as memory:
        plan = make_plan(scenario, scenario.terrain.source(Path()))
        assert memory.peak == 0
    assert plan.total_bytes(DEVICE) > 1 << 30


PROGRAM = """
import json, sys
from pathlib import Path
from terrasim.cache.loader import Loader
from terrasim.cli import command
before = []
start = Loader.__init__
def note(self, *words):
    before.append(set(sys.modules))
    start(self, *words)
Loader.__init__ = note
status = command(["run", sys.argv[1], "--out", sys.argv[2], "--json"])
loaded = sorted({name.split(".")[0] for name in sys.modules})
from warp._src.context import user_modules
compiled = sorted(module.name for module in user_modules.values() if module.execs)
late = [name for name in set(sys.modules) - before[0] if name.startswith(("pxr", "matplotlib"))]
seen = {"status": status, "loaded": loaded, "compiled": compiled, "late": late}
print(json.dumps(seen), file=sys.stderr)
"""
HEAVY = {"pxr", "mujoco", "matplotlib", "torch", "OpenImageIO", "rasterio", "pyarrow", "scipy"}


def after_running(text: str, folder: Path) -> tuple[dict[str, Any], dict[str, Any]]:
    """What a process has imported that ran a scenario, and the run's record."""
    path = folder / "s.toml"
    path.write_text(text)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(path), str(folder / "out")],
        capture_output=True,
        text=True,
        check=True,
    )
    return json.loads(done.stderr.splitlines()[-1]), json.loads(done.stdout)


def test_a_scene_without_export_or_balls_imports_and_allocates_nothing_for_them(
    tmp_path: Path,
) -> None:
    text = """
    samples = [{ count = 100, region = { size_x = 50.0, size_y = 50.0 } }]
    [terrain]
    kind = "sine"
    rows = 300
    cols = 300
    spacing = 1.0
    amplitude = 2.0
    wavelength = 30.0
    """
    seen, record = after_running(text, tmp_path)
    assert seen["status"] == 0
    assert not HEAVY & set(seen["loaded"])
    assert seen["compiled"] == record["plan"]["kernels"] == ["terrasim.kernels.sample"]
    memory = record["memory"]
    assert memory["counted_device_bytes"] == memory["planned_device_bytes"]
    assert {"balls", "usd", "picture"} <= set(record["plan"]["left_out"])


def test_a_scene_imports_and_compiles_what_its_plan_names(tmp_path: Path) -> None:
    """It does so before loader threads start: USD's import can wait for them for ever."""
    text = """
    stamps = [{ kind = "crater", x = 1.0, y = 2.0, radius = 3.0, depth = 1.0 }]
    balls = [{ count = 5, region = { size_x = 9.0, size_y = 9.0 }, radius = 0.3 }]
    [terrain]
    kind = "flat"
    rows = 65
    cols = 65
    spacing = 1.0
    [run]
    duration_s = 0.1
    [output]
    usd = true
    """
    seen, record = after_running(text, tmp_path)
    assert seen["late"] == []
    assert HEAVY & set(seen["loaded"]) == {"pxr"} == HEAVY & set(record["plan"]["modules"])
    assert seen["compiled"] == sorted(record["plan"]["kernels"])


def test_the_anchor_is_the_middle_unless_the_scenario_says_otherwise() -> None:
    terrain = {**FLAT, "row": 1000, "col": -50}
    scenario = parse_scenario({"terrain": terrain})
    assert make_plan(scenario, scenario.terrain.source(Path())).anchor == (1299, 249)
    scenario = parse_scenario({"terrain": terrain, "anchor": {"row": 1001, "col": 3}})
    assert make_plan(scenario, scenario.terrain.source(Path())).anchor == (1001, 3)


@pytest.mark.parametrize(
    ("more", "told"),
    [
        ({"anchor": {"row": 600, "col": 0}}, r"anchor post \(600, 0\) lies off the terrain"),
        ({"pool": {"bytes": 300_000}}, "pool of 300000 bytes is too small"),
        ({"samples": [{"count": 1, "region": REGION, "level": 9}]}, r"samples\[1\]\.level must"),
        ({"agents": [{"path": [[0, 0]], "radius": 1, "level": 9}]}, r"agents\[1\]\.level must"),
    ],
)
def test_what_does_not_fit_the_terrain_is_refused(more: dict[str, Any], told: str) -> None:
    scenario = scenario_of(**more)
    with pytest.raises(InputError, match=told):
        make_plan(scenario, scenario.terrain.source(Path()))


def test_frames_begin_at_the_start_and_finish_at_the_end() -> None:
    run = {"duration_s": 0.11, "dt_s": 0.01}
    scenario = scenario_of(run=run, output={"frames_per_s": 25.0})
    assert list(frame_steps(scenario)) == [0, 4, 8, 11]
    assert list(frame_steps(scenario_of())) == [0]
    slow = scenario_of(run=run, output={"frames_per_s": 1000.0})
    assert list(frame_steps(slow)) == list(range(12))


def test_a_plan_of_a_file_is_the_plan_of_its_run(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text('[terrain]\nkind = "flat"\nrows = 65\ncols = 65\nspacing = 1.0\n')
    planned = plan_file(path).as_json()
    record = run_file(path, out=tmp_path / "out")
    assert json.loads(json.dumps(planned)) == json.loads(json.dumps(record["plan"]))
    assert planned["device_bytes"] > 0
    assert planned["host_bytes"] == plan_file(path).total_bytes(HOST)


@pytest.mark.parametrize("path", SCENARIOS, ids=lambda path: path.stem)
def test_every_shipped_scenario_can_be_planned(path: Path) -> None:
    plan = plan_file(path)
    assert plan.total_bytes(DEVICE) <= 256 << 20


def test_the_device_of_the_command_line_counts(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text('[terrain]\nkind = "flat"\nrows = 65\ncols = 65\nspacing = 1.0\n')
    plan = plan_file(path, device="cuda:0")
    assert plan.device == "cuda:0"
    assert "terrasim.kernels.transfer" in plan.kernels
    assert any(buffer.name == "pinned staging" for buffer in plan.buffers)
