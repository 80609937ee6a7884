"""Disks that fail in the middle of anything: nothing false is acknowledged, and it goes on."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import pytest
from faulty_disk import Fault, FaultyVFS
from soak import SOAKING
from store_play import State, Step, look, prepare, states, steps, take
from stored import build

from terrasim.errors import InputError, RunError
from terrasim.store import writer
from terrasim.store.branch import Branch, open_branch
from terrasim.store.codec import StoreCorrupt
from terrasim.store.store import open_store
from terrasim.store.verify import verify

SEED = 6
CALLS = range(1, 201) if SOAKING else (1, 8, 27, 64)
FAULTS = [
    ("full", True),
    ("short", True),
    ("write", False),
    ("write", True),
    ("sync", False),
    ("sync", True),
    ("truncate", True),
    ("read-only", True),
]
REMEDY = re.compile("make room|reopen|try again|choose another|cannot be written")
NAME = "ground.store"


@dataclass
class Play:
    """A play on a disk with a fault."""

    path: Path
    vfs: FaultyVFS
    name: str
    """The disk's."""
    branch: Branch | None
    script: list[Step]
    states: list[State]

    def act(self, number: int) -> None:
        """Take a step.

        Raises:
            InputError: If the disk fails.
            RunError: If the disk fails.
        """
        branch, step = self.branch, self.script[number]
        if branch is None or step.kind == "session":
            self.branch = None
            if branch is not None:
                branch.close()
            branch = self.branch = open_branch(self.path, vfs=self.name)
        if step.kind != "session":
            self.branch = take(branch, step, self.states[number], self.name)

    def endure(self, number: int, error: Exception) -> None:
        """What must hold after a step was refused; mend the disk then and go on.

        Raises:
            AssertionError: If it does not hold.
        """
        assert not isinstance(error, StoreCorrupt), error
        assert REMEDY.search(str(error)), error
        assert "\n" not in str(error)
        self.readable(number)
        if self.branch is not None and self.vfs.fault and self.vfs.fault.lasting:
            with pytest.raises((RunError, InputError)):
                self.branch.append(b"\0\0never")
            self.readable(number)
        kind = self.vfs.fault.kind if self.vfs.fault else ""
        self.vfs.begin(None)
        if self.branch is not None and kind not in {"full", "short"}:
            self.reopen(number)

    def readable(self, number: int) -> None:
        """Reading goes on as if nothing had happened."""
        if self.branch is not None:
            assert look(self.branch).fits(self.states[number])
        with open_store(self.path) as store:
            assert store.grid.rows == 300

    def reopen(self, number: int) -> None:
        """Nothing is written until the branch is reopened; then only what was acknowledged."""
        assert self.branch is not None
        before = self.vfs.changes
        with pytest.raises(RunError, match="reopen"):
            self.branch.append(b"\0\0never")
        with pytest.raises(RunError, match="reopen"):
            self.branch.snapshot("never")
        assert self.vfs.changes == before
        self.branch.reopen()
        assert look(self.branch).fits(self.states[number])


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A store to begin with."""
    return prepare(build(tmp_path_factory.mktemp("template") / NAME)).read_bytes()


@pytest.fixture
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """The log is moved into the file often."""
    monkeypatch.setattr(writer, "LOG_FRAMES", 60)


def perform(place: Path, template: bytes, fault: Fault) -> int:
    """The play with a fault in it; returns how many steps were refused.

    Raises:
        AssertionError: If anything is not as it must be.
    """
    place.mkdir()
    (place / NAME).write_bytes(template)
    script = steps(SEED, 60 if SOAKING else 20)
    vfs = FaultyVFS(str(place))
    branch = open_branch(place / NAME, vfs=str(place))
    play = Play(place / NAME, vfs, str(place), branch, script, states(script))
    refused = 0
    vfs.begin(fault)
    for number in range(len(script)):
        try:
            play.act(number)
        except (InputError, RunError) as error:
            refused += 1
            play.endure(number, error)
            play.act(number)
    vfs.begin(None)
    assert play.branch is not None
    assert look(play.branch).fits(play.states[-1])
    play.branch.close()
    vfs.unregister()
    report = verify(place / NAME)
    assert report["sound"], report["problems"]
    return refused


def test_the_first_row_in_a_new_log_is_dropped_if_it_was_not_acknowledged(
    tmp_path: Path, template: bytes
) -> None:
    """Like any other: what was refused is not there when the branch is reopened."""
    path, vfs = tmp_path / NAME, FaultyVFS("first")
    path.write_bytes(template)
    with open_branch(path, vfs="first") as branch:
        branch.append(b"\0\0one")
    with open_branch(path, vfs="first") as branch:
        vfs.begin(Fault("sync", 2))
        with pytest.raises(RunError, match="cannot be written"):
            branch.append(b"\0\0two")
        vfs.begin(None)
        branch.reopen()
        assert [row.op for row in branch.rows()] == [b"\0\0one"]
    vfs.unregister()


@pytest.mark.parametrize(("kind", "lasting"), FAULTS)
def test_a_disk_that_fails_at_any_call_is_endured(
    tmp_path: Path, template: bytes, often: None, kind: str, lasting: bool
) -> None:
    """It is said, nothing false is acknowledged, reading goes on, and so does writing later."""
    refused = [perform(tmp_path / f"{k}", template, Fault(kind, k, lasting)) for k in CALLS]
    assert max(refused) == 1 or kind == "truncate", refused
