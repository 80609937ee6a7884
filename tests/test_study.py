"""A study: what it refuses, what it runs, what it keeps, and what it says."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pyarrow import parquet

from terrasim.cli import command
from terrasim.errors import InputError, RunError
from terrasim.scenario.scenario import load_scenario, scenario_schema, scenario_settings
from terrasim.study.report import study_html
from terrasim.study.runs import FAILED, REFUSED, Result, Runs
from terrasim.study.study import study_file
from terrasim.study.study_file import read_study

SCENE = """
description = "Balls & bounces."
[terrain]
kind = "flat"
rows = 65
cols = 65
spacing = 0.5
[[balls]]
count = 4
region = { size_x = 10.0, size_y = 10.0 }
height = 0.5
radius = 0.1
restitution = 0.8
friction = 0.0
[[balls]]
count = 2
region = { size_x = 10.0, size_y = 10.0 }
height = 1.0
radius = 0.2
restitution = 0.9
friction = 0.0
[run]
duration_s = 0.96
dt_s = 0.016
"""
STUDY = """
[study]
repeats = 1
measure = ["error", "energy_gain", "penetration", "run_time_per_ball_step", "memory", "impacts"]
[study.vary]
"run.dt_s" = [0.016]
[study.reference]
kind = "exact"
solution = "bounce"
"""


def written(path: Path, study: str = STUDY, scene: str = SCENE) -> Path:
    """A scenario file with a study."""
    path.write_text(scene + study)
    return path


def test_a_study_measures_goes_on_and_tells(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """First one step size; then another is added, and the first is not run again."""
    file, out = written(tmp_path / "bounce.toml"), tmp_path / "out"
    first = study_file(file, out=out)
    assert first["kept"] == 0
    assert first["held"]
    written(file, STUDY.replace("[0.016]", "[0.016, 0.008]"))
    assert command(["study", str(file), "--out", str(out), "--json"]) == 0
    told, said = capsys.readouterr()
    record = json.loads(told)
    assert said == ""
    assert record["kept"] == 1
    assert record == json.loads((out / "study.json").read_text())
    one, other = record["variants"]
    assert one["error"] == first["variants"][0]["error"]
    for variant, steps in ((one, 60), (other, 120)):
        assert variant["status"] == "done"
        # Flight is exact in a step, so what is left is rounding.
        assert 0.0 <= variant["error"]["median"] < 1e-12
        assert variant["energy_gain"]["median"] < 1e-12
        assert variant["penetration"]["median"] < 1e-12
        assert variant["impacts"]["median"] == 4 * 2 + 2 * 1
        assert variant["run_time_per_ball_step"]["median"] > 0.0
        assert variant["run_time"]["median"] * 1e9 > 6 * steps
    # What the first process compiled the second found ready.
    assert other["modules_compiled"]["median"] == 0
    assert one["first_step_s"]["median"] > 0.0

    table = parquet.read_table(out / "study.parquet").to_pydict()
    assert table["run.dt_s"] == [0.016, 0.008]
    assert table["variant"] == [1, 2]
    assert table["error"] == [one["error"]["median"], other["error"]["median"]]

    page = (out / "report.html").read_text()
    assert page == study_html(record)
    assert "Balls &amp; bounces." in page
    for word in ("run.dt_s", "the exact solution", "Pareto front", record["machine"]["processor"]):
        assert word in page
    assert page.count("data:image/png;base64,") >= 1
    assert "http" not in page


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (("run.dt_s", "run.dt"), "study.vary: run.dt = 0.016: run.dt is unknown: run takes"),
        (('"run.dt_s"', '"balls[3].radius"'), "there is no balls[3]: the scenario has 2"),
        (('"run.dt_s"', '"balls[0].radius"'), "counted from 1"),
        (('"run.dt_s"', '"name"'), "cannot be varied"),
        (('"run.dt_s"', '"run..dt_s"'), "is no path of a setting"),
        (('"run.dt_s"', '"run.dt_s.x"'), "holds no settings"),
        (("[0.016]", "[]"), "study.vary.run.dt_s must"),
        (("[0.016]", "[0.016, 0.016]"), "stands there twice"),
        (("[0.016]", "[0.016, -1.0]"), "run.dt_s must be greater than 0, got -1.0"),
        (('"error"', '"eror"'), "'eror' is no measure: choose from error,"),
        (('solution = "bounce"', 'solution = "bonce"'), "'bonce' is no solution: choose from"),
        (('solution = "bounce"', 'solution = "slide"'), "balls that start on the ground"),
        (('kind = "exact"\nsolution = "bounce"', 'kind = "engine"\nengine = "x"'), "is no engine"),
        (('kind = "exact"', 'kind = "exakt"'), "study.reference.kind must be one of"),
        (('[study.reference]\nkind = "exact"\nsolution = "bounce"\n', ""), "needs a reference"),
        (("repeats = 1", "repeats = 0"), "study.repeats must be greater"),
        (('"run.dt_s" = [0.016]', ""), "study.vary"),
    ],
)
def test_what_is_wrong_is_named_before_anything_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: tuple[str, str], reason: str
) -> None:
    assert change[0] in STUDY
    file, out = written(tmp_path / "bad.toml", STUDY.replace(*change)), tmp_path / "out"
    assert command(["study", str(file), "--out", str(out)]) == 2
    told, said = capsys.readouterr()
    assert told == ""
    assert len(said.splitlines()) == 1
    assert reason in said
    assert not out.exists()


def test_lists_of_a_zip_go_together(tmp_path: Path) -> None:
    two = STUDY.replace("[0.016]", '[0.016, 0.008]\n"balls.radius" = [0.1, 0.2]')
    both = read_study(written(tmp_path / "a.toml", two))
    assert len(both.variants) == 4
    assert [group.radius[0] for group in both.variants[1].scenario.balls] == [0.2, 0.2]
    zipped = two.replace("repeats = 1", 'repeats = 1\ncombine = "zip"')
    pairs = read_study(written(tmp_path / "b.toml", zipped)).variants
    assert [(one.scenario.run.dt_s, one.scenario.balls[1].radius[0]) for one in pairs] == [
        (0.016, 0.1), (0.008, 0.2),
    ]  # fmt: skip
    with pytest.raises(InputError, match="equally long"):
        read_study(written(tmp_path / "c.toml", zipped.replace("[0.1, 0.2]", "[0.1]")))


def test_knobs_make_tables_and_turn_one_entry(tmp_path: Path) -> None:
    study = STUDY.replace('"run.dt_s" = [0.016]', '"balls[2].radius" = [0.3]\ndetail.factor = [4]')
    (one,) = read_study(written(tmp_path / "a.toml", study)).variants
    assert [group.radius[0] for group in one.scenario.balls] == [0.1, 0.3]
    assert one.scenario.detail is not None
    assert one.scenario.detail.factor == 4
    assert one.label == "balls[2].radius = 0.3, detail.factor = 4"


SETTING = STUDY.replace(
    'kind = "exact"\nsolution = "bounce"', 'kind = "setting"\nsettings = { "run.dt_s" = 0.001 }'
)


def test_a_setting_changes_every_variant_alike(tmp_path: Path) -> None:
    study = SETTING.replace("[0.016]", '[0.016]\n"balls.restitution" = [0.5, 0.6]')
    for one in read_study(written(tmp_path / "a.toml", study)).variants:
        assert one.reference is not None
        assert one.reference.scenario.run.dt_s == 0.001
        assert one.reference.scenario.balls == one.scenario.balls
    for wrong, reason in (("0.007", "ends at"), ("0.001, run.balls = 1", "unknown")):
        with pytest.raises(InputError, match=reason):
            read_study(written(tmp_path / "b.toml", study.replace("0.001", wrong)))


@pytest.mark.parametrize(
    ("status", "error"), [(FAILED, RunError), (REFUSED, InputError), ("stopped", RunError)]
)
def test_a_reference_that_fails_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, status: str, error: type[Exception]
) -> None:
    def bad(*words: Any) -> Result:
        return Result(status, "it broke", {}, tmp_path, False)

    monkeypatch.setattr(Runs, "result", bad)
    file = written(tmp_path / "a.toml", SETTING)
    with pytest.raises(error, match=r"study.reference: run.dt_s = 0.001: was .*it broke"):
        study_file(file, out=tmp_path / "out")


def test_a_study_of_which_nothing_runs_has_failed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A refusal is an answer, a process that died is none."""
    statuses = iter([FAILED, REFUSED, FAILED, FAILED])

    def bad(*words: Any) -> Result:
        return Result(next(statuses), "ended by signal 9", {}, tmp_path, False)

    monkeypatch.setattr(Runs, "result", bad)
    file = written(tmp_path / "a.toml", STUDY.replace("[0.016]", "[0.016, 0.008]"))
    assert command(["study", str(file), "--out", str(tmp_path / "out")]) == 1
    told, _ = capsys.readouterr()
    assert "variant 1 was failed: ended by signal 9" in told
    assert "Variant 2 was refused." in (tmp_path / "out" / "report.html").read_text()
    assert command(["study", str(file), "--out", str(tmp_path / "out")]) == 1
    _, said = capsys.readouterr()
    assert "no variant could be run: ended by signal 9" in said


