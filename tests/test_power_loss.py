"""Power that fails at any moment: what was acknowledged is there, whole, and nothing else is."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle
from pathlib import Path

import numpy as np
import pytest
from power_loss import Log, RecordingVFS
from soak import SOAKING
from store_play import State, Step, look, prepare, states, steps, take
from stored import build

from terrasim.errors import RunError
from terrasim.store import writer
from terrasim.store.acknowledged import Claim
from terrasim.store.branch import open_branch
from terrasim.store.collect import collect
from terrasim.store.verify import verify

STEPS = 120 if SOAKING else 45
PLACES = 500 if SOAKING else 60
KEPT = (0, 1, -1, 2, 3) if SOAKING else (0, 1, -1)
"""Which of the writes that were not flushed a crash keeps: none, some, all."""
NOTES = ("now", "absent", "earlier", "zeros")
"""What the writer's note is after a crash: it is not flushed."""
SEED = 6
NAME = "ground.store"
Files = dict[str, bytes]


@dataclass(frozen=True)
class Done:
    """Mark of a step that was acknowledged."""

    count: int
    """How many there were."""


@dataclass(frozen=True)
class Noted:
    """Mark of a note that was written, or whose file was removed."""

    content: bytes | None


@dataclass(frozen=True)
class Played:
    """A play that was recorded."""

    script: list[Step]
    states: list[State]
    files: Files
    """What there was before it."""
    first: int
    """How many steps had been done then."""
    log: Log

    def done(self, end: int) -> int:
        """How many steps were acknowledged before a place."""
        marks = [mark.count for mark in self.log.marks(end) if isinstance(mark, Done)]
        return max(marks, default=self.first)

    def places(self, count: int) -> list[int]:
        """Places right after syncs and between them, in order."""
        rng, last = np.random.default_rng(5), len(self.log.events)
        between = rng.integers(1, last, count).tolist()
        found = sorted({*self.log.syncs(), *between, last})
        chosen = np.unique(np.linspace(0, len(found) - 1, count).astype(int))
        return [found[k] for k in chosen]

    def crash(self, end: int, kept: int, note: str) -> Files:
        """What is on the disk after the power failed."""
        files = self.log.crash(end, kept * end if kept > 0 else kept, self.files)
        rng = np.random.default_rng(end)
        noted = [mark.content for mark in self.log.marks(end) if isinstance(mark, Noted)]
        found = {
            "now": noted[-1] if noted else None,
            "absent": None,
            "earlier": noted[int(rng.integers(len(noted)))] if noted else None,
            "zeros": bytes(68),
        }[note]
        # What it held before the play is not the play's.
        files.pop(NAME + "-writer", None)
        return files if found is None else files | {NAME + "-writer": found}


def play(place: Path, files: Files, script: list[Step], first: int) -> Played:
    """Go on with a play after some steps, on a disk that records."""
    path = placed(files, place)
    known, log = states(script), Log()
    vfs = RecordingVFS(f"recording-{place}", log)
    with noting(log, path.with_name(path.name + "-writer")):
        branch = open_branch(path, vfs=f"recording-{place}")
        for number in range(first, len(script)):
            branch = take(branch, script[number], known[number], f"recording-{place}")
            log.mark(Done(number + 1))
        branch.close()
    vfs.unregister()
    return Played(script, known, files, first, log)


def placed(files: Files, place: Path) -> Path:
    """Files in a folder; returns the store's path."""
    place.mkdir()
    for name, content in files.items():
        (place / name).write_bytes(content)
    return place / NAME


@contextmanager
def noting(log: Log, note: Path) -> Iterator[None]:
    """Record what becomes of the writer's note, and let the log be moved often."""

    def noted(act: Callable[..., None]) -> Callable[..., None]:
        def both(*given: object, **named: object) -> None:
            act(*given, **named)
            log.mark(Noted(note.read_bytes() if note.exists() else None))

        return both

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "LOG_FRAMES", 60)
        patch.setattr(Claim, "write", noted(Claim.write))
        patch.setattr(Claim, "release", noted(Claim.release))
        yield


