"""Edits of a terrain with a store: acknowledged is for good, once, and seen by whoever reads."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from edited_ground import (
    CORNER,
    FACTOR,
    SMALL,
    Bits,
    bits,
    build,
    heights,
    held,
    hill,
    model,
    opened,
    operations,
    source,
)
from soak import SOAKING
from stored import killed

import terrasim as ts
from terrasim.deform.edits import Receipt, edits_of
from terrasim.deform.operations import Operation, Stamping
from terrasim.deform.window import read_window
from terrasim.dem.export import export
from terrasim.errors import InputError
from terrasim.store.collect import collect
from terrasim.store.history import history
from terrasim.store.verify import verify

RETRIED = 10_000 if SOAKING else 300
DROPPED = 0.3
TRIES = 5
HEAD = """
import os, signal, sys
from pathlib import Path
from edited_ground import opened, operations
from terrasim.deform.edits import edits_of
terrain = opened(Path(sys.argv[1]))
for number, one in enumerate(operations()):
    edits_of(terrain).commit(one, idem=f"{number}", wait=number % 3 == 0)
    if number == 4:
        terrain.edits.checkpoint()
"""
ENDS = {
    "killed": "os.kill(os.getpid(), signal.SIGKILL)",
    "ended at once": "os._exit(0)",
    "ended": "sys.exit(0)",
}


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store to copy."""
    return build(tmp_path_factory.mktemp("imported") / "ground.store")


@pytest.fixture
def path(imported: Path, tmp_path: Path) -> Path:
    """A store."""
    return killed(imported, tmp_path / "here")


@pytest.fixture(scope="module")
def after_all() -> Bits:
    """The ground after every operation, worked out in memory."""
    return model(operations())


def commit(terrain: ts.Terrain, one: Operation, **more: Any) -> Receipt:
    return edits_of(terrain).commit(one, **more)


def is_after_all(path: Path, after_all: Bits) -> None:
    """It opens to what was acknowledged; a second try of any of it changes nothing."""
    with opened(path) as terrain:
        assert bits(terrain) == after_all
        branch = edits_of(terrain).require_branch()
        assert branch.last_seq == len(operations())
        for number, one in enumerate(operations()):
            receipt = commit(terrain, one, idem=f"{number}")
            assert (receipt.seq, receipt.repeated) == (number + 1, True)
        assert branch.last_seq == len(operations())
        assert bits(terrain) == after_all
    with opened(path) as terrain:
        assert edits_of(terrain).replayed == 0
        assert bits(terrain) == after_all
    assert verify(path)["sound"]


@pytest.mark.parametrize("end", ENDS.values(), ids=ENDS.keys())
def test_a_process_that_ends_without_closing_leaves_every_bit(
    path: Path, after_all: Bits, end: str
) -> None:
    """However it ends; a checkpoint holds half of it, and some stamps were still waiting."""
    tests = str(Path(__file__).parent)
    done = subprocess.run(
        [sys.executable, "-c", HEAD + end, str(path)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join([tests, *sys.path])},
        check=False,
        capture_output=True,
        text=True,
    )
    assert done.returncode == (-signal.SIGKILL if end == ENDS["killed"] else 0), done.stderr
    is_after_all(path, after_all)


@pytest.mark.parametrize("done", range(11))
def test_every_state_between_two_operations_reopens(path: Path, tmp_path: Path, done: int) -> None:
    """Checkpointed or replayed, one or together, with large pools or the smallest."""
    with opened(path) as terrain:
        for one in operations()[:done]:
            commit(terrain, one, wait=False)
        if done % 2:
            edits_of(terrain).checkpoint()
            commit(terrain, Stamping((hill(),)))
        copy = killed(path, tmp_path / "copy")
        expected, seq = bits(terrain), edits_of(terrain).require_branch().last_seq
    for name in (copy, path):
        with opened(name, pool_bytes=SMALL, detail_pool_bytes=SMALL) as terrain:
            assert edits_of(terrain).replayed == (0 if name == path else done % 2 or done)
            assert edits_of(terrain).require_branch().last_seq == seq
            assert bits(terrain) == expected


