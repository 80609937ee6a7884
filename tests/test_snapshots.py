"""A snapshot is a state for good; a reset goes back to one, and what was dropped stays dropped."""

from __future__ import annotations

from pathlib import Path

import pytest
from stored import FAR, NEAR, alter, build, changed, detail, same, source

from terrasim.errors import InputError
from terrasim.grid import Block
from terrasim.store.branch import Branch, open_branch
from terrasim.store.codec import StoreCorrupt
from terrasim.store.info import info
from terrasim.store.names import branches, snapshots
from terrasim.store.store import open_snapshot, open_store
from terrasim.store.verify import verify


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A store."""
    return build(tmp_path / "hill.store")


def change(branch: Branch, key: Block, seed: int) -> int:
    """Change a block; returns the operation's number."""
    seq = branch.append(b"%d" % seed)
    branch.checkpoint({key: changed(source(), key, seed)}, seq)
    return seq


def test_a_snapshot_stays_what_it_was(path: Path) -> None:
    """Whatever comes after, read beside the branch."""
    with open_branch(path) as branch:
        change(branch, NEAR, 1)
        branch.snapshot("one")
        change(branch, NEAR, 2)
        change(branch, FAR, 3)
        branch.snapshot("two")
        change(branch, FAR, 4)
        with open_snapshot(path, "one") as one, open_snapshot(path, "two") as two:
            assert same(one.block(NEAR), changed(source(), NEAR, 1))
            assert same(one.block(FAR), source().block(FAR))
            assert same(two.block(NEAR), changed(source(), NEAR, 2))
            assert same(two.block(FAR), changed(source(), FAR, 3))
    assert [(one.name, one.seq, one.branch) for one in snapshots(path).values()] == [
        ("one", 1, "main"),
        ("two", 3, "main"),
    ]
    assert [(one.name, one.seq) for one in branches(path).values()] == [("main", 4)]
    said = info(path)
    assert [one["name"] for one in said["snapshots"]] == ["one", "two"]
    assert [one["name"] for one in said["branches"]] == ["main"]


def test_a_snapshot_is_of_all_that_was_acknowledged(path: Path) -> None:
    """Rows that no checkpoint holds have no images: they are named in the refusal."""
    with open_branch(path) as branch:
        branch.append(b"waits")
        with pytest.raises(InputError, match="operations 1 to 1 after its newest checkpoint"):
            branch.snapshot("one")
        with pytest.raises(InputError, match="operations 1 to 1"):
            branch.fork("dev")
        branch.checkpoint({}, 1)
        branch.snapshot("one")
        with pytest.raises(InputError, match="a snapshot 'one' already"):
            branch.snapshot("one")


def test_a_reset_brings_the_state_back_and_what_was_dropped_never_returns(path: Path) -> None:
    """Not when the same blocks are written again, not when the store is opened again."""
    with open_branch(path) as branch:
        branch.set_detail_factor(2)
        change(branch, NEAR, 1)
        branch.checkpoint({Block(-1, 2, 1): detail(5)}, 1)
        branch.snapshot("one")
        change(branch, NEAR, 2)
        change(branch, FAR, 3)
        branch.checkpoint({Block(-1, 2, 1): None, Block(-1, 3, 1): detail(6)}, 3)
        branch.append(b"never in a checkpoint")
        branch.reset("one")
        _is_as_at_one(branch)
        branch.append(b"on")
        assert [row.seq for row in branch.rows()] == [1, 5]
        branch.reset("one")
    with open_branch(path) as branch:
        _is_as_at_one(branch)
        assert change(branch, FAR, 9) == 6
        assert [row.seq for row in branch.history()] == [6, 1]
        assert same(branch.block(NEAR), changed(source(), NEAR, 1))
    assert verify(path)["sound"]


def _is_as_at_one(branch: Branch) -> None:
    assert same(branch.block(NEAR), changed(source(), NEAR, 1))
    assert same(branch.block(FAR), source().block(FAR))
    assert branch.details(NEAR) == [Block(-1, 2, 1)]
    assert list(branch.pending()) == []
    assert [row.seq for row in branch.rows()] == [1]
    assert branch.last_seq == branch.checkpoint_seq


