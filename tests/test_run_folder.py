"""A run's folder: whole or not there, and never in the place of anything else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from terrasim.errors import InputError, RunError
from terrasim.scenario.run import run_file, run_scenario
from terrasim.scenario.run_folder import run_folder
from terrasim.scenario.scenario import Scenario, parse_scenario

FLAT = {"kind": "flat", "rows": 65, "cols": 65, "spacing": 1.0}


def scene(**more: Any) -> Scenario:
    """Flat ground."""
    return parse_scenario({"terrain": FLAT, **more})


def run(scenario: Scenario, out: Path) -> dict[str, Any]:
    """Run a scenario into a folder."""
    return run_scenario(scenario, out.parent, out)


def test_a_failed_run_leaves_no_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: Any) -> None:
        raise RunError("the report cannot be written")

    monkeypatch.setattr("terrasim.scenario.run.write_report", fail)
    with pytest.raises(RunError):
        run(scene(), tmp_path / "deep" / "out")
    assert list((tmp_path / "deep").iterdir()) == []


def test_an_interrupted_run_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("terrasim.scenario.simulation.Simulation.advance", stop)
    with pytest.raises(KeyboardInterrupt):
        run(scene(run={"duration_s": 1.0}), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_a_full_disk_is_one_line_and_leaves_no_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: Any, **__: Any) -> int:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_text", full)
    with pytest.raises(RunError, match=r"No space left on device.*make room"):
        run(scene(), tmp_path / "out")
    assert list(tmp_path.iterdir()) == []


def test_an_earlier_run_is_replaced_whole(tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(scene(), out)
    (out / "old.txt").write_text("of the earlier run")
    run(scene(), out)
    assert sorted(path.name for path in out.iterdir()) == ["report.html", "run.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_an_earlier_run_stays_if_the_new_one_fails(tmp_path: Path) -> None:
    out = tmp_path / "out"
    run(scene(), out)
    before = (out / "run.json").read_text()

    def fail() -> None:
        with run_folder(out) as growing:
            (growing / "run.json").write_text("{}")
            raise RunError("it failed")

    with pytest.raises(RunError):
        fail()
    assert (out / "run.json").read_text() == before
    assert [path.name for path in tmp_path.iterdir()] == ["out"]


def test_an_empty_folder_may_be_filled(tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    run(scene(), tmp_path / "out")
    assert (tmp_path / "out" / "run.json").is_file()


def test_anything_but_a_run_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years of work")
    with pytest.raises(InputError, match="holds something other than a run"):
        run(scene(), tmp_path / "mine")
    assert (tmp_path / "mine" / "thesis.txt").read_text() == "years of work"


def test_no_folder_can_be_made_inside_a_file(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "out", tmp_path / "file" / "a" / "b"):
        with pytest.raises(InputError, match="--out"):
            run(scene(), out)


def test_a_missing_store_is_told_before_anything_is_made(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text('[terrain]\nkind = "store"\npath = "none.terrasim"\n')
    with pytest.raises(InputError, match="no store at"):
        run_file(path, out=tmp_path / "out")
    assert [one.name for one in tmp_path.iterdir()] == ["s.toml"]


def test_a_device_that_is_not_there_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.toml"
    path.write_text('[terrain]\nkind = "flat"\nrows = 9\ncols = 9\nspacing = 1.0\n')
    with pytest.raises(InputError, match="no device 'cuda:77'"):
        run_file(path, out=tmp_path / "out", device="cuda:77")
    assert not (tmp_path / "out").exists()
