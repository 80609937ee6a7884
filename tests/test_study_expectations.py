"""A folder of scenarios: each held to what it says must come of it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from terrasim.cli import command
from terrasim.errors import InputError
from terrasim.study.expectations import study_folder
from terrasim.study.runs import DONE, FAILED, REFUSED, STOPPED, Result, Runs

SCENE = """
[terrain]
kind = "flat"
rows = 33
cols = 33
spacing = 0.5
[[balls]]
count = 3
region = { size_x = 4.0, size_y = 4.0 }
height = 0.05
radius = 0.1
restitution = 0.2
[run]
duration_s = 1.0
dt_s = 0.02
"""
SEEN: dict[str, Any] = {
    "balls": 1, "steps": 10, "fastest": 1e-6, "gap": 1e-6, "energy_gain": 0.0, "impacts": 7,
    "run_time": 1.0,
}  # fmt: skip


def written(folder: Path, name: str, expect: str, scene: str = SCENE) -> None:
    """A scenario file with an expectation."""
    (folder / f"{name}.toml").write_text(f"{scene}\n[expect]\n{expect}\n")


def test_a_folder_is_run_and_one_table_tells(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Balls come to rest; a step of 2 s is refused; what is no TOML has no expectation."""
    folder, out = tmp_path / "all", tmp_path / "out"
    folder.mkdir()
    written(folder, "rest", 'outcome = "rest"\nat_least = { impacts = 3 }')
    long = SCENE.replace("dt_s = 0.02", "dt_s = 2.0")
    written(folder, "long", 'outcome = "refused"\nreason = "run.dt_s must be less than"', long)
    assert command(["study", str(folder), "--out", str(out)]) == 0
    told, said = capsys.readouterr()
    assert said == ""
    assert "2 of 2 held" in told
    (folder / "broken.toml").write_text("[[")
    assert command(["study", str(folder), "--out", str(out), "--json"]) == 1
    told, _ = capsys.readouterr()
    record = json.loads(told)
    assert [(one["name"], one["held"], one["status"]) for one in record["scenarios"]] == [
        ("broken", False, "refused"), ("long", True, "refused"), ("rest", True, "done"),
    ]  # fmt: skip
    assert "is no TOML" in record["scenarios"][0]["happened"]


def judged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, expect: str, result: tuple[str, str, Any]
) -> tuple[bool, str]:
    """Whether an expectation holds of a result, and what is told."""
    status, reason, found = result
    result_ = Result(status, reason, found, tmp_path, False)
    monkeypatch.setattr(Runs, "result", lambda *_: result_)
    folder = tmp_path / "one"
    folder.mkdir()
    written(folder, "it", expect)
    (one,) = study_folder(folder, out=tmp_path / "out")["scenarios"]
    return one["held"], one["happened"]


@pytest.mark.parametrize(
    ("expect", "status", "found", "broken"),
    [
        ('outcome = "done"', DONE, {}, ""),
        ('outcome = "done"', FAILED, {}, "expected done"),
        ('outcome = "done"', REFUSED, {}, "expected done"),
        ('outcome = "rest"', DONE, {}, ""),
        ('outcome = "rest"', DONE, {"fastest": 0.1}, "fastest is 0.1, over 0.001 m/s"),
        ('outcome = "rest"', DONE, {"fastest": float("nan")}, "fastest is nan"),
        ('outcome = "rest"', DONE, {"gap": 0.1}, "gap is 0.1, over 0.001 m"),
        ('outcome = "rest"\ngap_m = 0.2', DONE, {"gap": 0.1}, ""),
        ('outcome = "rest"', DONE, {"balls": 0}, "rest needs balls"),
        ('outcome = "bounded_energy"', DONE, {}, ""),
        ('outcome = "bounded_energy"', DONE, {"energy_gain": 1e-3}, "energy_gain is 0.001, over"),
        ('outcome = "done"\nat_most = { impacts = 6 }', DONE, {}, "impacts is 7, over 6"),
        ('outcome = "done"\nat_least = { impacts = 8 }', DONE, {}, "impacts is 7, under 8"),
        ('outcome = "done"\nat_least = { held = 1 }', DONE, {}, "held was not measured"),
        ('outcome = "refused"\nreason = "stiff"', REFUSED, {}, ""),
        ('outcome = "refused"\nreason = "soft"', REFUSED, {}, "does not hold 'soft'"),
        ('outcome = "refused"', STOPPED, {}, "expected refused"),
        ('outcome = "stopped"\nreason = "too stiff"', STOPPED, {}, ""),
        ('outcome = "stopped"', DONE, {}, "expected stopped"),
    ],
)
def test_an_expectation_holds_or_says_what_broke_it(
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    expect: str,
    status: str,
    found: dict[str, Any],
    broken: str,
) -> None:
    reason = "" if status == DONE else "it is too stiff"
    held, told = judged(tmp_path, monkeypatch, expect, (status, reason, SEEN | found))
    assert held == (not broken)
    assert broken in told


@pytest.mark.parametrize(
    ("expect", "reason"),
    [
        ('outcome = "fine"', "expect.outcome must be"),
        ('outcome = "rest"\nreason = "x"', "'rest' says nothing"),
        ('outcome = "refused"\nat_most = { impacts = 1 }', "measures nothing"),
        ('outcome = "done"\nat_most = { error = 1 }', "needs a reference"),
        ('outcome = "done"\nat_most = { impact = 1 }', "'impact' is no measure"),
        ('outcome = "done"\nspeed = 1', "expect.speed is unknown"),
    ],
)
def test_a_wrong_expectation_is_refused_before_anything_runs(
    tmp_path: Path, expect: str, reason: str
) -> None:
    written(tmp_path, "it", expect)
    with pytest.raises(InputError, match=reason):
        study_folder(tmp_path, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_folder_without_scenarios_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no scenario"):
        study_folder(tmp_path, out=tmp_path / "out")
