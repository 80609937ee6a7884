"""What is written on a branch is there, and nothing else is."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
from stored import (
    FAR,
    GRID,
    NEAR,
    FailingVFS,
    broken_disk,
    build,
    changed,
    detail,
    full_disk,
    killed,
    same,
    source,
    well,
)

from terrasim.counts import HOLE
from terrasim.errors import InputError, RunError
from terrasim.grid import Block
from terrasim.sources.source import BlockData, describe
from terrasim.store.branch import Branch, open_branch
from terrasim.store.store import open_store
from terrasim.store.verify import verify


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A store."""
    return build(tmp_path / "hill.store")


def write(branch: Branch, blocks: dict[Block, BlockData | None], op: bytes = b"op") -> int:
    """An operation and its images; returns its number."""
    seq = branch.append(op)
    branch.checkpoint(blocks, seq)
    return seq


def test_an_untouched_branch_is_the_imported_terrain(path: Path) -> None:
    """Blocks of all levels, posts, placement."""
    with open_branch(path) as branch:
        assert (branch.grid, branch.detail_factor, branch.last_seq) == (GRID, 1, 0)
        for key in (NEAR, FAR, Block(1, 0, 0), Block(1, -1, 0)):
            assert same(branch.block(key), source().block(key))
        rows, cols = np.arange(-50, 300), np.arange(0, 300)
        np.testing.assert_array_equal(branch.posts(0, rows, cols), source().posts(0, rows, cols))


def test_a_checkpoint_is_read_by_the_branch_and_by_whoever_opens_the_store(path: Path) -> None:
    """The changed blocks with their numbers; all others as they were."""
    with open_branch(path) as branch:
        before = open_store(path)
        new = changed(branch, NEAR, 1)
        write(branch, {NEAR: new, Block(1, 0, 0): changed(branch, Block(1, 0, 0), 2)})
        assert same(branch.block(NEAR), new)
        assert same(branch.block(FAR), source().block(FAR))
        with open_store(path) as store:
            assert same(store.block(NEAR), new)
            at = np.arange(0, 256)
            np.testing.assert_array_equal(store.posts(0, at, at), new.posts)
        assert same(before.block(NEAR), source().block(NEAR))
        before.close()
    with open_branch(path) as branch:
        assert same(branch.block(NEAR), new)
    assert verify(path)["sound"]


def test_a_block_may_change_in_any_way(path: Path) -> None:
    """New holes, filled ones, the range's ends, other numbers alone."""
    posts = source().block(NEAR).posts.copy()
    posts[0, :3] = HOLE, 2**31 - 1, -(2**31) + 1
    posts[60 - 40, 40] = 5
    for data in (describe(posts, 9), BlockData(source().block(NEAR).posts, -9, 9, 3)):
        with open_branch(path) as branch:
            write(branch, {NEAR: data})
            assert same(branch.block(NEAR), data)


def test_ground_that_is_as_it_was_costs_nothing(path: Path) -> None:
    """Back to the import's heights: the tree is empty again; the same image twice is one."""
    with open_branch(path) as branch:
        first = branch.checkpoint({NEAR: changed(branch, NEAR, 1)}, 0)
        again = branch.checkpoint({NEAR: branch.block(NEAR)}, 0)
        assert (first.blocks, again.blocks, again.root) == (1, 0, first.root)
        back = branch.checkpoint({NEAR: source().block(NEAR)}, 0)
        assert (back.blocks, back.root) == (1, b"")
        assert same(branch.block(NEAR), source().block(NEAR))


def test_detail_blocks_are_listed_by_the_base_block_they_lie_in(path: Path) -> None:
    """As long as they are not zero; what was never written is zero."""
    with open_branch(path) as branch:
        branch.set_detail_factor(4)
        inside, outside = Block(-1, 7, 3), Block(-1, 3, 4)
        write(branch, {inside: detail(1), outside: detail(2)})
        assert branch.details(NEAR) == [inside]
        assert branch.details(FAR) == [outside]
        assert branch.details(Block(0, -1, 0)) == []
        assert same(branch.block(inside), detail(1))
        assert not branch.block(Block(-1, 6, 3)).posts.any()
        write(branch, {inside: None, outside: describe(np.zeros((256, 256), np.int32), 0)})
        assert branch.details(NEAR) == branch.details(FAR) == []
        assert not branch.block(inside).posts.any()
    with open_store(path) as store:
        assert store.detail_factor == 4


