"""Back to an earlier state: undo of what added, snapshots, resets and branches, to the bit."""

from __future__ import annotations

import threading
from itertools import pairwise
from pathlib import Path

import apsw
import numpy as np
import pytest
from edited_ground import bits, build, held, hill, model, opened, operations, source
from stored import killed

import terrasim as ts
from terrasim.cache.ground import Ground
from terrasim.deform.edits import edits_of
from terrasim.deform.operations import Operation, Stamping
from terrasim.deform.patch import Patch
from terrasim.detail.grid import DetailGrid
from terrasim.errors import InputError
from terrasim.store.verify import verify

ADDING = (1, 2, 4, 5, 8, 9, 10)
"""Which of the operations only add, by their numbers in the journal."""


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store to copy."""
    return build(tmp_path_factory.mktemp("imported") / "ground.store")


@pytest.fixture
def path(imported: Path, tmp_path: Path) -> Path:
    """A store."""
    return killed(imported, tmp_path / "here")


def do(terrain: ts.Terrain, done: list[Operation]) -> None:
    for number, one in enumerate(done):
        edits_of(terrain).commit(one, wait=number % 2 == 0)


def test_an_undo_gives_every_bit_back(path: Path) -> None:
    """In any order, of stamps and patches, base and detail, the last block of detail too."""
    adding = [operations()[number - 1] for number in ADDING]
    with opened(path) as terrain:
        before = bits(terrain)
        do(terrain, adding)
        left = dict(enumerate(adding, start=1))
        for seq in (4, 1, 7, 2, 6, 3, 5):
            del left[seq]
            receipt = ts.undo(terrain, seq)
            assert receipt.ledger.posts > 0
            assert bits(terrain) == model(list(left.values())), seq
            if seq == 2:
                edits_of(terrain).checkpoint()
        assert bits(terrain) == before
        assert edits_of(terrain).ledger.net == 0
        copy = killed(path, path.parent / "copy")
    for name in (copy, path):
        with opened(name) as terrain:
            assert bits(terrain) == before
            assert all(key.level >= 0 for key in before)
    assert verify(path)["sound"]


def test_an_undo_that_would_not_be_exact_is_refused_and_changes_nothing(path: Path) -> None:
    """Of what did more than add, of what others built on, of what was taken back already."""
    with opened(path) as terrain:
        do(terrain, operations())
        ts.undo(terrain, 10)
        edits_of(terrain).checkpoint()
        before, ground = held(path), bits(terrain)
        for seq in (3, 7):
            with pytest.raises(InputError, match=f"operation {seq} did more than add; reset"):
                ts.undo(terrain, seq)
        for seq in (6, 11):
            with pytest.raises(InputError, match=f"operation {seq} .*cannot be taken back"):
                ts.undo(terrain, seq)
        for seq, other in ((1, 3), (2, 3), (4, 6), (5, 6)):
            with pytest.raises(InputError, match=f"operation {other} .* built on it; reset"):
                ts.undo(terrain, seq)
        with pytest.raises(InputError, match="operation 10 was taken back already by 11"):
            ts.undo(terrain, 10)
        assert (held(path), bits(terrain)) == (before, ground)
        # Nothing was built on these.
        ts.undo(terrain, 9)
        ts.undo(terrain, 8)
        assert bits(terrain) == model(operations()[:7])
    with ts.Terrain(source()) as terrain, pytest.raises(InputError, match="has no store"):
        ts.undo(terrain, 1)


def test_an_undo_whose_reply_was_lost_may_come_again_at_any_time(path: Path) -> None:
    """Also when somebody has built on the place since; on another branch it is another undo."""
    with opened(path) as terrain:
        do(terrain, operations()[:2])
        first = ts.undo(terrain, 1, idem="back")
        edits_of(terrain).commit(operations()[2])
        ground = bits(terrain)
        again = ts.undo(terrain, 1, idem="back")
        assert (again.seq, again.repeated, again.ledger) == (first.seq, True, first.ledger)
        with pytest.raises(InputError, match="'back' stands for another operation, number 3"):
            ts.undo(terrain, 2, idem="back")
        assert bits(terrain) == ground
        edits_of(terrain).fork("other")
    with opened(path, "other") as terrain:
        with pytest.raises(InputError, match="operation 1 was taken back already by 3"):
            ts.undo(terrain, 1, idem="back")
        assert bits(terrain) == ground


def test_a_snapshot_a_branch_and_a_reset_hold_every_bit(path: Path) -> None:
    """Each goes its own way from there, detail included, and a reset brings it all back."""
    every = operations()
    with opened(path) as terrain:
        do(terrain, every[:5])
        edits_of(terrain).snapshot("five")
        edits_of(terrain).fork("other")
        do(terrain, every[5:])
        edits_of(terrain).snapshot("ten")
        assert bits(terrain) == model(every)
        ts.apply(terrain, [hill(detail=True)], wait=False)
        for name, done in (("five", 5), ("ten", 10), ("five", 5)):
            edits_of(terrain).reset(name)
            assert bits(terrain) == model(every[:done])
            assert ts.sample(terrain, [[50.0, 128.0]]).height[0] == pytest.approx(_height(done))
        do(terrain, every[5:7])
        assert bits(terrain) == model(every[:7])
        with pytest.raises(InputError, match="not in the journal"):
            ts.undo(terrain, 8)
    with opened(path, "other") as terrain:
        assert bits(terrain) == model(every[:5])
        do(terrain, every[7:9])
        assert bits(terrain) == model([*every[:5], *every[7:9]])
        edits_of(terrain).reset("ten")
        assert bits(terrain) == model(every)
        edits_of(terrain).reset(0)
        assert bits(terrain) == model([])
    with opened(path) as terrain:
        assert bits(terrain) == model(every[:7])
    assert verify(path)["sound"]


def _height(done: int) -> float:
    from terrasim.deform.window import read_window

    with ts.Terrain(source(), detail_factor=2) as terrain:
        do(terrain, operations()[:done])
        [[found]] = read_window(terrain, 2 * (256 + 256), 2 * 100, 1, 1, detail=True).tolist()
        return float(found) / 2e5


def counts(path: Path) -> dict[str, int]:
    """Rows of each table."""
    db = apsw.Connection(str(path), flags=apsw.SQLITE_OPEN_READONLY)
    try:
        found = {}
        for (name,) in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall():
            [[count]] = db.execute(f"SELECT count(*) FROM {name}").fetchall()
            found[str(name)] = int(str(count))
        return found
    finally:
        db.close()


@pytest.mark.parametrize("done", [1, 10])
def test_a_snapshot_a_reset_and_a_branch_cost_some_rows_and_no_block(path: Path, done: int) -> None:
    """However much was changed: one row each of what they are, and none of blobs or journal."""
    with opened(path) as terrain:
        do(terrain, operations()[:done])
        edits_of(terrain).checkpoint()
        steps = [counts(path)]
        edits_of(terrain).snapshot("here")
        steps.append(counts(path))
        edits_of(terrain).fork("other")
        steps.append(counts(path))
        edits_of(terrain).reset(0)
        steps.append(counts(path))
        edits_of(terrain).reset("here")
        steps.append(counts(path))
    grown = [
        {name: two[name] - one[name] for name in two if two[name] != one[name]}
        for one, two in pairwise(steps)
    ]
    moved = {"epoch": 1, "checkpoint": 1}
    assert grown == [{"snapshot": 1}, {"branch": 1, **moved}, moved, moved]


def test_who_asks_for_detail_while_all_is_forgotten_leaves_no_old_answer() -> None:
    """A loader's thread may be asking the source when a reset comes."""
    asked, goes_on = threading.Event(), threading.Event()
    key, old = ts.Block(0, 0, 0), ts.Block(-1, 2, 0)

    class Slow(ts.ArraySource):
        detail_factor = 2

        def details(self, key: ts.Block) -> list[ts.Block]:
            if asked.is_set():
                return []
            asked.set()
            goes_on.wait()
            return [old]

    slow = Slow(np.zeros((600, 600), np.int32), ts.Grid(600, 600, 1.0))
    ground = Ground(slow, DetailGrid(slow.grid, 2))
    thread = threading.Thread(target=ground.details, args=(key,))
    thread.start()
    asked.wait()
    ground.clear()
    goes_on.set()
    thread.join()
    assert ground.details(key) == []


def test_an_undo_of_many_patches_on_one_post_leaves_no_detail(path: Path) -> None:
    """What is zero again is no block, neither in the pool nor in the store."""
    ones = np.ones((1, 1), np.int32)
    with opened(path) as terrain:
        for amount in (5, -7, 11):
            edits_of(terrain).commit(Patch(1024, 100, amount * ones, detail=True))
        edits_of(terrain).checkpoint()
        for seq in (2, 3, 1):
            ts.undo(terrain, seq)
        keys = list(bits(terrain))
        assert all(key.level >= 0 for key in keys)
        assert not any(terrain.ground.details(key) for key in keys if key.level == 0)
    with opened(path) as terrain:
        assert bits(terrain) == model([])
        edits_of(terrain).commit(Stamping((hill(),)))
