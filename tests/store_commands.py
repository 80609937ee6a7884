"""Commands on a store, and a store on which they are tried."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import terrasim as ts
from terrasim.cli import command
from terrasim.counts import HOLE, Counts
from terrasim.deform.edits import edits_of
from terrasim.deform.operations import Stamping
from terrasim.store.build import build_store
from terrasim.store.store import open_store

GRID = ts.Grid(60, 50, 0.5, 400_000.0, 3_700_000.0, row=-20, col=10, datum=123.25, crs="EPSG:32611")
LISTS = ("history", "snapshot", "branch")
"""Commands that only look, as long as they are given no name."""
Ran = Callable[..., tuple[int, str, str]]
ALL = (
    ("history",),
    ("snapshot",),
    ("snapshot", "a"),
    ("branch",),
    ("branch", "a"),
    ("branch", "a", "--at", "b"),
    ("reset", "a"),
    ("undo", "1"),
    ("verify",),
    ("collect",),
    ("collect", "--keep", "0"),
    ("backup", "copy.store"),
    ("export", "a.tif"),
    ("export", "a.exr"),
)
"""Every command, with what follows the store."""


def runner(capsys: pytest.CaptureFixture[str]) -> Ran:
    """Runs a command; gives status, standard output and error."""

    def run(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        status = command([str(word) for word in words])
        out, error = capsys.readouterr()
        assert "Traceback" not in out + error
        return status, out, error

    return run


def hill(x: float, **more: Any) -> Stamping:
    """A hill not far from the terrain's middle."""
    return Stamping((ts.Gaussian(12.0 + x, 2.0, 1.0, 2.0, **more),))


def fresh(path: Path) -> Path:
    """A store with a hole in which nothing was done."""
    rng = np.random.default_rng(3)
    posts: Counts = rng.normal(0, 200, (GRID.rows, GRID.cols)).astype(np.int32)
    posts[3, 5] = HOLE
    build_store(ts.ArraySource(posts, GRID), GRID, path, provenance={})
    return path


def play(path: Path) -> Path:
    """Three hills, a snapshot, a fourth that adds and a fifth that fills."""
    with ts.open_terrain(fresh(path)) as terrain:
        for one in range(3):
            edits_of(terrain).commit(hill(one), idem=f"job:x:{one} [red]")
        edits_of(terrain).snapshot("three")
        edits_of(terrain).commit(hill(-2.0))
        edits_of(terrain).commit(hill(-2.0, mode="fill", z=124.0))
    return path


def posts(path: Path, **state: str) -> Counts:
    """All heights of a state, the northern edge first."""
    rows = np.arange(GRID.row + GRID.rows - 1, GRID.row - 1, -1)
    with open_store(path, **state) as source:
        return source.posts(0, rows, np.arange(GRID.col, GRID.col + GRID.cols))


def one_line(error: str) -> str:
    """The message of a failed command, which is one line."""
    assert error.startswith("terrasim: error: ")
    assert error.count("\n") == 1
    return error


def told(ran: Ran, *words: object) -> dict[str, Any]:
    """What a command that must go well says as JSON."""
    status, out, error = ran(*words, "--json")
    assert (status, error) == (0, "")
    found: dict[str, Any] = json.loads(out)
    return found


def files(folder: Path) -> dict[str, bytes]:
    """Every file below a folder and what it holds."""
    return {str(one): one.read_bytes() for one in folder.rglob("*") if one.is_file()}