def survive(path: Path, played: Played, done: int, *, go_on: bool) -> int:
    """Open what a crash left and read all of it; returns how many steps were done.

    Raises:
        AssertionError: If it is not as after what was acknowledged, or one step more.
    """
    script, known = played.script, played.states
    with open_branch(path) as branch:
        found = look(branch)
    fits = [done + k for k, state in enumerate(known[done : done + 2]) if found.fits(state)]
    assert fits, f"{found} after {known[done]}"
    count = fits[0]
    # Whoever was not told tries again; what has a key is done once.
    keyed = done < len(script) and script[done].rows and all(row.idem for row in script[done].rows)
    number = done if keyed else count
    if go_on and number < len(script):
        branch = open_branch(path)
        branch = take(branch, script[number], known[number])
        assert look(branch).fits(known[number + 1])
        branch.close()
    report = verify(path)
    assert report["sound"], report["problems"]
    return count


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Files:
    """A store to begin with."""
    path = prepare(build(tmp_path_factory.mktemp("template") / NAME))
    return {NAME: path.read_bytes()}


@pytest.fixture(scope="module")
def played(template: Files, tmp_path_factory: pytest.TempPathFactory) -> Played:
    """A play of everything."""
    script = steps(SEED, STEPS)
    kinds = {step.kind for step in script}
    assert len(kinds) == 9, kinds
    return play(tmp_path_factory.mktemp("play") / "play", template, script, 0)


def test_nothing_acknowledged_is_lost_wherever_the_power_fails(
    played: Played, tmp_path: Path
) -> None:
    """With none, some or all of what was not flushed, and any note the writer may have left."""
    notes = cycle(NOTES)
    more = 0
    for end in played.places(PLACES):
        for kept in KEPT if SOAKING else KEPT[end % 3 : end % 3 + 1]:
            note, done = next(notes), played.done(end)
            files = played.crash(end, kept, note)
            path = placed(files, tmp_path / f"{end}-{kept}")
            more += survive(path, played, done, go_on=end % 3 == 0) > done
    # Sometimes a crash comes between the last sync and the word of it.
    assert more > 0


def test_a_crash_after_a_crash_loses_nothing_either(played: Played, tmp_path: Path) -> None:
    """What the first one left is gone on with, whatever lies behind the end of its log."""
    notes = cycle(NOTES)
    for turn, end in enumerate(played.places(40 if SOAKING else 4)):
        files = played.crash(end, 1, next(notes))
        first = survive(placed(files, tmp_path / f"{turn}"), played, played.done(end), go_on=False)
        script = played.script[: first + 8]
        again = play(tmp_path / f"{turn}-on", files, script, first)
        for place in again.places(20 if SOAKING else 5):
            left = again.crash(place, place % 3 - 1, next(notes))
            path = placed(left, tmp_path / f"{turn}-{place}")
            survive(path, again, again.done(place), go_on=False)


def test_a_disk_that_does_not_flush_the_log_is_seen(played: Played, tmp_path: Path) -> None:
    """These tests would see it if a commit were not flushed: then nearly every crash loses."""
    events = [one for one in played.log.events if (one.kind, one.file) != ("sync", NAME + "-wal")]
    lying = Played(played.script, played.states, played.files, 0, Log(events))
    lost = 0
    places = lying.places(12)[2:-1]
    for end in places:
        path = placed(lying.crash(end, 0, "absent"), tmp_path / f"{end}")
        try:
            survive(path, lying, lying.done(end), go_on=False)
        except (AssertionError, RunError):
            lost += 1
    assert lost > len(places) // 2


def test_a_note_of_rows_that_were_collected_since_is_no_loss(
    template: Files, tmp_path: Path
) -> None:
    """The note is not flushed: after a crash it may be from before a reset and its collecting."""
    path = placed(template, tmp_path / "store")
    note = path.with_name(path.name + "-writer")
    with open_branch(path) as branch:
        branch.append(b"\0\0stays")
        branch.checkpoint({}, 1)
        branch.snapshot("here")
        branch.append(b"\0\0goes")
        earlier = note.read_bytes()
        branch.reset("here")
        collect(branch)
    note.write_bytes(earlier)
    with open_branch(path) as branch:
        assert [row.op for row in branch.rows()] == [b"\0\0stays"]
    note.write_bytes(earlier)
    assert verify(path)["sound"]
