"""A store on a disk that loses power: what was acknowledged is there, whatever else was not."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pytest
from power_loss import Log, RecordingVFS
from soak import SOAKING
from stored import FAR, NEAR, build, changed, same, source

from terrasim.grid import Block
from terrasim.sources.source import BlockData
from terrasim.store.acknowledged import ENDING
from terrasim.store.branch import Branch, open_branch
from terrasim.store.collect import collect
from terrasim.store.journal import NewRow
from terrasim.store.verify import verify

CRASHES = 500 if SOAKING else 70
TURNS = 120 if SOAKING else 45
STORE = "ground.store"


@dataclass(frozen=True)
class State:
    """What the store must say."""

    rows: tuple[bytes, ...] = ()
    """Operations of the branch, oldest first."""
    held: dict[Block, BlockData] = field(default_factory=dict)
    """Changed blocks at the newest checkpoint."""
    named: frozenset[str] = frozenset()
    """Snapshots."""


@contextmanager
def recorded(log: Log, name: str) -> Iterator[str]:
    vfs = RecordingVFS(name, log)
    try:
        yield name
    finally:
        vfs.unregister()


def play(folder: Path, log: Log, vfs: str) -> dict[str, bytes]:
    """Do everything that stores do; marks are the state and the writer's note.

    Returns:
        What the files held at first.
    """
    path = build(folder / STORE)
    files = {STORE: path.read_bytes()}
    rng = np.random.default_rng(3)
    state, saved = State(), dict[str, State]()
    with open_branch(path, vfs=vfs) as branch:
        _mark(log, path, state)
        for turn in range(TURNS):
            draw = rng.random()
            if draw < 0.55 or turn < 3:
                op = rng.bytes(int(rng.integers(20, 3000)))
                branch.append(op, idem=f"key-{turn}")
                state = replace(state, rows=(*state.rows, op))
            elif draw < 0.65:
                ops = [rng.bytes(100) for _ in range(4)]
                branch.append_many([NewRow(op) for op in ops])
                state = replace(state, rows=(*state.rows, *ops))
            elif draw < 0.85:
                state = _checkpoint(branch, state, turn)
            elif draw < 0.92:
                state = _checkpoint(branch, state, turn)
                _mark(log, path, state)
                branch.snapshot(f"s{turn}")
                state = replace(state, named=state.named | {f"s{turn}"})
                saved[f"s{turn}"] = state
            elif draw < 0.96 and saved:
                name = sorted(saved)[int(rng.integers(len(saved)))]
                branch.reset(name)
                state = replace(saved[name], named=state.named)
            else:
                collect(branch)
            _mark(log, path, state)
    return files


def _checkpoint(branch: Branch, state: State, turn: int) -> State:
    key = NEAR if turn % 2 else FAR
    data = changed(branch, key, turn)
    branch.checkpoint({key: data}, branch.last_seq)
    return replace(state, held={**state.held, key: data})


def _mark(log: Log, path: Path, state: State) -> None:
    note = path.with_name(path.name + ENDING)
    log.mark((state, note.read_bytes() if note.exists() else b""))


def states_at(log: Log, end: int) -> list[State]:
    """The state acknowledged at a place in the log, and the one that comes next."""
    marks = [(i, event.mark) for i, event in enumerate(log.events) if event.kind == "mark"]
    before = [mark for i, mark in marks if i < end]
    after = [mark for i, mark in marks if i >= end]
    return [mark[0] for mark in (*before[-1:], *after[:1])]  # type: ignore[index]


def is_state(branch: Branch, state: State) -> bool:
    if tuple(row.op for row in branch.rows()) != state.rows:
        return False
    if set(branch.snapshots()) != state.named:
        return False
    imported = source()
    held = (state.held.get(key, imported.block(key)) for key in (NEAR, FAR))
    return all(same(branch.block(key), data) for key, data in zip((NEAR, FAR), held, strict=True))


def crash(log: Log, end: int, seed: int, files: dict[str, bytes], folder: Path) -> Path:
    """The files after a crash, the writer's note as old as the seed says."""
    folder.mkdir()
    for name, content in log.crash(end, seed, files).items():
        (folder / name).write_bytes(content)
    notes = [mark[1] for mark in log.marks(end)]  # type: ignore[index]
    note = notes[-1 - seed % len(notes)] if notes and seed % 3 else b""
    if note:
        (folder / (STORE + ENDING)).write_bytes(note)
    return folder / STORE


def test_every_crash_leaves_what_was_acknowledged(tmp_path: Path) -> None:
    """After any crash the store is in the acknowledged state or the next one, and sound."""
    log = Log()
    with recorded(log, "power-play") as vfs:
        files = play(tmp_path, log, vfs)
    first = next(i for i, event in enumerate(log.events) if event.kind == "mark") + 1
    rng = np.random.default_rng(1)
    ends = {*log.syncs(), *rng.integers(first, len(log.events), CRASHES).tolist()}
    chosen = sorted(end for end in ends if end >= first)
    chosen = rng.permutation(chosen)[:CRASHES].tolist()
    assert len(log.syncs()) > TURNS
    for number, end in enumerate(chosen):
        seed = (0, -1, number + 2)[number % 3]
        path = crash(log, end, seed, files, tmp_path / f"crash-{number}")
        with open_branch(path) as branch:
            assert any(is_state(branch, state) for state in states_at(log, end)), (end, seed)
            branch.append(b"and on it goes")
        assert verify(path)["sound"], (end, seed)


def test_a_journal_without_its_sync_is_caught(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same crashes find a store that does not flush its rows."""
    log = Log()
    monkeypatch.setattr("power_loss._RecordedFile.xSync", _forgets)
    with recorded(log, "power-play-unsafe") as vfs:
        files = play(tmp_path, log, vfs)
    end = len(log.events) - 1
    (tmp_path / "crash").mkdir()
    for name, content in log.crash(end, 0, files).items():
        (tmp_path / "crash" / name).write_bytes(content)
    with open_branch(tmp_path / "crash" / STORE) as branch:
        assert not any(is_state(branch, state) for state in states_at(log, end))


def _forgets(_: object, flags: int) -> None:
    """Sync nothing."""
