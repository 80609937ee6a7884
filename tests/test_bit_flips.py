"""Files that were damaged: each read is right or refused, and nothing acknowledged is missed."""

from __future__ import annotations

import faulthandler
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from itertools import accumulate
from pathlib import Path

import numpy as np
import pytest
from soak import SOAKING
from store_play import (
    KEYS,
    State,
    Step,
    after,
    heights_of,
    prepare,
    short,
    steps,
    take,
    times_added,
)
from stored import ENDINGS, build, killed

from terrasim.errors import InputError, RunError
from terrasim.grid import Block
from terrasim.store import writer
from terrasim.store.backup import backup
from terrasim.store.branch import open_branch
from terrasim.store.codec import StoreCorrupt
from terrasim.store.history import history
from terrasim.store.names import branches, snapshots
from terrasim.store.store import StoreSource, open_snapshot, open_store
from terrasim.store.verify import verify

DAMAGES = 10_000 if SOAKING else 240
LONGEST_S = 120
SEED = 6
PAGE = 4096
Files = dict[str, bytes]
Seen = dict[str, object]
REFUSED = object()
"""What a read says that raises one of the errors it may."""


@dataclass(frozen=True)
class Victim:
    """A store to be damaged."""

    files: Files
    """By the end of their names."""
    states: list[State]
    """What it was after each step since its log began, the newest last."""


@dataclass(frozen=True)
class Damage:
    """What was done to a file."""

    ending: str
    kind: str
    """``flip``, ``zeros``, ``noise`` or ``cut``."""
    place: int
    noted: bool = True
    """Whether the writer's note is there."""


@pytest.fixture(scope="module")
def victims(tmp_path_factory: pytest.TempPathFactory) -> list[Victim]:
    """One killed with a long log, one whose log was moved often, one that was closed."""
    folder = tmp_path_factory.mktemp("victims")
    script = [step for step in steps(SEED, 40) if step.kind != "trim"]
    return [
        _victim(folder / "log", script, 2000, close=False),
        _victim(folder / "moved", script, 60, close=False),
        _victim(folder / "closed", script, 2000, close=True),
    ]


def _victim(folder: Path, script: list[Step], log_frames: int, *, close: bool) -> Victim:
    folder.mkdir()
    path = prepare(build(folder / "ground.store"))
    states = list(accumulate(script, after, initial=State()))
    begun = max([0, *(k for k, step in enumerate(script) if step.kind == "session")])
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "LOG_FRAMES", log_frames)
        branch = open_branch(path)
        for number, step in enumerate(script):
            branch = take(branch, step, states[number])
        left = killed(path, folder / "left")
        branch.close()
    left = path if close else left
    names = {end: left.with_name(left.name + end) for end in ENDINGS}
    files = {end: name.read_bytes() for end, name in names.items() if name.exists()}
    return Victim(files, states[begun:])


def damages(victim: Victim, seed: int) -> Iterator[Damage]:
    """Damage without end: bits mostly, where files say what they hold as often as inside."""
    rng = np.random.default_rng(seed)
    endings = sorted(victim.files)
    while True:
        ending = str(rng.choice(endings))
        size = len(victim.files[ending])
        kind = str(rng.choice(["flip", "zeros", "noise", "cut"], p=[0.75, 0.05, 0.05, 0.15]))
        place = int(rng.integers(size))
        if ending != "-writer" and rng.random() < 0.4:
            place = place // PAGE * PAGE + int(rng.integers(64))
        yield Damage(ending, kind, min(place, size - 1), bool(rng.random() < 0.7))


def damaged(victim: Victim, damage: Damage, folder: Path) -> Path:
    """A copy of a store with damage in it."""
    folder.mkdir()
    rng = np.random.default_rng(damage.place)
    for ending, content in victim.files.items():
        data = bytearray(content)
        if ending == damage.ending:
            _do(data, damage, rng)
        elif ending == "-writer" and not damage.noted:
            continue
        (folder / f"ground.store{ending}").write_bytes(data)
    return folder / "ground.store"


