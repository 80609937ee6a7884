"""A backup is the store at one moment, whole and checked, whoever writes meanwhile."""

from __future__ import annotations

import threading
from pathlib import Path

import pytest
from stored import FAR, NEAR, alter, build, changed, same, source

from terrasim.errors import InputError
from terrasim.store.backup import backup
from terrasim.store.branch import open_branch
from terrasim.store.codec import StoreCorrupt
from terrasim.store.store import open_store


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A store."""
    return build(tmp_path / "hill.store")


def test_a_store_in_use_is_copied_with_what_is_only_in_its_log(path: Path, tmp_path: Path) -> None:
    """Images, rows that wait, snapshots; then both go their own ways."""
    target = tmp_path / "copy.store"
    told: list[float] = []
    with open_branch(path) as branch:
        branch.checkpoint({NEAR: changed(branch, NEAR, 1)}, branch.append(b"one"))
        branch.snapshot("one")
        branch.append(b"two")
        found = backup(path, target, progress=lambda fraction, _: told.append(fraction))
        branch.checkpoint({NEAR: changed(branch, NEAR, 2)}, branch.append(b"three"))
    assert (found["sound"], found["journal_rows"], told[-1]) == (True, 2, 1.0)
    with open_branch(target) as copy:
        assert [op for _, op, _ in copy.pending()] == [b"two"]
        assert same(copy.block(NEAR), changed(source(), NEAR, 1))
        assert sorted(copy.snapshots()) == ["one"]
        assert copy.append(b"other") == 3
    assert sorted(one.name for one in tmp_path.iterdir()) == ["copy.store", "hill.store"]


def test_it_is_of_one_moment_while_rows_come_in(path: Path, tmp_path: Path) -> None:
    """All rows up to some one."""
    with open_branch(path) as branch:
        stop = threading.Event()

        def write() -> None:
            number = 0
            while not stop.is_set():
                branch.append(b"%d" % number)
                number += 1

        writer = threading.Thread(target=write)
        writer.start()
        sizes = []
        for number in range(3):
            backup(path, tmp_path / f"copy-{number}")
            with open_branch(tmp_path / f"copy-{number}") as copy:
                ops = [row.op for row in copy.rows()]
            assert ops == [b"%d" % k for k in range(len(ops))]
            sizes.append(len(ops))
        stop.set()
        writer.join()
    assert sizes == sorted(sizes)


def test_a_damaged_store_gives_no_backup(path: Path, tmp_path: Path) -> None:
    """What is at the target stays."""
    target = tmp_path / "copy.store"
    backup(path, target)
    before = target.read_bytes()
    alter(path, "UPDATE blob SET data = zeroblob(40) WHERE id = 2")
    with pytest.raises(StoreCorrupt, match="not sound: blob 2 is damaged"):
        backup(path, target, replace=True)
    assert target.read_bytes() == before
    assert sorted(one.name for one in tmp_path.iterdir()) == ["copy.store", "hill.store"]


def test_a_target_is_not_overwritten_by_accident(path: Path, tmp_path: Path) -> None:
    """Not the store itself, not another file; a store on demand."""
    with pytest.raises(InputError, match="the store itself"):
        backup(path, path, replace=True)
    (tmp_path / "text").write_text("mine")
    with pytest.raises(InputError, match="exists"):
        backup(path, tmp_path / "text")
    with pytest.raises(InputError, match="no terrasim store"):
        backup(path, tmp_path / "text", replace=True)
    assert (tmp_path / "text").read_text() == "mine"
    with pytest.raises(InputError, match="there is no store"):
        backup(tmp_path / "none", tmp_path / "copy")
    backup(path, tmp_path / "copy")
    with open_branch(path) as branch:
        branch.checkpoint({FAR: changed(branch, FAR, 1)}, 0)
    backup(path, tmp_path / "copy", replace=True)
    with open_store(tmp_path / "copy") as copy:
        assert same(copy.block(FAR), changed(source(), FAR, 1))