def test_a_reset_goes_to_any_checkpoint_of_the_history(path: Path) -> None:
    """By the operation it comes after, also one of an earlier epoch; dropped ones are none."""
    with open_branch(path) as branch:
        for seed in range(1, 6):
            change(branch, NEAR, seed)
        branch.reset(2)
        assert same(branch.block(NEAR), changed(source(), NEAR, 2))
        with pytest.raises(InputError, match="no checkpoint after operation 4 on this branch"):
            branch.reset(4)
        assert change(branch, NEAR, 7) == 6
        branch.reset(1)
        assert same(branch.block(NEAR), changed(source(), NEAR, 1))
        branch.reset(0)
        assert same(branch.block(NEAR), source().block(NEAR))
        assert branch.history() == []
        with pytest.raises(InputError, match="no snapshot 'x'; the store has none"):
            branch.reset("x")


def test_a_reset_costs_a_few_rows_however_much_was_changed(path: Path) -> None:
    """One epoch, one checkpoint; no blob is written."""
    with open_branch(path) as branch:
        keys = [Block(level, row, col) for level in (0, 1) for row in (-1, 0) for col in (0, 1)]
        keys = [key for key in keys if key.level == 0 or key.col == 0]
        branch.checkpoint({key: changed(source(), key, 3) for key in keys}, 0)
        branch.snapshot("all")
        branch.checkpoint({key: changed(source(), key, 4) for key in keys}, 0)
    before = verify(path)
    with open_branch(path) as branch:
        branch.reset("all")
    after = verify(path)
    grown = {key: after[key] - before[key] for key in ("blobs", "epochs", "checkpoints")}
    assert grown == {"blobs": 0, "epochs": 1, "checkpoints": 1}


def test_a_snapshot_may_be_of_another_branch(path: Path) -> None:
    """A branch begins at one and goes back to one, whosever it is."""
    with open_branch(path) as branch:
        change(branch, NEAR, 1)
        branch.snapshot("one")
        branch.fork("dev", at="one")
        change(branch, NEAR, 2)
        branch.snapshot("two")
    with open_branch(path, "dev") as dev:
        assert same(dev.block(NEAR), changed(source(), NEAR, 1))
        dev.reset("two")
        assert same(dev.block(NEAR), changed(source(), NEAR, 2))
        dev.drop_snapshot("two")
        assert sorted(dev.snapshots()) == ["one"]
        with pytest.raises(InputError, match="no snapshot 'two'; the store has one"):
            dev.drop_snapshot("two")
    with pytest.raises(InputError, match="no snapshot"):
        open_snapshot(path, "two")
    with pytest.raises(InputError, match="a branch or a snapshot"):
        open_store(path, branch="dev", snapshot="one")
    with open_store(path, branch="dev") as store:
        assert same(store.block(NEAR), changed(source(), NEAR, 2))


@pytest.mark.parametrize(
    "sql",
    [
        "DELETE FROM snapshot",
        "DELETE FROM branch WHERE name = 'dev'",
        "DELETE FROM branch WHERE name = 'main'",
        "UPDATE snapshot SET checkpoint = 1",
        "UPDATE branch SET checkpoint = 1",
        "UPDATE checkpoint SET root = x''",
        "UPDATE checkpoint SET id = id + 10",
        "UPDATE epoch SET cut = cut + 1",
        "DELETE FROM epoch",
        "DELETE FROM checkpoint",
        "DELETE FROM state",
        "UPDATE state SET factor = 2",
        "DELETE FROM blob WHERE codec = 2",
        "UPDATE blob SET data = substr(data, 1, 20) WHERE codec = 2",
        "DELETE FROM blob WHERE id = (SELECT max(id) FROM blob WHERE codec = 1)",
    ],
)
def test_a_lost_or_altered_row_never_shows_an_earlier_state(path: Path, sql: str) -> None:
    """Each read is right or refused; verification says so too."""
    with open_branch(path) as branch:
        change(branch, NEAR, 1)
        branch.snapshot("one")
        branch.fork("dev")
        change(branch, NEAR, 2)
    assert alter(path, sql) > 0
    assert not verify(path)["sound"]
    with pytest.raises(StoreCorrupt):  # noqa: PT012 whichever of them
        with open_branch(path) as branch:
            assert same(branch.block(NEAR), changed(source(), NEAR, 2))
            list(branch.rows())
            branch.reset("one")
            assert same(branch.block(NEAR), changed(source(), NEAR, 1))
        with open_branch(path, "dev") as dev:
            list(dev.rows())
            assert same(dev.block(NEAR), changed(source(), NEAR, 1))
