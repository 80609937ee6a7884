"""A run that does not wait for its ground says so, and a terrain takes one of two rules."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from terrasim.errors import InputError
from terrasim.grid import Block, Grid
from terrasim.scenario.run import run_scenario
from terrasim.scenario.scenario import parse_scenario
from terrasim.sources.analytic import Flat, Sine
from terrasim.sources.source import BlockData
from terrasim.terrain import Terrain

HILLS = {"kind": "sine", "rows": 2049, "cols": 2049, "spacing": 1.0, "amplitude": 5.0}
BALLS = {
    "count": 20,
    "region": {"x": 0.0, "y": 0.0, "size_x": 1500.0, "size_y": 20.0},
    "height": 1.0,
    "radius": [0.2, 0.3],
    "velocity": [60.0, 0.0, 0.0],
}


@pytest.mark.parametrize("late", ["wait", "fallback"])
def test_a_record_says_whether_the_run_is_repeatable(
    late: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """With a slow disk, falling back costs ground and no stall; waiting the other way round."""
    read = Sine.block

    def slowly(self: Sine, key: Block) -> BlockData:
        time.sleep(0.02)
        return read(self, key)

    monkeypatch.setattr(Sine, "block", slowly)
    scenario = parse_scenario(
        {
            "terrain": {**HILLS, "wavelength": 200.0},
            "balls": [BALLS],
            "run": {"duration_s": 1.0, "dt_s": 0.02, "late": late},
        }
    )
    record = run_scenario(scenario, tmp_path, tmp_path / "out")
    counters, report = record["counters"], (tmp_path / "out" / "report.html").read_text()
    assert record["repeatable"] is (late == "wait")
    assert ("Not repeatable." in report) is (late == "fallback")
    if late == "wait":
        assert counters["late"] == 0
        assert record["balls"]["coarse"] == 0
        assert counters["stalls"] > 0
    else:
        assert counters["late"] > 0
        assert record["balls"]["coarse"] > 0
        assert counters["stalls"] <= 1


def test_a_terrain_waits_or_falls_back_and_nothing_else() -> None:
    """Another word is refused with both."""
    with pytest.raises(InputError, match="late must be 'wait' or 'fallback', got 'never'"):
        Terrain(Flat(Grid(9, 9, 1.0)), late="never")  # type: ignore[arg-type]
