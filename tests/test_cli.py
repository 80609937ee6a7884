"""The command line: one line for what is wrong, one JSON object for what was done."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrasim.cli import command
from terrasim.dem.import_options import ImportOptions

SMALL = """
description = "small"
[terrain]
kind = "flat"
rows = 65
cols = 65
spacing = 1.0
"""
Ran = Callable[..., tuple[int, str, str]]


@pytest.fixture
def ran(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Ran:
    """Runs a command in a folder of its own; gives status, standard output and error."""
    monkeypatch.chdir(tmp_path)

    def run(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = command([str(word) for word in words])
        out, error = capsys.readouterr()
        return status, out, error

    return run


@pytest.fixture
def small(tmp_path: Path) -> Path:
    """A scenario file."""
    path = tmp_path / "small.toml"
    path.write_text(SMALL)
    return path


def one_line(error: str) -> str:
    """The message of a failed command, which is one line without a traceback."""
    assert error.startswith("terrasim: error: ")
    assert error.count("\n") == 1
    assert "Traceback" not in error
    return error.removeprefix("terrasim: error: ").rstrip()


def test_a_run_makes_its_folder_under_out(ran: Ran, small: Path, tmp_path: Path) -> None:
    status, out, error = ran("run", small)
    assert status == 0
    assert error == ""
    assert "small" in out
    assert {one.name for one in (tmp_path / "out" / "small").iterdir()} == {
        "run.json",
        "report.html",
    }


def test_json_is_one_object_and_nothing_else(ran: Ran, small: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "g.npy", np.zeros((9, 9)))
    for words in (
        ("run", small, "--out", "a", "--json"),
        ("plan", small, "--json"),
        ("schema",),
        ("info", "g.npy", "--spacing", 2, "--json"),
        ("import", "g.npy", "g.terrasim", "--spacing", 2, "--json"),
        ("info", "g.terrasim", "--json"),
    ):
        status, out, error = ran(*words)
        assert (status, error) == (0, ""), words
        assert isinstance(json.loads(out), dict), words


def test_the_printed_record_is_the_written_one(ran: Ran, small: Path, tmp_path: Path) -> None:
    _, out, _ = ran("run", small, "--out", "a", "--json")
    assert json.loads(out) == json.loads((tmp_path / "a" / "run.json").read_text())


def test_people_get_tables(ran: Ran, small: Path, tmp_path: Path) -> None:
    np.save(tmp_path / "g.npy", np.zeros((9, 9)))
    status, out, _ = ran("plan", small)
    assert status == 0
    for word in ("terrain", "left out", "pool", "bytes", "all on the device"):
        assert word in out
    status, out, _ = ran("import", "g.npy", "g.terrasim", "--spacing", 2)
    assert status == 0
    status, out, _ = ran("info", "g.terrasim")
    assert status == 0
    assert "rows: 9" in out


def test_options_of_an_import_are_those_of_the_library(ran: Ran, tmp_path: Path) -> None:
    np.save(tmp_path / "g.npy", np.arange(81.0).reshape(9, 9))
    words = ("--spacing", 2, "--z-scale", 0.5, "--z-offset", 100, "--datum", 50)
    status, out, _ = ran("import", "g.npy", "g.terrasim", *words, "--json")
    assert status == 0
    _, out, _ = ran("info", "g.terrasim", "--json")
    held = json.loads(out)
    assert (held["spacing"], held["datum"]) == (2.0, 50.0)
    assert (held["lowest_m"], held["highest_m"]) == (100.0, 140.0)
    _, shown, _ = ran("import", "--help")
    for name in ImportOptions.__dataclass_fields__:
        assert f"--{name.replace('_', '-')}" in shown


def test_a_store_is_a_scenario_s_terrain(ran: Ran, tmp_path: Path) -> None:
    np.save(tmp_path / "g.npy", np.zeros((40, 50)))
    assert ran("import", "g.npy", "g.terrasim", "--spacing", 2)[0] == 0
    (tmp_path / "s.toml").write_text('[terrain]\nkind = "store"\npath = "g.terrasim"\n')
    status, out, _ = ran("run", "s.toml", "--json")
    assert status == 0
    assert json.loads(out)["plan"]["grid"]["cols"] == 50


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("run", "none.toml"), "none.toml: no such file; check the name"),
        (("plan", "none.toml"), "none.toml: no such file; check the name"),
        (("run", "folder"), "folder: is a folder; name the scenario file in it"),
        (("run", "noise.toml"), "noise.toml: is no TOML"),
        (("run", "binary.toml"), "binary.toml: is no text in UTF-8"),
        (("run", "key.toml"), "key.toml: terrain.colour is unknown: terrain takes"),
        (("run", "nan.toml"), "nan.toml: terrain.height must be a finite number, got nan"),
        (("run", "range.toml"), "range.toml: run.dt_s must be greater than 0, got -1"),
        (("run", "posts.toml"), "a terrain needs at least 2 x 2 posts, got 1 x 65"),
        (("run", "store.toml"), "no store at"),
        (("run", "dem.toml"), "none.tif: no such file"),
        (("run", "empty.toml"), "empty.tif: is empty (0 bytes)"),
        (("run", "small.toml", "--out", "small.toml"), "small.toml: is no folder; choose another"),
        (("run", "small.toml", "--out", "small.toml/a"), "no run can be written there"),
        (("run", "small.toml", "--out", "folder"), "holds something other than a run"),
        (("run", "small.toml", "--device", "cuda:99"), "no device 'cuda:99'"),
        (("run", "small.toml", "--threads", "0"), "run.threads must be greater than or equal"),
        (("run", "small.toml", "--threads", "two"), "Invalid value for '--threads'"),
        (("run",), "Missing argument"),
        (("run", "small.toml", "--speed", "9"), "No such option: --speed"),
        (("fly", "small.toml"), "No such command 'fly'"),
        (("info", "none.tif"), "none.tif: no such file; check the name"),
        (("info", "small.toml"), "small.toml"),
        (("import", "none.tif", "a.terrasim"), "none.tif: no such file; check the name"),
        (("import", "a.npy", "a.terrasim"), "give --spacing in metres"),
        (("import", "a.npy", "a.terrasim", "--spacing", "0"), "spacing must be positive"),
        (("import", "a.npy", "none/a.terrasim", "--spacing", "1"), "there is no folder none"),
        (("import", "nan.npy", "a.terrasim", "--spacing", "1"), "none of its 4 samples"),
        (("import", "inf.npy", "a.terrasim", "--spacing", "1"), "is out of range"),
    ],
)
def test_bad_input_is_one_line_and_status_2(
    ran: Ran, small: Path, tmp_path: Path, words: tuple[str, ...], told: str
) -> None:
    assert small.is_file()
    (tmp_path / "folder").mkdir()
    (tmp_path / "folder" / "mine.txt").write_text("mine")
    (tmp_path / "noise.toml").write_text("[[[")
    (tmp_path / "binary.toml").write_bytes(b"\x00\xff")
    (tmp_path / "key.toml").write_text(SMALL + "colour = 3\n")
    (tmp_path / "nan.toml").write_text(SMALL + "height = nan\n")
    (tmp_path / "range.toml").write_text(SMALL + "[run]\ndt_s = -1\n")
    (tmp_path / "posts.toml").write_text(SMALL.replace("rows = 65", "rows = 1"))
    (tmp_path / "store.toml").write_text('[terrain]\nkind = "store"\npath = "none.terrasim"\n')
    (tmp_path / "dem.toml").write_text('[terrain]\nkind = "dem"\nfiles = ["none.tif"]\n')
    (tmp_path / "empty.toml").write_text('[terrain]\nkind = "dem"\nfiles = ["empty.tif"]\n')
    (tmp_path / "empty.tif").write_bytes(b"")
    np.save(tmp_path / "a.npy", np.zeros((3, 3)))
    np.save(tmp_path / "nan.npy", np.full((2, 2), np.nan))
    np.save(tmp_path / "inf.npy", np.full((2, 2), np.inf))
    before = {path for path in tmp_path.rglob("*") if path.name != "out"}
    status, out, error = ran(*words)
    assert told in one_line(error)
    assert (status, out) == (2, "")
    assert {path for path in tmp_path.rglob("*") if path.name != "out"} == before


@pytest.mark.parametrize(
    ("raised", "status", "told"),
    [
        (OSError(28, "No space left on device", "x"), 1, "No space left on device"),
        (PermissionError(13, "Permission denied", "x"), 1, "Permission denied"),
        (MemoryError("unable to allocate 9 TiB"), 1, "not enough memory"),
        (KeyboardInterrupt(), 130, "interrupted"),
    ],
)
def test_failed_work_is_one_line_too(
    ran: Ran,
    small: Path,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    raised: BaseException,
    status: int,
    told: str,
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise raised

    monkeypatch.setattr("terrasim.scenario.run._simulate", fail)
    found, out, error = ran("run", small, "--out", "a")
    assert (found, out) == (status, "")
    if error or status != 130:
        assert told in one_line(error)
    assert not (tmp_path / "a").exists()
    assert [path.name for path in tmp_path.iterdir()] == ["small.toml"]


def test_no_permission_to_write_is_bad_input(
    ran: Ran, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def forbid(*_: Any, **__: Any) -> str:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("tempfile.mkdtemp", forbid)
    status, _, error = ran("run", small, "--out", "a")
    assert status == 2
    assert "no run can be written there (Permission denied)" in one_line(error)


def test_help_is_help(ran: Ran) -> None:
    status, out, error = ran("--help")
    assert (status, error) == (0, "")
    for word in ("run", "plan", "import", "info", "schema", "bench"):
        assert word in out


def test_the_program_runs_as_a_process_and_stays_off_the_terminal(tmp_path: Path) -> None:
    """No progress where standard error is no terminal, and no word of a missing GPU."""
    (tmp_path / "small.toml").write_text(SMALL)
    done = subprocess.run(
        [sys.executable, "-m", "terrasim", "run", "small.toml", "--json"],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        env=os.environ | {"COLUMNS": "80"},
    )
    assert done.returncode == 0
    assert done.stderr == ""
    assert json.loads(done.stdout)["name"] == "small"


def test_a_reader_that_goes_away_is_no_traceback(tmp_path: Path) -> None:
    program = f"{sys.executable} -m terrasim schema | head -c 10"
    done = subprocess.run(
        ["bash", "-c", program], cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert "Traceback" not in done.stderr
    assert "Error" not in done.stderr
