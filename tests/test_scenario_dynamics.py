"""Deformations over time in scenarios: files, plans, runs, records, and what is refused."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrasim.errors import InputError
from terrasim.output.window import read_window
from terrasim.scenario.device_memory import counted_memory
from terrasim.scenario.plan import DEVICE, make_plan
from terrasim.scenario.run import plan_file, run_scenario
from terrasim.scenario.scenario import Scenario, parse_scenario, scenario_schema
from terrasim.scenario.simulation import Setup, Simulation
from terrasim.scenario.stages import StageTimer

FLAT = {"kind": "flat", "rows": 200, "cols": 300, "spacing": 1.0}
HILL = {"kind": "gaussian", "x": 3.0, "y": -2.0, "amplitude": 1.0, "sigma": 5.0}
SHOCK: dict[str, Any] = {
    "kind": "shock", "size_x": 120.0, "size_y": 80.0, "speed_m_s": 20.0, "displacement": HILL,
    "duration_s": 1.0, "end": "freeze",
}  # fmt: skip
GROWTH: dict[str, Any] = {
    "kind": "growth", "stamp": {"kind": "cone", "x": 60.0, "y": 0.0, "radius": 9.0, "height": 2.0},
    "profile": {"kind": "linear"}, "time_s": 0.2, "duration_s": 0.5, "end": "freeze",
}  # fmt: skip
RUN = {"duration_s": 1.0, "dt_s": 0.02}


def scenario_of(*dynamics: dict[str, Any], **more: Any) -> Scenario:
    """A scenario on flat ground."""
    return parse_scenario({"terrain": FLAT, "dynamics": list(dynamics), "run": RUN} | more)


def begun(scenario: Scenario, finer: int = 1) -> Simulation:
    """Its simulation before the first step."""
    source = scenario.terrain.source(Path())
    setup = Setup(scenario, source, make_plan(scenario, source).anchor, finer)
    return Simulation(setup, StageTimer())


def heights(simulation: Simulation) -> Any:
    """All posts, int64."""
    terrain = simulation.terrain
    return read_window(terrain, 0, terrain.grid.posts(0)).astype(np.int64)


def test_the_ground_follows_from_the_first_step_to_the_last() -> None:
    """The shock's shape is there at once, the growth begins later; both stay as they end."""
    with begun(scenario_of(SHOCK, GROWTH)) as simulation:
        first = heights(simulation)
        # The anchor is a post, and so is the hill's top.
        assert first.max() == 100_000
        assert not first[:, 200:].any()
        simulation.run()
        last = heights(simulation)
        assert last[90:110, 200:220].max() == pytest.approx(2e5, rel=0.08)
        assert simulation.ground.ledger.net == last.sum()
        wave, growth = simulation.dynamics.summary()
        assert wave["ledger"]["net"] + growth["ledger"]["net"] == last.sum()
        assert (wave["steps"], growth["steps"]) == (50, 25)
        assert growth["factor"] == 1.0


def test_what_vanishes_is_gone_at_the_end() -> None:
    dynamics = (SHOCK | {"end": "vanish"}, GROWTH | {"end": "vanish"})
    with begun(scenario_of(*dynamics)) as simulation:
        assert heights(simulation).any()
        simulation.run()
        assert not heights(simulation).any()
        assert simulation.ground.ledger.net == 0
        assert simulation.ground.ledger.posts > 0


def test_half_the_step_ends_at_the_same_time() -> None:
    with begun(scenario_of(SHOCK, GROWTH), finer=2) as simulation:
        simulation.run()
        wave, growth = simulation.dynamics.summary()
        assert (wave["time_s"], growth["time_s"]) == (1.0, 0.5)
        assert (wave["steps"], growth["steps"]) == (100, 50)
        assert wave["courant"] == pytest.approx(20.0 * 0.01)


