"""A journal row is on the disk when it is acknowledged, once, and is never lost unnoticed."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import apsw
import numpy as np
import pytest
from power_loss import Log, RecordingVFS
from stored import ENDINGS, alter, build, killed

from terrasim.errors import InputError
from terrasim.store.branch import open_branch
from terrasim.store.codec import StoreCorrupt
from terrasim.store.history import history
from terrasim.store.journal import MAX_OP_BYTES, NewRow
from terrasim.store.store import open_store
from terrasim.store.verify import verify
from terrasim.store.write_ahead_log import read_log

FRAME = 24 + 4096


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A store."""
    return build(tmp_path / "hill.store")


def test_rows_are_numbered_and_come_back_as_they_were(path: Path) -> None:
    """Operation, engine, summary, key; oldest first, newest first."""
    with open_branch(path) as branch:
        assert branch.append(b"\0one", engine="e1", summary="first") == 1
        assert branch.append_many([NewRow(b"two", "key"), NewRow(b"")]) == [2, 3]
        rows = list(branch.rows())
        assert [(row.seq, row.op, row.idem) for row in rows] == [
            (1, b"\0one", None),
            (2, b"two", "key"),
            (3, b"", None),
        ]
        assert (rows[0].engine, rows[0].summary) == ("e1", "first")
        assert [row.seq for row in branch.rows(2)] == [2, 3]
        assert [row.seq for row in branch.history(2)] == [3, 2]
        assert branch.history(0) == []
        assert next(branch.pending()) == (1, b"\0one", "e1")
        branch.checkpoint({}, 2)
        assert [seq for seq, _, _ in branch.pending()] == [3]
        assert rows[0].time <= rows[2].time


def test_the_same_under_the_same_key_is_written_once(path: Path) -> None:
    """Also within a batch and after reopening; something else under it is refused."""
    with open_branch(path) as branch:
        assert branch.append(b"a", idem="k") == branch.append(b"a", idem="k") == 1
        rows = [NewRow(b"b", "l"), NewRow(b"a", "k"), NewRow(b"b", "l"), NewRow(b"c")]
        assert branch.append_many(rows) == [2, 1, 2, 3]
        with pytest.raises(InputError, match="'k' stands for another operation, number 1"):
            branch.append_many([NewRow(b"d"), NewRow(b"x", "k")])
        assert branch.last_seq == 3
        branch.checkpoint({}, 3)
        branch.snapshot("s")
        branch.append(b"gone", idem="m")
        branch.reset("s")
        assert branch.append(b"gone", idem="m") == 4
    with open_branch(path) as branch:
        assert branch.append(b"a", idem="k") == 1
        assert [row.seq for row in branch.rows()] == [1, 2, 3]
        branch.fork("dev", at="s")
    with open_branch(path, "dev") as dev:
        assert dev.append(b"other", idem="k") == 5


@pytest.mark.parametrize(
    "row",
    [
        NewRow(b"x", idem=""),
        NewRow(b"x", idem="k" * 256),
        NewRow(b"x", idem="a\nb"),
        NewRow(b"x", summary="\0"),
        NewRow(b"x", engine="\x1b[1m"),
        NewRow(b"x", summary="\ud800"),
    ],
)
def test_words_that_are_no_text_are_refused(path: Path, row: NewRow) -> None:
    """And so is an operation that is too large; nothing is written."""
    with open_branch(path) as branch:
        with pytest.raises(InputError):
            branch.append_many([NewRow(b"fine"), row])
        with pytest.raises(InputError, match="at most"):
            branch.append(bytes(MAX_OP_BYTES + 1))
        assert branch.last_seq == 0


def test_an_acknowledged_row_was_flushed(path: Path) -> None:
    """Between the last write into the log and the acknowledgement there is a sync of it."""
    log = Log()
    vfs = RecordingVFS("recording-journal", log)
    with open_branch(path, vfs="recording-journal") as branch:
        log.events.clear()
        for number in range(20):
            branch.append(b"row %d" % number, idem=str(number))
            log.mark(number)
    kinds = [event.kind for event in log.events if event.kind == "mark" or "-wal" in event.file]
    places = [i for i, kind in enumerate(kinds) if kind == "mark"]
    assert len(places) == 20
    assert all(kinds[place - 2 : place] == ["write", "sync"] for place in places)
    vfs.unregister()


