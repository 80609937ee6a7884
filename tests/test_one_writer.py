"""A store has one writer: a second is refused at once, and a dead one holds nobody up."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest
from stored import ENDINGS, build, changed, same
from stored import NEAR as KEY

from terrasim.errors import RunError
from terrasim.store.backup import backup
from terrasim.store.branch import Branch, open_branch
from terrasim.store.history import history
from terrasim.store.store import open_store
from terrasim.store.verify import verify

REFUSED_IN_S = 1.0
HEAD = """
import os, sys, time
from pathlib import Path
from terrasim.errors import RunError
from terrasim.store.branch import open_branch
from terrasim.store.store import open_store
path = Path(sys.argv[1])
"""
HOLD = """
branch = open_branch(path)
branch.append(b"one")
print("held", flush=True)
sys.stdin.read()
"""
TRY = """
begun = time.perf_counter()
try:
    open_branch(path).append(b"mine")
except RunError as error:
    print(time.perf_counter() - begun, error)
"""
FORK = """
branch = open_branch(path)
branch.append(b"one")
child = os.fork()
if child == 0:
    try:
        branch.append(b"child")
    except RunError as error:
        said = str(error)
    branch.close()
    os._exit(0 if "in another process" in said else 1)
assert os.waitpid(child, 0)[1] == 0
branch.append(b"two")
print("held", flush=True)
sys.stdin.readline()
if os.fork() == 0:
    sys.stdin.read()
    os._exit(0)
branch.close()
print("closed", flush=True)
sys.stdin.read()
"""
TAKE_TURNS = """
for turn in range(12):
    while True:
        try:
            with open_branch(path) as branch:
                branch.append(sys.argv[2].encode() + b"-%d" % turn)
            break
        except RunError as error:
            assert "already" in str(error), error
"""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A store."""
    return build(tmp_path / "ground.store")


def start(code: str, path: Path, *words: str) -> subprocess.Popen[str]:
    """Another process."""
    return subprocess.Popen(
        [sys.executable, "-c", HEAD + code, str(path), *words],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )


@contextmanager
def other(code: str, path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another process that has the store; it ends with the block."""
    process = start(code, path)
    try:
        assert line(process) == "held"
        yield process
    finally:
        process.kill()
        process.communicate()


def line(process: subprocess.Popen[str]) -> str:
    """The next line that a process says."""
    assert process.stdout is not None
    return process.stdout.readline().strip()


def refused(path: Path) -> float:
    """Try to write; returns how long it took to be refused [s]."""
    begun = time.perf_counter()
    with pytest.raises(RunError, match=r"open for writing already; .*one writer: close it first"):
        open_branch(path)
    return time.perf_counter() - begun


def files(path: Path) -> list[bytes]:
    """What a store's files hold."""
    names = [path.with_name(path.name + ending) for ending in ENDINGS]
    return [name.read_bytes() for name in names if name.exists()]


def test_a_second_writer_is_refused_at_once(path: Path) -> None:
    """Here and in another process, however often it tries; the first does not notice."""
    with open_branch(path) as branch:
        branch.append(b"one")
        before = files(path)
        assert min(refused(path) for _ in range(3)) < REFUSED_IN_S
        tried = [start(TRY, path) for _ in range(2)]
        for process in tried:
            said, _ = process.communicate()
            assert float(said.split()[0]) < REFUSED_IN_S, said
            assert "open for writing already" in said
        assert files(path) == before
        assert branch.append(b"two") == 2
        assert min(refused(path) for _ in range(2)) < REFUSED_IN_S
    assert [row.op for row in history(path)] == [b"two", b"one"]
    assert verify(path)["sound"]


def test_readers_do_not_mind_a_writer(path: Path, tmp_path: Path) -> None:
    """They see what it has checkpointed, and it goes on while they have the store open."""
    with open_branch(path) as branch, open_store(path) as early:
        new = changed(branch, KEY, 1)
        branch.append(b"one")
        branch.checkpoint({KEY: new}, 1)
        with open_store(path) as late:
            assert same(late.block(KEY), new)
            assert not same(early.block(KEY), new)
            branch.append(b"two")
            assert [row.op for row in history(path)] == [b"two", b"one"]
            assert verify(path)["sound"]
            assert backup(path, tmp_path / "copy")["sound"]
    with other(HOLD, path):
        with open_store(path) as store:
            assert same(store.block(KEY), new)
        assert history(path)[0].op == b"one"


def test_a_killed_writer_holds_nobody_up(path: Path) -> None:
    """The lock goes with the process, and what it acknowledged is there."""
    with other(HOLD, path) as process:
        assert refused(path) < REFUSED_IN_S
        process.kill()
        process.wait()
        with open_branch(path) as branch:
            assert [row.op for row in branch.rows()] == [b"one"]
            assert branch.append(b"two") == 2
    assert verify(path)["sound"]


def test_a_forked_child_neither_writes_nor_lets_go_nor_holds_on(path: Path) -> None:
    """The branch and its lock are the parent's, as long as it has them open and no longer."""
    with other(FORK, path) as process:
        assert refused(path) < REFUSED_IN_S
        assert process.stdin is not None
        print(file=process.stdin, flush=True)
        assert line(process) == "closed"
        with open_branch(path) as branch:
            assert [row.op for row in branch.rows()] == [b"one", b"two"]
    assert verify(path)["sound"]


def test_of_many_that_come_at_once_one_is_let_in(path: Path) -> None:
    """And it is the only one."""

    def attempt(_: int) -> Branch | None:
        try:
            return open_branch(path)
        except RunError:
            return None

    with ThreadPoolExecutor(6) as pool:
        opened = [branch for branch in pool.map(attempt, range(6)) if branch is not None]
    assert len(opened) == 1
    assert opened[0].append(b"one") == 1
    opened[0].close()


def test_writers_that_take_turns_lose_nothing(path: Path) -> None:
    """Each opens and closes the store again and again, and waits for the others."""
    processes = [start(TAKE_TURNS, path, name) for name in "abc"]
    for process in processes:
        process.communicate()
        assert process.returncode == 0
    rows = history(path, limit=100)
    assert {row.op for row in rows} == {b"%c-%d" % (c, k) for c in b"abc" for k in range(12)}
    assert len(rows) == 36
    report = verify(path)
    assert report["sound"], report["problems"]
    assert [one.name for one in path.parent.iterdir()] == [path.name]