def test_planned_bytes_are_those_the_allocator_counts() -> None:
    """Also while the dynamics run and when they have ended."""
    scenario = scenario_of(
        SHOCK, GROWTH, SHOCK | {"size_x": 33.0, "time_s": 0.5, "duration_s": 0.3}
    )
    source = scenario.terrain.source(Path())
    plan = make_plan(scenario, source)
    names = {buffer.name: buffer.bytes for buffer in plan.buffers if buffer.part == "dynamics"}
    assert names["dynamics[1]: wave of 81 x 121 posts"] == 81 * (121 * 16 + 2 * 8)
    assert names["dynamics[1]: counts that the ground has"] == 81 * 121 * 4
    setup = Setup(scenario, source, plan.anchor)
    with counted_memory() as memory, Simulation(setup, StageTimer()) as simulation:
        assert memory.held == plan.total_bytes(DEVICE)
        simulation.run()
        assert memory.held == plan.total_bytes(DEVICE)


def test_the_record_says_what_became_of_them(tmp_path: Path) -> None:
    scenario = scenario_of(SHOCK | {"damping_1_s": 0.3}, GROWTH)
    record = run_scenario(scenario, tmp_path, tmp_path / "out")
    wave, growth = json.loads((tmp_path / "out" / "run.json").read_text())["dynamics"]
    assert (wave["kind"], wave["end"], wave["steps"]) == ("shock", "freeze", 50)
    assert wave["courant"] == pytest.approx(0.4)
    # Not quite the square of the amplitude's: the mean displacement has no energy and stays.
    assert wave["energy_end_m4_s2"] / wave["energy_start_m4_s2"] == pytest.approx(
        np.exp(-2.0 * 0.3), rel=0.1
    )
    assert wave["ledger"]["net"] + growth["ledger"]["net"] == record["ledger"]["net"]
    assert record["memory"]["counted_device_bytes"] == record["memory"]["planned_device_bytes"]
    errors = {one["name"]: one for one in record["errors"]}
    assert 0.0 < errors["posts and steps, dynamics[1]"]["metres"] < 0.1
    assert "2 of them meet" in errors["rounding to counts"]["note"]
    report = (tmp_path / "out" / "report.html").read_text()
    assert "What changed over time" in report
    assert "1, shock" in report


def test_the_error_said_of_a_wave_is_its_size() -> None:
    """Against the same wave on posts four times as close; within a factor of two at the front."""
    found = []
    for finer in (1, 4):
        ground = FLAT | {
            "rows": 160 * finer, "cols": 160 * finer, "spacing": 1.0 / finer,
        }  # fmt: skip
        shock = SHOCK | {"size_x": 1e3, "size_y": 1e3, "duration_s": 2.0}
        shock["displacement"] = HILL | {"x": 0.5 / finer, "y": 0.5 / finer, "sigma": 4.0}
        run = {"duration_s": 2.0, "dt_s": 0.02 / finer}
        with begun(scenario_of(shock, terrain=ground, run=run)) as simulation:
            simulation.run()
            [said] = simulation.dynamics.summary()
            found.append((said["error_m"], heights(simulation) * 1e-5))
    (said_m, coarse), (_, fine) = found
    # A coarse post stands amid four by four fine ones.
    fine = fine.reshape(160, 4, 160, 4)[:, 1:3, :, 1:3].mean(axis=(1, 3))
    apart = np.abs(coarse - fine).max()
    assert 0.5 * apart < said_m < 2.0 * apart


def test_a_run_with_a_stage_shows_the_ground_moving(tmp_path: Path) -> None:
    """One state of its tiles a frame."""
    from pxr import Usd, UsdGeom

    output = {"usd": True, "picture": True, "frames_per_s": 10.0}
    scenario = scenario_of(SHOCK, GROWTH, output=output)
    record = run_scenario(scenario, tmp_path, tmp_path / "out")
    assert {"picture.png", "scene.usdc"} <= set(record["files"])
    stage = Usd.Stage.Open(str(tmp_path / "out" / "scene.usdc"))
    samples = [
        UsdGeom.Mesh(prim).GetPointsAttr().GetNumTimeSamples()
        for prim in stage.Traverse()
        if prim.IsA(UsdGeom.Mesh)
    ]
    assert max(samples) >= 10


