"""The stiff and extreme scenarios: each is one, and says what must come of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from terrasim.scenario.scenario import load_scenario
from terrasim.study.expectations import study_folder
from terrasim.study.settings import read_tables

FOLDER = Path(__file__).resolve().parents[1] / "scenarios" / "extreme"
CHEAP = ("springs_over_the_limit.toml", "weightless.toml", "a_step_of_a_second.toml")


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.toml")), ids=lambda path: path.stem)
def test_each_says_what_must_come_of_it(path: Path) -> None:
    scenario = load_scenario(path)
    assert scenario.description
    assert scenario.study is None
    tables = read_tables(None, scenario.expect, path.name)
    assert tables.expect is not None


def test_what_some_of_them_say_comes(tmp_path: Path) -> None:
    """The cheapest: one refused, one without gravity, one at the longest step."""
    few = tmp_path / "few"
    few.mkdir()
    for name in CHEAP:
        (few / name).write_bytes((FOLDER / name).read_bytes())
    found = study_folder(few, out=tmp_path / "out")["scenarios"]
    assert [one["held"] for one in found] == [True, True, True]
    assert "over 0.2 of the explicit limit of 0.00155" in found[1]["happened"]