def test_an_operation_whose_reply_was_lost_is_done_once_however_often_it_comes(
    path: Path,
) -> None:
    """Three replies of ten are lost, and now and then the terrain is opened anew."""
    rng, stamps, tries = np.random.default_rng(9), [], 0
    terrain = opened(path)
    for number in range(RETRIED):
        x, y = rng.uniform(-30.0, 30.0, 2).tolist()
        stamps.append(hill(x, y, detail=number % 4 == 0))
        for _ in range(TRIES):
            receipt = commit(
                terrain, Stamping((stamps[-1],)), idem=f"{number}", wait=number % 2 == 0
            )
            tries += 1
            assert receipt.seq == number + 1
            if number % 100 == 50:
                terrain.close()
                terrain = opened(path)
            if rng.random() > DROPPED:
                break
    found = bits(terrain)
    terrain.close()
    assert tries > 1.3 * RETRIED
    rows = history(path, limit=2 * RETRIED)
    assert [row.idem for row in rows] == [f"{number}" for number in reversed(range(RETRIED))]
    assert found == model([Stamping(tuple(stamps))])


def test_a_key_that_stands_for_something_else_is_refused(path: Path) -> None:
    """Nothing is changed then, whichever kind of operation it is and after opening again."""
    with opened(path) as terrain:
        commit(terrain, Stamping((hill(),)), idem="one")
        first = commit(terrain, Stamping((hill(3.0),)), idem="two")
        edits_of(terrain).checkpoint()
        before, ground = held(path), bits(terrain)
        assert first.seq == 2
        for other in operations():
            with pytest.raises(InputError, match="'one' stands for another operation, number 1"):
                commit(terrain, other, idem="one")
        with pytest.raises(InputError, match="'two' stands for another operation, number 2"):
            ts.undo(terrain, 1, idem="two")
        assert (held(path), bits(terrain)) == (before, ground)
    with opened(path) as terrain:
        with pytest.raises(InputError, match="'one' stands for another operation, number 1"):
            commit(terrain, Stamping((hill(0.001),)), idem="one")
        again = commit(terrain, Stamping((hill(),)), idem="one", wait=False)
        assert (again.seq, again.repeated, again.ledger) == (1, True, ts.Ledger())
        assert bits(terrain) == ground


def test_a_repeated_operation_is_answered_with_its_ledger_while_it_is_known(path: Path) -> None:
    with opened(path) as terrain:
        first = commit(terrain, Stamping((hill(),)), idem="one")
        again = commit(terrain, Stamping((hill(),)), idem="one")
        assert first.ledger.added > 0
        assert (again.ledger, again.repeated, first.repeated) == (first.ledger, True, False)
    with ts.Terrain(source()) as terrain, pytest.raises(InputError, match="has no store"):
        commit(terrain, Stamping((hill(),)), idem="one")


POINTS = np.array([[CORNER[0] + x, CORNER[1] + y] for x in range(-8, 9, 2) for y in range(-8, 9)])
EAST = (np.array([[CORNER[0] - 30.0, CORNER[1], 1.2]]), np.array([[1.0, 0.0, 0.0]]))


def _balls(terrain: ts.Terrain) -> Any:
    balls = ts.Balls.at(terrain, [[CORNER[0], CORNER[1], 1.5]], radius=0.4)
    for _ in range(10):
        ts.step(terrain, balls, 0.05)
    return balls.positions(terrain)


def _waiting_balls(terrain: ts.Terrain) -> Any:
    """Balls whose ground was required before the stamp came."""
    balls = ts.Balls.at(terrain, [[CORNER[0], CORNER[1], 1.5]], radius=0.4)
    ts.step(terrain, balls, 0.3, require=False)
    return balls.positions(terrain)


def _exported(terrain: ts.Terrain) -> Any:
    import rasterio

    edits_of(terrain).snapshot("now")
    path = edits_of(terrain).require_branch().path
    with ts.open_store(path, snapshot="now") as store:
        export(store, path.with_name("now.tif"))
    with rasterio.open(path.with_name("now.tif")) as file:
        return file.read(1)


def _forked(terrain: ts.Terrain) -> Any:
    edits_of(terrain).fork("other")
    with ts.open_store(edits_of(terrain).require_branch().path, branch="other") as store:
        return store.block(ts.Block(0, 0, 0)).posts


def _reset(terrain: ts.Terrain) -> Any:
    edits_of(terrain).reset(0)
    return ts.sample(terrain, POINTS).height


