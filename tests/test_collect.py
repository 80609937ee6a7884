"""Collecting deletes what has no name, and nothing else."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from stored import FAR, NEAR, alter, build, killed, same, source

from terrasim.counts import HOLE
from terrasim.errors import RunError
from terrasim.sources.source import BlockData, describe
from terrasim.store.branch import Branch, open_branch
from terrasim.store.codec import StoreCorrupt
from terrasim.store.collect import collect
from terrasim.store.edited import Collected
from terrasim.store.store import open_store
from terrasim.store.verify import verify


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A store."""
    return build(tmp_path / "hill.store")


def image(seed: int) -> BlockData:
    """A block as some operation leaves it: noise, so that its blob takes room."""
    posts = source().block(NEAR).posts.copy()
    posts[posts != HOLE] += np.random.default_rng(seed).integers(0, 999, posts.shape)[posts != HOLE]
    return describe(posts, 0)


def change(branch: Branch, seed: int) -> None:
    """An operation with its image."""
    branch.checkpoint({NEAR: image(seed)}, branch.append(b"%d" % seed))


def test_what_has_a_name_stays_and_all_else_goes(path: Path) -> None:
    """Heads and snapshots read as before; nothing unused is left, and the file is smaller."""
    with open_branch(path) as branch:
        for seed in range(12):
            change(branch, seed)
            if seed == 4:
                branch.snapshot("four")
            if seed == 6:
                branch.fork("dev")
            if seed == 8:
                branch.reset("four")
    size = path.stat().st_size
    done = collect(path)
    assert done["checkpoints"] >= 8
    assert done["blobs"] > 0
    assert done["rows"] == 2
    assert path.stat().st_size == size - done["bytes"] < size
    with open_store(path) as main, open_store(path, snapshot="four") as four:
        assert same(main.block(NEAR), image(11))
        assert same(four.block(NEAR), image(4))
    with open_store(path, branch="dev") as dev:
        assert same(dev.block(NEAR), image(6))
    with open_branch(path) as branch:
        assert b"".join(row.op for row in branch.rows()) == b"0123491011"
        branch.reset("four")
        assert same(branch.block(NEAR), image(4))
    found = verify(path)
    assert (found["sound"], found["unused_rows"], found["problems"]) == (True, 0, [])
    collect(path)
    assert verify(path)["unused_blobs"] == 0
    assert not any(collect(path).values())


def test_imported_blocks_stay(path: Path) -> None:
    """Also those whose bytes a changed block shares."""
    with open_branch(path) as branch:
        branch.checkpoint({NEAR: source().block(FAR)}, 0)
        branch.checkpoint({NEAR: source().block(NEAR)}, 0)
        collect(branch)
        assert same(branch.block(NEAR), source().block(NEAR))
    assert verify(path)["sound"]
    assert verify(path)["unused_blobs"] == 0


def test_one_who_reads_a_dropped_state_is_told(path: Path) -> None:
    """Never other heights; the branch itself reads on in its newest state."""
    with open_branch(path) as branch:
        change(branch, 1)
        reader = open_store(path)
        change(branch, 2)
        assert same(reader.block(NEAR), image(1))
        collect(branch)
        with pytest.raises(Collected, match="dropped and collected; open the store again"):
            reader.block(NEAR)
        assert same(branch.block(NEAR), image(2))
        reader.close()
    assert issubclass(Collected, RunError)


def test_readers_rows_and_checkpoints_go_on_while_it_collects(path: Path) -> None:
    """Each read is of one committed state."""
    with open_branch(path) as branch, ThreadPoolExecutor(3) as pool:
        known = {image(seed).posts.tobytes() for seed in range(25)}
        known.add(source().block(NEAR).posts.tobytes())
        stop = threading.Event()

        def read() -> bool:
            right = True
            while not stop.is_set():
                right &= branch.block(NEAR).posts.tobytes() in known
            return right

        def write() -> None:
            for seed in range(25):
                change(branch, seed)

        reader, writer = pool.submit(read), pool.submit(write)
        while not writer.done():
            collect(branch)
        writer.result()
        stop.set()
        assert reader.result(60)
        assert same(branch.block(NEAR), image(24))
    assert verify(path)["sound"]


def test_a_store_that_is_killed_while_it_collects_is_whole(path: Path, tmp_path: Path) -> None:
    """After each of its transactions."""
    with open_branch(path) as branch:
        for seed in range(6):
            change(branch, seed)
        branch.snapshot("keep")
        change(branch, 7)
        branch.reset(3)
        writer = branch.writer
        left: list[Path] = []
        note = writer._write_note

        def copy() -> None:
            note()
            left.append(killed(path, tmp_path / f"left-{len(left)}"))

        writer._write_note = copy  # type: ignore[method-assign]
        collect(branch)
        writer._write_note = note  # type: ignore[method-assign]
    assert len(left) >= 4
    for one in left:
        assert verify(one)["sound"]
        collect(one)
        found = verify(one)
        assert (found["sound"], found["unused_blobs"], found["unused_rows"]) == (True, 0, 0)
        with open_store(one) as store, open_store(one, snapshot="keep") as keep:
            assert same(store.block(NEAR), image(2))
            assert same(keep.block(NEAR), image(5))


def test_nothing_is_deleted_while_something_is_missing(path: Path) -> None:
    """A tree that cannot be walked would make its blobs look unused."""
    with open_branch(path) as branch:
        change(branch, 1)
        branch.snapshot("one")
        change(branch, 2)
    blobs = verify(path)["blobs"]
    with open_branch(path) as branch:
        root = branch.snapshots()["one"].seq
    assert root == 1
    assert alter(path, "DELETE FROM blob WHERE id = (SELECT min(id) FROM blob WHERE codec = 2)")
    with pytest.raises(StoreCorrupt, match="missing"):
        collect(path)
    assert verify(path)["blobs"] == blobs - 1