@pytest.mark.parametrize(
    "sql",
    [
        "UPDATE journal SET op = x'00' WHERE (id & 1023) = 3",
        "UPDATE journal SET engine = 'other' WHERE (id & 1023) = 3",
        "UPDATE journal SET time = time + 1 WHERE (id & 1023) = 3",
        "UPDATE journal SET chain = randomblob(16) WHERE (id & 1023) = 5",
        "DELETE FROM journal WHERE (id & 1023) = 3",
        "DELETE FROM journal WHERE (id & 1023) = 5",
        "DELETE FROM journal WHERE (id & 1023) > 3",
        "UPDATE journal SET id = id + 1 WHERE (id & 1023) = 5",
    ],
)
def test_an_altered_journal_is_refused(path: Path, sql: str) -> None:
    """A row that is another, or that is not there: in the middle and at the end."""
    with open_branch(path) as branch:
        for _ in range(5):
            branch.append(b"row")
    assert alter(path, sql) > 0
    with pytest.raises(StoreCorrupt, match="journal row"):
        open_branch(path)
    with pytest.raises(StoreCorrupt, match="journal row"):
        history(path)


def left_behind(path: Path, folder: Path, rows: int, *, note: bool) -> Path:
    """A store whose writer was killed after some rows, with the note it left or without."""
    with open_branch(path) as branch:
        for number in range(rows):
            branch.append(b"row %d" % number)
        left = killed(path, folder)
    if not note:
        left.with_name(left.name + ENDINGS[2]).unlink()
    return left


def rows_found(path: Path) -> int | None:
    """How many rows a store holds; None if it says that it is damaged."""
    try:
        open_store(path).close()
        with open_branch(path) as branch:
            return len(list(branch.rows()))
    except StoreCorrupt:
        return None


@pytest.mark.parametrize("note", [True, False])
def test_a_flipped_bit_in_the_log_is_no_silent_loss(path: Path, tmp_path: Path, note: bool) -> None:
    """With the writer's note every bit tells; without it all but those of the last two rows."""
    rows = 40
    left = left_behind(path, tmp_path / "left", rows, note=note)
    log = left.with_name(left.name + "-wal")
    whole = log.read_bytes()
    frames = (len(whole) - 32) // FRAME
    known = read_log(left)
    assert known is not None
    assert known.frames == frames
    rng = np.random.default_rng(5)
    last = frames - (0 if note else 2)
    starts = (32 + FRAME * rng.integers(0, last, 30)).tolist()
    heads = [start + number % 24 for number, start in enumerate(starts)]
    places = [*range(0, 32, 3), *heads, *rng.integers(32, 32 + last * FRAME, 30).tolist()]
    refused = 0
    for place in places:
        for ending in ENDINGS:
            copy = left.with_name("copy.store" + ending)
            original = left.with_name(left.name + ending)
            copy.unlink(missing_ok=True)
            if original.exists():
                copy.write_bytes(original.read_bytes())
        damaged = bytearray(whole)
        damaged[place] ^= 1 << int(rng.integers(8))
        left.with_name("copy.store-wal").write_bytes(damaged)
        found = rows_found(left.with_name("copy.store"))
        assert found in (None, rows), place
        refused += found is None
    # A few bits say nothing: the count of checkpoints in the log's head, a page beyond the rows.
    assert refused > 0.9 * len(places)


def test_a_log_that_is_cut_off_is_an_earlier_state_or_refused(path: Path, tmp_path: Path) -> None:
    """Without the writer's note all rows up to some one; with it the loss is seen."""
    for rows, note in ((20, True), (40, False)):
        left = left_behind(path, tmp_path / f"left-{note}", 20, note=note)
        log = left.with_name(left.name + "-wal")
        for frames in (15, 7, 0):
            os.truncate(log, 32 + frames * FRAME + 100)
            copy = killed(left, tmp_path / f"{note}-{frames}")
            found = rows_found(copy)
            if note:
                assert found is None
            else:
                assert found is not None
                assert found < rows
                with open_branch(copy) as branch:
                    ops = [row.op for row in branch.rows()]
                assert ops == [b"row %d" % (number % 20) for number in range(len(ops))]


