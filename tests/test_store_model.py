"""Whatever is done to a store in whatever order: it is what a few lines of Python say it is."""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import count
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, precondition, rule, run_state_machine_as_test
from soak import SOAKING
from stored import GRID, build, killed

from terrasim.grid import Block
from terrasim.sources.source import BlockData, describe
from terrasim.store.branch import Branch, open_branch
from terrasim.store.collect import collect
from terrasim.store.journal import NewRow
from terrasim.store.store import open_snapshot
from terrasim.store.verify import verify

KEYS = [Block(0, -1, 0), Block(0, 0, 1), Block(1, 0, 0), Block(-1, 2, 1), Block(-1, 3, 3)]
_stores = count()

Ground = dict[Block, int]
"""What was added to each block."""


@dataclass
class Line:
    """A branch as it must be."""

    ground: Ground = field(default_factory=lambda: dict.fromkeys(KEYS, 0))
    """With all that was acknowledged."""
    held: Ground = field(default_factory=lambda: dict.fromkeys(KEYS, 0))
    """At the newest checkpoint."""
    ops: list[bytes] = field(default_factory=list)
    """Its history."""
    waiting: int = 0
    """How many of them no checkpoint holds."""
    keys: dict[str, tuple[bytes, int]] = field(default_factory=dict)
    """What was done under callers' keys."""


def do(ground: Ground, op: bytes) -> None:
    """An operation: one byte says which block, one what is added."""
    ground[KEYS[op[0] % len(KEYS)]] += op[1] - 2


class Play(RuleBasedStateMachine):
    """A store, and what it must be."""

    folder: Path
    template: Path

    def __init__(self) -> None:
        super().__init__()
        self.place = self.folder / f"{next(_stores)}"
        self.path = killed(self.template, self.place)
        self.name = "main"
        self.lines = {"main": Line()}
        self.named: dict[str, tuple[Ground, list[bytes]]] = {}
        self.branch = open_branch(self.path)
        self.branch.set_detail_factor(2)
        self.base = {key: self.branch.block(key) for key in KEYS}

    @property
    def line(self) -> Line:
        return self.lines[self.name]

    def image(self, key: Block, ground: Ground) -> BlockData:
        return describe(self.base[key].posts + np.int32(ground[key]), self.base[key].error)

    @rule(op=st.binary(min_size=2, max_size=2), key=st.sampled_from([None, "a", "b", "c"]))
    def append(self, op: bytes, key: str | None) -> None:
        before = self.branch.last_seq
        known = self.line.keys.get(key) if key else None
        if known is not None:
            assert self.branch.append(known[0], idem=key) == known[1]
            assert self.branch.last_seq == before
            return
        seq = self.branch.append(op, idem=key)
        assert seq == before + 1
        if key:
            self.line.keys[key] = op, seq
        self._done(op)

    @rule(ops=st.lists(st.binary(min_size=2, max_size=2), min_size=1, max_size=4))
    def append_many(self, ops: list[bytes]) -> None:
        self.branch.append_many([NewRow(op) for op in ops])
        for op in ops:
            self._done(op)

    def _done(self, op: bytes) -> None:
        do(self.line.ground, op)
        self.line.ops.append(op)
        self.line.waiting += 1

    @rule()
    def checkpoint(self) -> None:
        line = self.line
        moved = [key for key in KEYS if line.ground[key] != line.held[key]]
        blocks = {key: self.image(key, line.ground) for key in moved}
        zero = {key: None for key in moved if key.level < 0 and line.ground[key] == 0}
        self.branch.checkpoint({**blocks, **zero}, self.branch.last_seq)
        line.held, line.waiting = dict(line.ground), 0

    @precondition(lambda self: self.line.waiting == 0)
    @rule(name=st.sampled_from(["s", "t", "u"]))
    def snapshot(self, name: str) -> None:
        if name in self.named:
            self.branch.drop_snapshot(name)
        self.branch.snapshot(name)
        self.named[name] = dict(self.line.held), list(self.line.ops)

    @precondition(lambda self: self.named)
    @rule(data=st.data())
    def reset(self, data: st.DataObject) -> None:
        name = data.draw(st.sampled_from(sorted(self.named)))
        self.branch.reset(name)
        ground, ops = self.named[name]
        self.line.ground, self.line.held = dict(ground), dict(ground)
        self.line.ops, self.line.waiting = list(ops), 0

    @precondition(lambda self: self.line.waiting == 0)
    @rule(name=st.sampled_from(["dev", "try"]))
    def fork(self, name: str) -> None:
        if name == self.name:
            return
        if name in self.lines:
            self.branch.drop_branch(name)
        self.branch.fork(name)
        self.lines[name] = Line(dict(self.line.held), dict(self.line.held), list(self.line.ops))

    @rule(data=st.data())
    def close_and_open(self, data: st.DataObject) -> None:
        self.branch.close()
        self.name = data.draw(st.sampled_from(sorted(self.lines)))
        self._open()

    @rule()
    def kill(self) -> None:
        left = killed(self.path, self.folder / f"{next(_stores)}")
        self.branch.close()
        self.path = left
        self._open()

    def _open(self) -> None:
        self.branch = open_branch(self.path, self.name)
        waiting = [op for _, op, _ in self.branch.pending()]
        assert waiting == self.line.ops[len(self.line.ops) - self.line.waiting :]
        replayed = dict(self.line.held)
        for op in waiting:
            do(replayed, op)
        assert replayed == self.line.ground

    @rule()
    def collect(self) -> None:
        collect(self.branch)

    @rule()
    def read(self) -> None:
        self._check(self.branch)

    def _check(self, branch: Branch) -> None:
        for key in KEYS:
            got = branch.block(key)
            np.testing.assert_array_equal(got.posts, self.image(key, self.line.held).posts)
        wanted = {key for key in KEYS if key.level < 0 and self.line.held[key]}
        assert set(branch.details(Block(0, 0, 0))) | set(branch.details(Block(0, 0, 1))) == wanted
        assert [row.op for row in branch.rows()] == self.line.ops

    def teardown(self) -> None:
        self._check(self.branch)
        self.branch.close()
        found = verify(self.path)
        assert found["sound"], found["problems"]
        for name, (ground, _) in self.named.items():
            with open_snapshot(self.path, name) as snapshot:
                for key in KEYS:
                    wanted = self.image(key, ground).posts
                    np.testing.assert_array_equal(snapshot.block(key).posts, wanted)
        for name, line in self.lines.items():
            with open_branch(self.path, name) as branch:
                assert [row.op for row in branch.rows()] == line.ops
        assert collect(self.path) is not None
        assert verify(self.path)["sound"]


def test_a_store_is_what_its_model_says(tmp_path: Path) -> None:
    """Rows, checkpoints, snapshots, resets, forks, kills, reopening, collecting, in any order."""

    class Here(Play):
        folder = tmp_path
        template = build(tmp_path / "template")

    assert GRID.levels == 2
    run_state_machine_as_test(
        Here,
        settings=settings(
            max_examples=500 if SOAKING else 12,
            stateful_step_count=100 if SOAKING else 25,
            deadline=None,
            database=None,
            suppress_health_check=list(HealthCheck),
        ),
    )
