"""A play on a store, step by step, and what must be there after each: for disks that fail."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from hashlib import blake2b
from itertools import accumulate
from pathlib import Path

import numpy as np
from stored import source

from terrasim.counts import Counts
from terrasim.grid import Block
from terrasim.sources.source import BlockData, Source, describe
from terrasim.store.branch import Branch, open_branch
from terrasim.store.collect import collect
from terrasim.store.journal import NewRow
from terrasim.store.store import open_snapshot

KEYS = (Block(0, -1, 0), Block(0, 0, 1), Block(1, 0, 0), Block(-1, 2, 1), Block(-1, 3, 3))
"""Blocks that change: on the ground, above it, and detail."""
FACTOR = 2
_LONG = 9000

Heights = tuple[int, ...]
"""How often each block's pattern was added."""


@dataclass(frozen=True)
class Step:
    """One thing to do."""

    kind: str
    """``append``, ``batch``, ``checkpoint``, ``snapshot``, ``drop``, ``reset``, ``collect``,
    ``trim`` or ``session``."""
    rows: tuple[NewRow, ...] = ()
    """What to write."""
    name: str = ""
    """Of which snapshot."""
    keep: int = 0
    """How many rows to keep."""


@dataclass(frozen=True)
class Line:
    """A history, and the ground at its newest checkpoint."""

    ops: tuple[bytes, ...] = ()
    """Its operations, each in short."""
    kept: int = 0
    """How many of the newest were never trimmed."""
    held: Heights = (0,) * len(KEYS)


@dataclass(frozen=True)
class State:
    """What a store must be."""

    line: Line = Line()
    waiting: int = 0
    """How many operations no checkpoint holds."""
    named: tuple[tuple[str, Line], ...] = ()
    """Snapshots in order of their names."""


@dataclass(frozen=True)
class Found:
    """What a store is, every part of it read."""

    ops: tuple[bytes, ...]
    waiting: tuple[bytes, ...]
    held: Heights
    named: tuple[tuple[str, Heights], ...]

    def fits(self, state: State) -> bool:
        """Whether it is what it must be; of what was trimmed some may still be there."""
        line, older = state.line, iter(state.line.ops)
        kept = line.ops[len(line.ops) - line.kept :]
        return (
            self.ops[len(self.ops) - len(kept) :] == kept
            and all(op in older for op in self.ops)
            and self.waiting == line.ops[len(line.ops) - state.waiting :]
            and self.held == line.held
            and self.named == tuple((name, one.held) for name, one in state.named)
        )


def steps(seed: int, count: int) -> list[Step]:
    """What to do, in order: all kinds again and again, mostly rows and checkpoints."""
    rng, made, state = np.random.default_rng(seed), list[Step](), State()
    kinds = ("batch", "checkpoint", "snapshot", "drop", "reset", "collect", "trim", "session")
    chances = (0.16, 0.16, 0.06, 0.02, 0.07, 0.06, 0.04, 0.06)
    while len(made) < count:
        kind = str(rng.choice(["append", *kinds], p=[1.0 - sum(chances), *chances]))
        if kind == "snapshot" and state.waiting:
            made.append(Step("checkpoint"))
            state = after(state, made[-1])
        names = [name for name, _ in state.named]
        if kind in {"drop", "reset"} and not names:
            continue
        made.append(_step(rng, kind, len(made), names))
        state = after(state, made[-1])
    return made[:count]


def _step(rng: np.random.Generator, kind: str, number: int, names: list[str]) -> Step:
    if kind == "append":
        return Step(kind, (_row(rng, f"{number}" if rng.random() < 0.8 else None),))
    if kind == "batch":
        return Step(kind, tuple(_row(rng, f"{number}-{k}") for k in range(rng.integers(2, 6))))
    if kind == "trim":
        return Step(kind, keep=int(rng.integers(0, 9)))
    if kind == "snapshot":
        return Step(kind, name=f"s{number}")
    return Step(kind, name=str(rng.choice(names)) if kind in {"drop", "reset"} else "")


def _row(rng: np.random.Generator, key: str | None) -> NewRow:
    """A row: one byte says which block, one how often; some fill several pages."""
    size = int(rng.integers(0, _LONG if rng.random() < 0.1 else 60))
    op = bytes([int(rng.integers(len(KEYS))), int(rng.integers(5))]) + rng.bytes(size)
    return NewRow(op, key, "play", "a step")