def test_the_journal_holds_what_they_did(tmp_path: Path) -> None:
    """A store closed and opened amid them has the same ground to the bit, and they go on."""
    text = {"store": {"reopen_s": [0.5]}}
    kept = run_scenario(scenario_of(SHOCK, GROWTH, **text), tmp_path, tmp_path / "kept")
    plain = run_scenario(scenario_of(SHOCK, GROWTH), tmp_path, tmp_path / "plain")
    assert kept["hashes"]["heights"] == plain["hashes"]["heights"]
    assert [one["same_heights"] for one in kept["store"]["reopened"]] == [True]
    assert kept["store"]["operations"] > 50


def test_images_grow_too_and_balls_are_checked_over_them(tmp_path: Path) -> None:
    """The check at half the step needs the image again."""
    np.save(tmp_path / "heights.npy", np.random.default_rng(0).random((9, 9)))
    texture = {
        "kind": "texture", "x": 0.0, "y": 0.0, "size_x": 20.0, "size_y": 20.0,
        "image": {"path": "heights.npy"},
    }  # fmt: skip
    balls = [{"count": 5, "region": {"size_x": 9.0, "size_y": 9.0}, "radius": 0.3}]
    scenario = scenario_of(GROWTH | {"stamp": texture}, balls=balls)
    record = run_scenario(scenario, tmp_path, tmp_path / "out")
    assert record["dynamics"][0]["ledger"]["added"] > 0
    assert any(one["name"] == "time step" and one["metres"] is not None for one in record["errors"])


PROGRAM = """
import json, sys
from terrasim.cli import command
status = command(["run", sys.argv[1], "--out", sys.argv[2], "--json"])
loaded = sorted(name for name in sys.modules if name.startswith("terrasim."))
from warp._src.context import user_modules
compiled = sorted(module.name for module in user_modules.values() if module.execs)
print(json.dumps({"status": status, "loaded": loaded, "compiled": compiled}), file=sys.stderr)
"""
TEXT = """
samples = [{ count = 3, region = { size_x = 9.0, size_y = 9.0 } }]
[terrain]
kind = "flat"
rows = 65
cols = 65
spacing = 1.0
[run]
duration_s = 0.1
"""
DYNAMIC = """
[[dynamics]]
kind = "growth"
stamp = { kind = "cone", x = 1.0, y = 2.0, radius = 5.0, height = 1.0 }
profile = { kind = "exponential", time_constant = 0.5 }
duration_s = 0.1
end = "vanish"
"""