def test_a_log_that_is_gone_is_missed(path: Path, tmp_path: Path) -> None:
    """The note knows the newest row; without the note it is an earlier state."""
    left = left_behind(path, tmp_path / "left", 5, note=True)
    left.with_name(left.name + "-wal").unlink()
    with pytest.raises(StoreCorrupt, match=r"operation 5 was acknowledged .*; .* or remove"):
        open_branch(left)
    with pytest.raises(StoreCorrupt, match="operation 5"):
        open_store(left)
    assert "operation 5" in verify(left)["problems"][0]
    left.with_name(left.name + "-writer").unlink()
    with open_branch(left) as branch:
        assert branch.append(b"again") >= 1


def test_a_torn_last_transaction_is_no_damage(path: Path, tmp_path: Path) -> None:
    """Power may fail before its sync returns: any of its sectors may be missing."""
    left = left_behind(path, tmp_path / "left", 10, note=False)
    log = left.with_name(left.name + "-wal")
    whole = log.read_bytes()
    db = apsw.Connection(str(left))
    db.execute("BEGIN")
    # Several frames in one transaction.
    db.execute("INSERT INTO blob (hash, codec, data) VALUES (x'01', 9, randomblob(20000))")
    db.execute("COMMIT")
    longer = log.read_bytes()
    db.config(apsw.SQLITE_DBCONFIG_NO_CKPT_ON_CLOSE, 1)
    db.close()
    frames = (len(longer) - len(whole)) // FRAME
    assert frames > 4
    for missing in range(frames):
        torn = bytearray(longer)
        start = len(whole) + missing * FRAME
        torn[start : start + 512] = bytes(512)
        log.write_bytes(torn)
        known = read_log(left)
        assert known is not None
        assert known.frames == (len(whole) - 32) // FRAME


def power_failed(path: Path, tmp_path: Path, act: Callable[[Path, Log], None]) -> None:
    """Crash at many places, with none, some and all of what was not flushed."""
    log, files = Log(), {path.name: path.read_bytes()}
    vfs = RecordingVFS("recording-crash", log)
    act(path, log)
    vfs.unregister()
    ends = np.linspace(1, len(log.events), 40).astype(int)
    for end in ends:
        folder = tmp_path / f"crash-{end}"
        folder.mkdir()
        for name, content in log.crash(int(end), int(end) % 5, dict(files)).items():
            (folder / name).write_bytes(content)
        marks = [mark for mark in log.marks(int(end)) if isinstance(mark, int)]
        with open_branch(folder / path.name) as branch:
            ops = [row.op for row in branch.rows()]
        assert len(ops) >= max(marks, default=0)
        assert ops == [b"row %d" % number for number in range(len(ops))]


def test_power_may_fail_at_any_time(path: Path, tmp_path: Path) -> None:
    """No acknowledged row is lost, and no store is called damaged."""

    def act(path: Path, log: Log) -> None:
        with open_branch(path, vfs="recording-crash") as branch:
            for number in range(30):
                branch.append(b"row %d" % number)
                log.mark(number + 1)
                if number % 7 == 3:
                    branch.checkpoint({}, branch.last_seq)

    power_failed(path, tmp_path, act)


def test_the_journal_is_shortened_and_stays_chained(path: Path) -> None:
    """As many rows of each history stay as are asked for, and those that wait; numbers go on."""
    with open_branch(path) as branch:
        for _ in range(8):
            branch.append(b"op")
        branch.checkpoint({}, 5)
        assert branch.trim(2) == 5
        assert [row.seq for row in branch.rows()] == [6, 7, 8]
        branch.checkpoint({}, 8)
        branch.snapshot("s")
        branch.append_many([NewRow(b"late")] * 4)
        branch.checkpoint({}, 12)
        assert branch.trim(1) == 2
        assert [row.seq for row in branch.rows()] == [8, 9, 10, 11, 12]
        branch.drop_snapshot("s")
        assert branch.trim(0) == 5
        assert list(branch.rows()) == []
        with pytest.raises(InputError, match="keep"):
            branch.trim(-1)
    with open_branch(path) as branch:
        assert branch.append(b"next") == 13
        branch.fork("dev", at=12)
    with open_branch(path, "dev") as dev:
        dev.append(b"more")
        assert dev.trim(0) == 0