def test_the_detail_factor_stays_while_anything_goes_by_it(path: Path) -> None:
    """Blocks of an earlier checkpoint, rows that wait; numbers out of range are refused."""
    with open_branch(path) as branch:
        for bad in (0, -2, 1.5, True, 2**22):
            with pytest.raises(InputError, match="detail factor"):
                branch.set_detail_factor(bad)  # type: ignore[arg-type]
        branch.set_detail_factor(8)
        branch.append(b"waits")
        with pytest.raises(InputError, match="operations wait"):
            branch.set_detail_factor(4)
        branch.checkpoint({Block(-1, 0, 0): detail(1)}, 1)
        with pytest.raises(InputError, match="detail blocks of factor 8, got 4"):
            branch.set_detail_factor(4)
        branch.set_detail_factor(8)
    with open_branch(path) as branch:
        assert branch.detail_factor == 8


@pytest.mark.parametrize(
    ("key", "data"),
    [
        (Block(0, 5, 0), detail(0)),
        (Block(-1, 0, 0), detail(0)),
        (Block(-2, 0, 0), detail(0)),
        (Block(9, 0, 0), detail(0)),
        (NEAR, None),
        (NEAR, BlockData(np.zeros((255, 256), np.int32), 0, 0, 0)),
        (NEAR, BlockData(np.zeros((256, 256), np.int64), 0, 0, 0)),
    ],
)
def test_what_is_no_block_of_the_terrain_is_refused(
    path: Path, key: Block, data: BlockData | None
) -> None:
    """And the state stays as it was."""
    with open_branch(path) as branch:
        with pytest.raises(InputError):
            branch.checkpoint({FAR: changed(branch, FAR, 1), key: data}, 0)
        assert same(branch.block(FAR), source().block(FAR))


def test_a_checkpoint_never_goes_back_nor_ahead(path: Path) -> None:
    """Its number lies between the last one's and the newest row's."""
    with open_branch(path) as branch:
        write(branch, {}), write(branch, {})
        for seq in (1, 3):
            with pytest.raises(InputError, match="after operation 2 to 2"):
                branch.checkpoint({}, seq)


def test_a_second_writer_is_refused_and_readers_are_not(path: Path) -> None:
    """In the same process and in another; when the first is gone the next may come."""
    code = f"from terrasim.store.branch import open_branch; open_branch({str(path)!r})"
    with open_branch(path) as branch:
        with pytest.raises(RunError, match="open for writing already"):
            open_branch(path)
        other = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=False
        )
        assert "open for writing already" in other.stderr
        write(branch, {NEAR: changed(branch, NEAR, 1)})
        with open_store(path) as store:
            assert same(store.block(NEAR), branch.block(NEAR))
    open_branch(path).close()
    assert [one.name for one in path.parent.iterdir()] == [path.name]


def test_rows_are_written_while_a_checkpoint_is(path: Path) -> None:
    """From two threads, with readers: none is lost and each read is of one state."""
    with open_branch(path) as branch, ThreadPoolExecutor(4) as pool:
        images = [
            {NEAR: changed(source(), NEAR, k), FAR: changed(source(), FAR, k)} for k in range(6)
        ]
        known = {image[NEAR].posts.tobytes() for image in images}
        known.add(source().block(NEAR).posts.tobytes())
        stop = threading.Event()

        def read() -> bool:
            right = True
            while not stop.is_set():
                right &= branch.block(NEAR).posts.tobytes() in known
            return right

        readers = [pool.submit(read) for _ in range(2)]
        rows = pool.submit(lambda: [branch.append(b"row %d" % k) for k in range(200)])
        for image in images:
            branch.checkpoint(image, branch.checkpoint_seq)
        assert rows.result(60) == list(range(1, 201))
        stop.set()
        assert all(one.result(60) for one in readers)
        assert [seq for seq, _, _ in branch.pending()] == list(range(1, 201))
    assert verify(path)["sound"]


def test_a_killed_writer_leaves_what_it_acknowledged(path: Path, tmp_path: Path) -> None:
    """The newest checkpoint and the rows after it; a checkpoint under way leaves nothing."""
    with open_branch(path) as branch:
        new = changed(branch, NEAR, 1)
        write(branch, {NEAR: new})
        branch.append(b"after", engine="me")
        left = killed(path, tmp_path / "left")
    with open_branch(left) as branch:
        assert same(branch.block(NEAR), new)
        assert list(branch.pending()) == [(2, b"after", "me")]
        assert branch.append(b"more") == 3
    assert verify(left)["sound"]


