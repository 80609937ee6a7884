"""Runs: repeatable to the bit, honest about their errors, whole folders or none."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrasim.grid import Block
from terrasim.scenario.run import run_scenario
from terrasim.scenario.scenario import Scenario, parse_scenario
from terrasim.scenario.schedule import timed_stamps
from terrasim.scenario.terrain import Ground
from terrasim.sources.source import BlockData, Source

TERRAIN = {
    "kind": "sine",
    "rows": 1200,
    "cols": 1000,
    "spacing": 0.5,
    "amplitude": 4.0,
    "wavelength": 64.0,
    "wavelength_y": 64.0,
}
REGION = {"size_x": 200.0, "size_y": 200.0}
CRATER = {"kind": "crater", "radius": 1.0, "depth": 0.2, "rim_height": 0.04}
SCENE: dict[str, Any] = {
    "terrain": TERRAIN,
    "scatter": [
        CRATER | {"count": 12, "region": REGION, "size": [2.0, 9.0]},
        CRATER | {"count": 6, "region": REGION, "size": [2.0, 9.0], "time_s": [0.1, 0.9]},
    ],
    "balls": [{"count": 2500, "region": REGION, "radius": [0.2, 0.5], "height": 1.0}],
    "run": {"duration_s": 1.0, "dt_s": 0.02, "checked_balls": 0},
}


def scene(**more: Any) -> Scenario:
    """Balls through craters, old and new."""
    return parse_scenario(SCENE | more)


def run(scenario: Scenario, out: Path) -> dict[str, Any]:
    """Run a scenario into a folder."""
    return run_scenario(scenario, out.parent, out)


@pytest.fixture(scope="module")
def hashes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """What the scene comes to."""
    record = run(scene(), tmp_path_factory.mktemp("scene") / "out")
    found: dict[str, str] = record["hashes"]
    return found


def test_a_run_repeats_to_the_bit(tmp_path: Path, hashes: dict[str, str]) -> None:
    assert run(scene(), tmp_path / "out")["hashes"] == hashes


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_change_nothing(tmp_path: Path, hashes: dict[str, str], threads: int) -> None:
    scenario = scene(run=SCENE["run"] | {"threads": threads})
    assert run(scenario, tmp_path / "out")["hashes"] == hashes


@pytest.mark.parametrize("blocks", [24, 800])
def test_the_pool_s_size_changes_nothing_where_the_need_fits(
    tmp_path: Path, hashes: dict[str, str], blocks: int
) -> None:
    record = run(scene(pool={"bytes": blocks << 18}), tmp_path / "out")
    assert record["hashes"] == hashes
    assert record["counters"]["coarsened"] == 0


class Delayed:
    """A source on a slow disk."""

    def __init__(self, source: Source) -> None:
        """Wrap a source."""
        self._source = source
        self.grid = source.grid
        self.synthetic = source.synthetic
        self.posts = source.posts

    def block(self, key: Block) -> BlockData:
        """Read late."""
        time.sleep(0.01)
        return self._source.block(key)


def test_a_slow_disk_changes_nothing(
    tmp_path: Path, hashes: dict[str, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = Ground.source
    monkeypatch.setattr(Ground, "source", lambda self, folder: Delayed(whole(self, folder)))
    record = run(scene(pool={"bytes": 24 << 18}), tmp_path / "out")
    assert record["hashes"] == hashes
    assert record["counters"]["loads"] > 0


@pytest.mark.parametrize("output", ["picture", "usd", "parquet"])
def test_looking_changes_nothing(tmp_path: Path, hashes: dict[str, str], output: str) -> None:
    scenario = scene(output={output: True}, pool={"bytes": 24 << 18})
    assert run(scenario, tmp_path / "out")["hashes"] == hashes


def test_another_seed_is_another_run(tmp_path: Path, hashes: dict[str, str]) -> None:
    record = run(scene(run=SCENE["run"] | {"seed": 1}), tmp_path / "out")
    assert record["hashes"]["heights"] != hashes["heights"]
    assert record["hashes"]["balls"] != hashes["balls"]


def test_a_scene_far_away_moves_as_one_at_the_origin(tmp_path: Path) -> None:
    """A whole number of blocks away and anchored likewise, places repeat to the bit."""
    from pyarrow import parquet

    tables = []
    for far in (0, 20_000_000):
        assert far % 256 == 0
        terrain = TERRAIN | {"row": far, "col": -far}
        anchor = {"row": far + 600, "col": -far + 500}
        scenario = scene(terrain=terrain, anchor=anchor, output={"parquet": True})
        run(scenario, tmp_path / str(far))
        tables.append(parquet.read_table(tmp_path / str(far) / "balls.parquet"))
    assert len(tables[0]) > 0
    assert tables[0].equals(tables[1])


def test_the_record_holds_what_the_run_was_and_came_to(tmp_path: Path) -> None:
    record = run(scene(run=SCENE["run"] | {"checked_balls": 16}), tmp_path / "out")
    text = (tmp_path / "out" / "run.json").read_text()
    assert json.loads(text) == json.loads(json.dumps(record))
    for key in (
        "settings", "plan", "versions", "device", "seed", "counters", "timings", "errors",
        "ledger", "hashes", "synthetic", "machine",
    ):  # fmt: skip
        assert record[key] not in (None, "", [], {}), key
    assert record["balls"]["count"] == 2500
    assert record["simulated_s"] == 1.0
    volume = sum(stamp.volume for _, stamp in timed_stamps(scene()))
    # Posts half a metre apart take a crater's volume to some percent.
    assert record["ledger"]["net_m3"] == pytest.approx(volume, rel=0.03)
    stages = record["timings"]["stages"]
    assert sum(stage["wall_s"] for stage in stages) <= record["timings"]["wall_s"]


def test_each_error_is_in_metres_with_its_cost(tmp_path: Path) -> None:
    record = run(scene(run=SCENE["run"] | {"checked_balls": 16}), tmp_path / "out")
    errors = {one["name"]: one for one in record["errors"]}
    assert set(errors) == {
        "levels, contact", "levels, queries", "levels, stage", "time step", "rounding to counts",
    }  # fmt: skip
    assert errors["levels, contact"]["metres"] == 0.0
    assert errors["time step"]["metres"] >= errors["time step"]["typical_m"] > 0.0
    assert errors["time step"]["cost_s"] > 0.0
    assert errors["levels, stage"]["metres"] is None
    assert 0.5e-5 < errors["rounding to counts"]["metres"] < 19 * 0.5e-5


def test_half_the_step_of_a_fall_is_the_same_fall(tmp_path: Path) -> None:
    """Flight is exact, so balls that never land are not wrong at all but for rounding."""
    balls = [{"count": 5, "region": REGION, "radius": 0.2, "height": 50.0}]
    scenario = scene(balls=balls, scatter=[], run={"duration_s": 1.0, "dt_s": 0.02})
    record = run(scenario, tmp_path / "out")
    found = next(one for one in record["errors"] if one["name"] == "time step")
    assert found["metres"] < 1e-9


def test_a_pool_too_small_for_the_need_is_told_with_the_error(tmp_path: Path) -> None:
    balls = [SCENE["balls"][0] | {"region": {"size_x": 490.0, "size_y": 590.0}}]
    record = run(scene(balls=balls, pool={"bytes": 8 << 18}), tmp_path / "out")
    assert record["counters"]["coarsened"] > 0
    found = next(one for one in record["errors"] if one["name"] == "levels, contact")
    assert found["metres"] > 0.0
    assert "pool.bytes is too small" in found["note"]


def test_stamps_during_the_run_are_made_at_their_time(tmp_path: Path) -> None:
    """A ball at rest where a pit opens begins to fall when it does, not before."""
    flat = {"kind": "flat", "rows": 129, "cols": 129, "spacing": 0.5}
    pit = {"kind": "crater", "x": 0.0, "y": 0.0, "radius": 8.0, "depth": 3.0, "time_s": 0.5}
    balls = [{"count": 1, "region": {"size_x": 0.01, "size_y": 0.01}, "radius": 0.5}]
    scenario = parse_scenario(
        {
            "terrain": flat,
            "stamps": [pit],
            "balls": balls,
            "run": {"duration_s": 1.0, "dt_s": 0.01, "checked_balls": 0},
            "output": {"parquet": True, "frames_per_s": 100.0},
        }
    )
    run(scenario, tmp_path / "out")
    from pyarrow import parquet

    table = parquet.read_table(tmp_path / "out" / "balls.parquet")
    time_s, z = (np.array(table[name]) for name in ("time_s", "z_m"))
    before = time_s <= 0.5
    np.testing.assert_allclose(z[before], 0.5, atol=1e-9)
    fallen = 0.5 - 0.5 * 9.81 * (time_s - 0.5) ** 2
    falling = (time_s > 0.5) & (fallen > -2.3)
    np.testing.assert_allclose(z[falling], fallen[falling], atol=1e-9)


def test_heights_asked_for_are_those_of_the_ground(tmp_path: Path) -> None:
    scenario = parse_scenario(
        {
            "terrain": {"kind": "plane", "rows": 65, "cols": 65, "spacing": 1.0, "slope_x": 0.5},
            "samples": [{"count": 50, "region": {"size_x": 40.0, "size_y": 40.0}}],
            "output": {"parquet": True},
        }
    )
    record = run(scenario, tmp_path / "out")
    from pyarrow import parquet

    table = parquet.read_table(tmp_path / "out" / "samples.parquet")
    east, z = np.array(table["east_m"]), np.array(table["z_m"])
    np.testing.assert_allclose(z, 0.5 * (east + 32.0), atol=1e-9)
    assert record["samples"][0]["count"] == 50
    assert record["samples"][0]["highest_m"] == pytest.approx(z.max())


def test_what_an_agent_needs_is_there_before_it_comes(tmp_path: Path) -> None:
    agents = [{"path": [[-200.0, 0.0], [200.0, 0.0]], "speed_m_s": 400.0, "radius": 100.0}]
    scenario = scene(
        balls=[], scatter=[], agents=agents, run={"duration_s": 1.0, "dt_s": 0.02, "paced": True}
    )
    counters = run(scenario, tmp_path / "out")["counters"]
    assert counters["stalls"] == 1
    assert counters["loads"] > counters["misses"]