def short(op: bytes) -> bytes:
    """What an operation does, and a few bytes of its hash."""
    return op[:2] + blake2b(op, digest_size=6).digest()


def after(state: State, step: Step) -> State:
    """What must be there when a step was done."""
    line, named = state.line, dict(state.named)
    if step.rows:
        ops, more = line.ops + tuple(short(row.op) for row in step.rows), len(step.rows)
        line = replace(line, ops=ops, kept=line.kept + more)
        return replace(state, line=line, waiting=state.waiting + more)
    if step.kind == "checkpoint":
        return replace(state, line=replace(line, held=ground(state)), waiting=0)
    if step.kind == "snapshot":
        named[step.name] = line
    elif step.kind == "drop":
        del named[step.name]
    elif step.kind == "reset":
        return replace(state, line=named[step.name], waiting=0)
    elif step.kind == "trim":
        line = replace(line, kept=min(line.kept, max(step.keep, state.waiting)))
        for name, one in named.items():
            named[name] = replace(one, kept=min(one.kept, step.keep))
    return replace(state, line=line, named=tuple(sorted(named.items())))


def states(script: list[Step]) -> list[State]:
    """What must be there after 0, 1, 2 ... steps."""
    return list(accumulate(script, after, initial=State()))


def ground(state: State) -> Heights:
    """The ground with the operations that wait."""
    heights = list(state.line.held)
    for op in state.line.ops[len(state.line.ops) - state.waiting :]:
        heights[op[0]] += op[1] - 2
    return tuple(heights)


def prepare(path: Path) -> Path:
    """Give a store that was just built its detail factor; its files are then one."""
    with open_branch(path) as branch:
        branch.set_detail_factor(FACTOR)
    return path


def take(branch: Branch, step: Step, before: State, vfs: str = "") -> Branch:
    """Do a step; returns the branch to go on with."""
    if step.kind == "append":
        row = step.rows[0]
        branch.append(row.op, idem=row.idem, engine=row.engine, summary=row.summary)
    elif step.kind == "batch":
        branch.append_many(step.rows)
    elif step.kind == "checkpoint":
        branch.checkpoint(dict(_images(before)), branch.last_seq)
    elif step.kind == "snapshot":
        branch.snapshot(step.name)
    elif step.kind == "drop":
        branch.drop_snapshot(step.name)
    elif step.kind == "reset":
        branch.reset(step.name)
    elif step.kind == "collect":
        collect(branch)
    elif step.kind == "trim":
        branch.trim(step.keep)
    else:
        branch.close()
        return open_branch(branch.path, vfs=vfs)
    return branch


def _images(state: State) -> Iterator[tuple[Block, BlockData | None]]:
    """Blocks that have changed since the newest checkpoint."""
    for key, old, new in zip(KEYS, state.line.held, ground(state), strict=True):
        if new != old:
            zero = key.level < 0 and new == 0
            yield key, None if zero else describe(_posts(key) + new * _pattern(key), 0)


def look(branch: Branch) -> Found:
    """Read every part of a store.

    Raises:
        AssertionError: If a block's posts are none that were ever written.
    """
    named = []
    for name in sorted(branch.snapshots()):
        with open_snapshot(branch.path, name) as snapshot:
            named.append((name, heights_of(snapshot)))
    return Found(
        ops=tuple(short(row.op) for row in branch.rows()),
        waiting=tuple(short(op) for _, op, _ in branch.pending()),
        held=heights_of(branch),
        named=tuple(named),
    )


def heights_of(ground: Source) -> Heights:
    """How often each block's pattern was added to what was imported."""
    return tuple(times_added(key, ground.block(key).posts) for key in KEYS)


def times_added(key: Block, posts: Counts) -> int:
    """How often a block's pattern was added.

    Raises:
        AssertionError: If it is torn or otherwise wrong.
    """
    added = posts.astype(np.int64) - _posts(key)
    pattern = _pattern(key)
    times = round(float(added.sum()) / float(pattern.sum()))
    np.testing.assert_array_equal(added, times * pattern)
    return times


@cache
def _posts(key: Block) -> Counts:
    """What was imported."""
    if key.level < 0:
        return np.zeros((256, 256), np.int32)
    return source().block(key).posts


@cache
def _pattern(key: Block) -> Counts:
    """What an operation adds, noise so that it takes several pages."""
    made: Counts = np.zeros((256, 256), np.int32)
    seed = 3 + KEYS.index(key)
    made[100:180, 90:170] = np.random.default_rng(seed).integers(1, 90, (80, 80))
    return made