def test_branches_go_their_own_ways(path: Path) -> None:
    """From the state in which one began."""
    with open_branch(path) as branch:
        first, second = changed(branch, NEAR, 1), changed(branch, NEAR, 2)
        write(branch, {NEAR: first})
        branch.fork("dev")
        write(branch, {NEAR: second})
    with open_branch(path, "dev") as dev:
        assert same(dev.block(NEAR), first)
        assert dev.append(b"mine") == 3
        assert [row.op for row in dev.rows()] == [b"op", b"mine"]
        dev.checkpoint({FAR: changed(dev, FAR, 3)}, 3)
        with pytest.raises(InputError, match="cannot be dropped"):
            dev.drop_branch("main")
    with open_branch(path) as branch:
        assert same(branch.block(NEAR), second)
        assert same(branch.block(FAR), source().block(FAR))
        assert [row.seq for row in branch.rows()] == [1, 2]
        assert sorted(branch.branches()) == ["dev", "main"]
        branch.drop_branch("dev")
        assert sorted(branch.branches()) == ["main"]
    with pytest.raises(InputError, match="no branch 'dev'; the store has main"):
        open_branch(path, "dev")
    with open_branch(path, "new", create=True) as new:
        assert same(new.block(NEAR), source().block(NEAR))
    with open_store(path) as store:
        assert same(store.block(NEAR), second)
    assert verify(path)["sound"]


@pytest.mark.parametrize("name", ["", "a b", "../up", "-x", "x" * 65, "é", "a\n"])
def test_a_name_is_a_plain_word(path: Path, name: str) -> None:
    """Of a branch and of a snapshot."""
    acts: list[Callable[[Branch], object]] = [lambda b: b.fork(name), lambda b: b.snapshot(name)]
    with open_branch(path) as branch:
        for act in acts:
            with pytest.raises(InputError, match="a name is"):
                act(branch)
    with pytest.raises(InputError, match="a name is"):
        open_branch(path, name, create=True)


def test_a_full_disk_refuses_and_goes_on_when_there_is_room(path: Path, tmp_path: Path) -> None:
    """No row, no image; what was there is read meanwhile."""
    vfs = FailingVFS("full")
    with open_branch(path, vfs="full") as branch:
        branch.append(b"one")
        vfs.fail = full_disk
        with pytest.raises(RunError, match="the disk is full; make room"):
            branch.append(b"two")
        with pytest.raises(RunError, match="the disk is full"):
            branch.checkpoint({NEAR: changed(branch, NEAR, 1)}, 1)
        assert same(branch.block(NEAR), source().block(NEAR))
        vfs.fail = well
        assert branch.append(b"three") == 2
        assert [op for _, op, _ in branch.pending()] == [b"one", b"three"]
        left = killed(path, tmp_path / "left")
    assert verify(left)["sound"]
    vfs.unregister()


@pytest.mark.parametrize("method", ["sync", "write"])
def test_after_the_disk_failed_nothing_is_written_until_reopened(
    path: Path, tmp_path: Path, method: str
) -> None:
    """What was not acknowledged is not there then; what was is."""
    vfs = FailingVFS(f"broken-{method}")
    with open_branch(path, vfs=f"broken-{method}") as branch:
        branch.append(b"one")
        vfs.fail = broken_disk(method, "-wal")
        with pytest.raises(RunError, match="cannot be written"):
            branch.append(b"two")
        vfs.fail = well
        with pytest.raises(RunError, match="reopen"):
            branch.append(b"three")
        with pytest.raises(RunError, match="reopen"):
            branch.checkpoint({NEAR: changed(branch, NEAR, 1)}, 1)
        assert same(branch.block(NEAR), source().block(NEAR))
        branch.reopen()
        assert [op for _, op, _ in branch.pending()] == [b"one"]
        assert branch.append(b"four") == 2
        left = killed(path, tmp_path / "left")
    with open_branch(left) as branch:
        assert [op for _, op, _ in branch.pending()] == [b"one", b"four"]
    assert verify(left)["sound"]
    vfs.unregister()


def test_a_disk_that_fails_at_any_call_loses_nothing_acknowledged(
    path: Path, tmp_path: Path
) -> None:
    """The k-th write or sync fails; afterwards, in the same process or a new one, all is there."""
    vfs = FailingVFS("kth")
    for k in range(0, 40, 3):
        method = "sync" if k % 2 else "write"
        here = killed(path, tmp_path / f"{k}")
        acknowledged: list[bytes] = []
        with open_branch(here, vfs="kth") as branch:
            vfs.fail = broken_disk(method, "", k // 2)
            for number in range(8):
                try:
                    branch.append(b"%d" % number, idem=str(number))
                    acknowledged.append(b"%d" % number)
                    if number == 4:
                        branch.checkpoint({NEAR: changed(branch, NEAR, 1)}, branch.last_seq)
                except RunError:
                    vfs.fail = well
                    left = killed(here, tmp_path / f"{k}-{number}")
                    with open_branch(left) as after:
                        found = [row.op for row in after.rows()]
                        assert found[: len(acknowledged)] == acknowledged
                        assert len(found) <= len(acknowledged) + 1
                    branch.reopen()
                    assert [row.op for row in branch.rows()] == acknowledged
        vfs.fail = well
        assert verify(here)["sound"]
    vfs.unregister()