@pytest.mark.parametrize("text", [TEXT, TEXT + DYNAMIC], ids=["without", "with"])
def test_a_scene_pays_for_dynamics_only_if_it_has_some(text: str, tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text(text)
    done = subprocess.run(
        [sys.executable, "-c", PROGRAM, str(path), str(tmp_path / "out")],
        capture_output=True,
        text=True,
        check=True,
    )
    seen, record = json.loads(done.stderr.splitlines()[-1]), json.loads(done.stdout)
    assert seen["status"] == 0
    own = {"dynamics", "given", "growth", "shock", "stamp_rises", "waves"}
    loaded = {name for name in own if f"terrasim.deform.{name}" in seen["loaded"]}
    assert loaded == (own if text != TEXT else set())
    assert ("terrasim.kernels.waves" in seen["loaded"]) == (text != TEXT)
    assert seen["compiled"] == sorted(record["plan"]["kernels"])
    assert ("dynamics" in record["plan"]["left_out"]) == (text == TEXT)


@pytest.mark.parametrize(
    ("table", "told"),
    [
        (SHOCK | {"speed_m_s": 0.0}, r"dynamics\[1\]\.speed_m_s must be greater than 0, got 0"),
        (SHOCK | {"speed_m_s": float("nan")}, r"dynamics\[1\]\.speed_m_s must be a finite number"),
        (SHOCK | {"damping_1_s": -0.5}, r"\.damping_1_s must be greater than or equal to 0, got -"),
        (SHOCK | {"size_x": 0.0}, r"dynamics\[1\]\.size_x must be greater than 0, got 0"),
        (SHOCK | {"duration_s": 0.0}, r"dynamics\[1\]\.duration_s must be greater than 0, got 0"),
        (SHOCK | {"substeps": 0}, r"\.substeps must be greater than or equal to 1, got 0"),
        (SHOCK | {"end": "melt"}, r"dynamics\[1\]\.end must be 'freeze' or 'vanish', got 'melt'"),
        (SHOCK | {"kind": "quake"}, r"\.kind must be one of growth, shock, got 'quake'"),
        (SHOCK | {"displacement": None}, "displacement must be given where there is no velocity"),
        (SHOCK | {"displacement": HILL | {"sigma": -1.0}}, "gaussian: sigma must lie between"),
        (SHOCK | {"displacement": HILL | {"mode": "dig"}}, r"displacement\.mode is unknown"),
        (SHOCK | {"displacement": HILL | {"time_s": 1.0}}, r"displacement\.time_s is unknown"),
        (SHOCK | {"velocity": {"kind": "flatten"}}, r"velocity\.kind must be one of berm, cone"),
        (SHOCK | {"time_s": 0.5}, r"dynamics\[1\] must end within the run of 1 s .*, got 1\.5"),
        (SHOCK | {"detail": True}, r"dynamics\[1\]\.detail is true but the terrain has no detail"),
        (GROWTH | {"profile": {"kind": "cubic"}}, r"profile\.kind must be one of exponential"),
        (
            GROWTH | {"profile": {"kind": "table", "times": [0.0, 0.5], "factors": [0.0, 1.0]}},
            "table: times must run from 0 to 1, got 0.0 to 0.5",
        ),
        (GROWTH | {"profile": {"kind": "linear", "start": float("inf")}}, "start must be a finite"),
        ({name: GROWTH[name] for name in GROWTH if name != "end"}, r"\.end is missing: add it"),
    ],
)  # fmt: skip
def test_a_file_that_says_no_dynamic_is_refused(table: dict[str, Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        scenario_of(table)


@pytest.mark.parametrize(
    ("table", "told"),
    [
        (
            SHOCK | {"speed_m_s": 50.0},
            r"dynamics\[1\]: shock: a step of 0\.02 s is over .* 0\.0141421 s .* 2 substeps",
        ),
        (SHOCK | {"x": 1e4}, r"dynamics\[1\]: its rectangle must hold a post of the terrain, got"),
        (
            GROWTH | {"stamp": GROWTH["stamp"] | {"y": -9e3}},
            r"dynamics\[1\]: its rectangle must hold a post of the terrain, got",
        ),
    ],
)
def test_what_does_not_fit_is_refused_by_the_plan(table: dict[str, Any], told: str) -> None:
    """Before a byte of it is allocated."""
    scenario = scenario_of(table)
    with pytest.raises(InputError, match=told):
        make_plan(scenario, scenario.terrain.source(Path()))


def test_the_step_over_the_limit_can_be_taken_in_substeps() -> None:
    with begun(scenario_of(SHOCK | {"speed_m_s": 50.0, "substeps": 2})) as simulation:
        simulation.run()
        [said] = simulation.dynamics.summary()
        assert said["steps"] == 100
        assert said["courant"] == pytest.approx(0.5)


def test_dynamics_stand_in_the_schema() -> None:
    found = scenario_schema()["$defs"]
    assert found["ShockSettings"]["properties"]["damping_1_s"]["description"]
    assert set(found["TableProfile"]["properties"]) == {"kind", "times", "factors"}
    assert "mode" not in found["GaussianShape"]["properties"]


def test_the_shipped_scene_is_a_wave_on_its_way() -> None:
    plan = plan_file(Path(__file__).resolve().parents[1] / "scenarios" / "shock.toml")
    assert any(part.name == "dynamics" and part.used for part in plan.parts)
    assert "terrasim.kernels.waves" in plan.kernels