READERS: dict[str, Callable[[ts.Terrain], Any]] = {
    "heights": lambda one: ts.sample(one, POINTS).height,
    "heights of what is there": lambda one: ts.sample(one, POINTS, wait=False).height,
    "coarse heights": lambda one: ts.sample(one, POINTS, level=1).height,
    "normals": lambda one: ts.sample_all(one, POINTS).normal,
    "rays": lambda one: ts.raycast(one, *EAST, max_distance=60.0).distance,
    "rays through what is there": lambda one: (
        ts.raycast(one, *EAST, max_distance=60.0, wait=False).distance
    ),
    "balls": _balls,
    "balls without a requirement": _waiting_balls,
    "a window": lambda one: read_window(one, 200, 80, 130, 40),
    "a window of detail": lambda one: read_window(one, 1000, 180, 99, 40, detail=True),
    "an export": _exported,
    "a branch": _forked,
    "another stamp": lambda one: commit(one, Stamping((hill(mode="fill", z=0.5),))).ledger,
    "a reset": _reset,
}


@pytest.mark.parametrize("detail", [False, True], ids=["base", "detail"])
@pytest.mark.parametrize("late", ["wait", "fallback"])
@pytest.mark.parametrize("read", READERS.values(), ids=READERS.keys())
def test_whoever_reads_sees_a_stamp_that_waits(
    imported: Path, tmp_path: Path, read: Any, late: str, detail: bool
) -> None:
    """The same as if it had not waited; all ground is there already, so that nothing is read."""
    answers = []
    for wait in (True, False):
        path = killed(imported, tmp_path / f"{wait}")
        with opened(path, late=late) as terrain:
            ts.sample(terrain, POINTS)
            ts.step(terrain, ts.Balls.at(terrain, [[*CORNER, 9.0]], radius=0.4), 0.3)
            still = np.array(ts.sample(terrain, POINTS).height)
            receipt = commit(terrain, Stamping((hill(detail=detail),)), wait=wait)
            assert receipt.ledger.pending == (not wait)
            answers.append(read(terrain))
            assert edits_of(terrain).settle() == ts.Ledger()
            if read is not _reset:
                assert np.any(ts.sample(terrain, POINTS).height > still + 0.5)
    np.testing.assert_array_equal(*answers)


def test_nothing_depends_on_the_size_of_the_pools_or_on_threads(
    path: Path, after_all: Bits
) -> None:
    """Also when blocks come and go all the time, and checkpoints and collections go on."""
    with opened(path, pool_bytes=SMALL, detail_pool_bytes=SMALL, threads=3, loaders=4) as terrain:
        for number, one in enumerate(operations()):
            commit(terrain, one, wait=number % 2 == 0)
            if number % 3 == 0:
                edits_of(terrain).checkpoint()
                collect(edits_of(terrain).require_branch())
        assert bits(terrain) == after_all
    with opened(path, pool_bytes=SMALL, detail_pool_bytes=SMALL) as terrain:
        assert bits(terrain) == after_all


def test_the_ledgers_add_up_to_the_difference_of_all_heights(path: Path) -> None:
    """Of the receipts, those that waited among them, of an undo and of the run; to the count."""
    with opened(path) as terrain:
        before = heights(bits(terrain))
        total = ts.Ledger()
        for number, one in enumerate(operations()):
            waits = number % 2 == 1
            receipt = commit(terrain, one, wait=not waits)
            if receipt.ledger.pending:
                assert receipt.ledger == ts.Ledger(pending=len(one.stamps))  # type: ignore[union-attr]
                total += edits_of(terrain).settle()
            else:
                total += receipt.ledger
            now = heights(bits(terrain))
            assert now - before == total.net * FACTOR**3 // total.unit
            assert edits_of(terrain).ledger == total
        total += ts.undo(terrain, 10).ledger
        assert heights(bits(terrain)) - before == total.net * FACTOR**3 // total.unit
        assert total.clamped == 0
        rows = list(edits_of(terrain).require_branch().rows())
    assert [row.seq for row in rows] == list(range(1, len(operations()) + 2))
    assert rows[0].summary == "1 x add gaussian, 1 x add crater"
    assert rows[-1].summary == "undo 10: 1 x add crater"