def _do(data: bytearray, damage: Damage, rng: np.random.Generator) -> None:
    start, end = damage.place, min(damage.place // 512 * 512 + 512, len(data))
    if damage.kind == "flip":
        data[start] ^= 1 << int(rng.integers(8))
    elif damage.kind == "cut":
        del data[start:]
    else:
        data[start:end] = bytes(end - start) if damage.kind == "zeros" else rng.bytes(end - start)


def observe(path: Path, named: list[str]) -> Seen:
    """Read everything in every way; what is refused says so.

    Raises:
        AssertionError: If heights are none that were ever written.
    """
    seen: Seen = {}

    def read(name: str, act: Callable[[], object]) -> None:
        try:
            seen[name] = act()
        except (InputError, RunError):
            seen[name] = REFUSED

    seen["sound"] = _verified(path)
    read("main", lambda: _ground(path, None, read))
    for name in named:
        read(f"snapshot {name}", partial(_ground, path, name, read))
    read("history", lambda: tuple(short(row.op) for row in history(path, limit=10_000)[::-1]))
    read("branch", lambda: _branch(path, read))
    return seen


def _verified(path: Path) -> object:
    try:
        return verify(path)["sound"]
    except (InputError, RunError):
        return False


def _ground(path: Path, name: str | None, read: Callable[[str, Callable[[], object]], None]) -> str:
    with open_store(path) if name is None else open_snapshot(path, name) as store:
        for key, at in zip(KEYS, range(len(KEYS)), strict=True):
            read(f"{name} {at}", partial(_times, store, key))
    return "open"


def _times(store: StoreSource, key: Block) -> int:
    return times_added(key, store.block(key).posts)


def _branch(path: Path, read: Callable[[str, Callable[[], object]], None]) -> str:
    with open_branch(path) as branch:
        read("held", lambda: heights_of(branch))
        read("rows", lambda: tuple(short(row.op) for row in branch.rows()))
        read("pending", lambda: tuple(short(op) for _, op, _ in branch.pending()))
        read("names", lambda: tuple(sorted(branch.snapshots())))
    return "open"


def wanted(state: State) -> Seen:
    """What is seen of a store in a state."""
    line = state.line
    found: Seen = {"main": "open", "branch": "open", "sound": True}
    found |= {"history": line.ops, "rows": line.ops, "held": line.held}
    found["pending"] = line.ops[len(line.ops) - state.waiting :]
    found["names"] = tuple(name for name, _ in state.named)
    for name, held in [(None, line.held), *((name, one.held) for name, one in state.named)]:
        found |= {f"{name} {at}": times for at, times in enumerate(held)}
    return found | {f"snapshot {name}": "open" for name, _ in state.named}


def differs(seen: Seen, state: State) -> dict[str, object]:
    """What is seen and neither right nor refused."""
    right = wanted(state)
    return {
        name: got
        for name, got in seen.items()
        if name != "sound" and got is not REFUSED and got != right.get(name)
    }


def refused(seen: Seen) -> bool:
    """Whether anything was refused."""
    return any(got is REFUSED for got in seen.values())


def check(victim: Victim, damage: Damage, folder: Path) -> Seen:
    """Damage a store and read it; returns what was seen.

    Raises:
        AssertionError: If anything is wrong and not refused.
    """
    path = damaged(victim, damage, folder)
    # A read that hangs ends all, and says where.
    faulthandler.dump_traceback_later(LONGEST_S, exit=True)
    try:
        seen = observe(path, [name for name, _ in victim.states[-1].named])
    finally:
        faulthandler.cancel_dump_traceback_later()
    torn = damage.ending == "-wal" and not damage.noted
    allowed = victim.states if torn else victim.states[-1:]
    wrong = [differs(seen, state) for state in allowed]
    assert not all(wrong), (damage, wrong[-1])
    if torn and not refused(seen):
        return seen
    assert not (refused(seen) and seen["sound"]), (damage, seen)
    return seen


def test_an_undamaged_store_is_read_in_full(victims: list[Victim], tmp_path: Path) -> None:
    """Nothing is refused, nothing is missed."""
    for number, victim in enumerate(victims):
        path = damaged(victim, Damage("none", "flip", 0), tmp_path / f"{number}")
        seen = observe(path, [name for name, _ in victim.states[-1].named])
        assert seen == wanted(victim.states[-1])


@pytest.mark.parametrize("number", range(3))
def test_a_damaged_store_is_read_right_or_refused(
    victims: list[Victim], tmp_path: Path, number: int
) -> None:
    """Bits, sectors and ends of the store, its log and its note; it is never another state.

    But where the log is damaged and there is no note, it may be an earlier one.
    """
    victim, found = victims[number], 0
    made = damages(victim, number)
    for k in range(DAMAGES // 3):
        found += refused(check(victim, next(made), tmp_path / f"{k}"))
    assert found > DAMAGES // 30


def test_with_a_note_every_bit_of_the_log_tells(victims: list[Victim], tmp_path: Path) -> None:
    """None of what was acknowledged is dropped without a word."""
    victim = victims[0]
    rng = np.random.default_rng(1)
    for k, place in enumerate(rng.integers(len(victim.files["-wal"]), size=DAMAGES // 12).tolist()):
        seen = check(victim, Damage("-wal", "flip", place), tmp_path / f"{k}")
        assert seen["main"] is REFUSED
        assert seen["branch"] is REFUSED


def test_verification_leaves_a_damaged_log_as_it_is(victims: list[Victim], tmp_path: Path) -> None:
    """What is behind the damage is not dropped, so that the next one who opens it is told too."""
    for number, noted in enumerate([True, False]):
        path = damaged(victims[0], Damage("-wal", "flip", 9000, noted), tmp_path / f"{number}")
        log = path.with_name(path.name + "-wal")
        before = path.read_bytes(), log.read_bytes()
        assert not verify(path)["sound"]
        assert (path.read_bytes(), log.read_bytes()) == before
        with pytest.raises(StoreCorrupt, match="write-ahead log"):
            open_store(path)


def test_every_reader_misses_a_log_that_is_gone(victims: list[Victim], tmp_path: Path) -> None:
    """The note knows the newest row, whoever asks."""
    path = damaged(victims[0], Damage("-wal", "cut", 0), tmp_path / "gone")
    copied = partial(backup, target=tmp_path / "copy")
    acts: list[Callable[[Path], object]] = [open_store, open_branch, history, branches, copied]
    for act in [*acts, snapshots]:
        with pytest.raises(StoreCorrupt, match="acknowledged"):
            act(path)
    assert not verify(path)["sound"]
