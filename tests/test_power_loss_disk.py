"""The disk that loses power itself: it must catch a journal that is not flushed."""

from __future__ import annotations

from pathlib import Path

import apsw
import pytest
from power_loss import Log, RecordingVFS

ROWS = 40


def lost_after_crashes(folder: Path, synchronous: str) -> tuple[int, int]:
    """Write rows and marks, crash all along: how many crashes, and how many lost a marked row."""
    log = Log()
    vfs = RecordingVFS(f"recording-{synchronous}", log)
    db = apsw.Connection(str(folder / "a.db"), vfs=f"recording-{synchronous}")
    db.pragma("journal_mode", "wal")
    db.pragma("synchronous", synchronous)
    db.execute("CREATE TABLE t (x INTEGER PRIMARY KEY, y BLOB)")
    log.mark(0)
    for x in range(1, ROWS + 1):
        db.execute("INSERT INTO t VALUES (?, ?)", (x, bytes(300)))
        log.mark(x)
    ends = range(20, len(log.events), 7)
    lost = 0
    for end in ends:
        marked = log.marks(end)
        place = folder / f"crash-{end}"
        place.mkdir()
        for name, content in log.crash(end, end, {}).items():
            (place / name).write_bytes(content)
        found = _newest_row(place / "a.db")
        lost += found < int(str(marked[-1])) if marked else 0
    db.close()
    vfs.unregister()
    return len(ends), lost


def _newest_row(path: Path) -> int:
    try:
        [(newest,)] = apsw.Connection(str(path)).execute("SELECT max(x) FROM t").fetchall()
    except apsw.Error:
        return -1
    return newest if isinstance(newest, int) else 0


@pytest.mark.parametrize(("synchronous", "safe"), [("full", True), ("normal", False)])
def test_only_a_flushed_journal_survives_the_power(
    tmp_path: Path, synchronous: str, safe: bool
) -> None:
    """With a sync at each commit nothing is lost; without it nearly every crash loses rows."""
    crashes, lost = lost_after_crashes(tmp_path, synchronous)
    assert crashes > 15
    assert lost == 0 if safe else lost > crashes // 2


def test_a_killed_process_cannot_show_a_missing_sync(tmp_path: Path) -> None:
    """What was written without a sync is there if the system lives on: all writes are kept."""
    log = Log()
    vfs = RecordingVFS("recording-kept", log)
    db = apsw.Connection(str(tmp_path / "a.db"), vfs="recording-kept")
    db.pragma("journal_mode", "wal")
    db.pragma("synchronous", "off")
    db.execute("CREATE TABLE t (x INTEGER PRIMARY KEY, y BLOB)")
    db.execute("INSERT INTO t VALUES (7, x'00')")
    (tmp_path / "later").mkdir()
    for name, content in log.crash(len(log.events), -1, {}).items():
        (tmp_path / "later" / name).write_bytes(content)
    assert _newest_row(tmp_path / "later" / "a.db") == 7
    db.close()
    vfs.unregister()