def test_other_folders_are_left_alone(tmp_path: Path) -> None:
    file = written(tmp_path / "a.toml")
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis.txt").write_text("years")
    with pytest.raises(InputError, match="holds something other than a study"):
        study_file(file, out=tmp_path / "mine")
    with pytest.raises(InputError, match="is no folder"):
        study_file(file, out=file)
    with pytest.raises(InputError, match="no table"):
        study_file(written(tmp_path / "b.toml", ""), out=tmp_path / "out")


def test_a_run_reads_no_study(tmp_path: Path) -> None:
    """Its tables may stand in the file; they cost nothing, and change nothing of the record."""
    file = written(tmp_path / "a.toml")
    words = (
        "import sys\nfrom pathlib import Path\nimport terrasim.scenario.run as run\n"
        f"run.plan_file(Path({str(file)!r}))\n"
        "print([name for name in sys.modules if name.startswith('terrasim.study')])"
    )
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
    scenario = load_scenario(file)
    assert scenario.study is not None
    assert not {"study", "expect"} & set(scenario_settings(scenario))


def test_the_schema_holds_what_a_study_reads() -> None:
    schema = scenario_schema()
    assert {"study", "expect", "terrain"} <= set(schema["properties"])
    assert "solution" in schema["$defs"]["ExactReference"]["properties"]


def test_the_shipped_study_is_whole() -> None:
    root = Path(__file__).resolve().parents[1]
    read = read_study(root / "scenarios" / "bounce.toml")
    assert len(read.variants) >= 4
    steps = [one.scenario.steps * one.scenario.run.dt_s for one in read.variants]
    np.testing.assert_allclose(steps, steps[0], rtol=1e-12)
