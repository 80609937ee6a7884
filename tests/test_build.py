"""A build makes a whole store or none, in bounded memory."""

from __future__ import annotations

import errno
import gc
import os
import signal
import subprocess
import sys
import tracemalloc
from collections.abc import Iterator
from hashlib import blake2b
from pathlib import Path

import apsw
import numpy as np
import pytest

from terrasim.counts import HOLE, Counts
from terrasim.errors import InputError, RunError
from terrasim.grid import Grid
from terrasim.sources.array_source import ArraySource
from terrasim.store.build import build_store
from terrasim.store.info import info
from terrasim.store.store import open_store

GRID = Grid(1300, 700, 2.0, row=-5)


class Hills:
    """Rows of endless rough ground, each a function of its index."""

    def __init__(self, cols: int = GRID.cols) -> None:
        self.x = np.arange(cols)

    def read_rows(self, row: int, count: int) -> Counts:
        y = np.arange(row, row + count)[:, None]
        waves = 1e6 * np.sin(0.013 * y) * np.cos(0.017 * self.x)
        rough = (y * 7919 + self.x * 104_729) % 997
        posts: Counts = (waves + rough).astype(np.int32)
        return posts


def digest(path: Path) -> str:
    """A hash over all blocks: their blobs and what is said of them."""
    db = apsw.Connection(str(path))
    rows = db.execute(
        "SELECT level, row, col, blob.hash, lowest, highest, error "
        "FROM block JOIN blob ON blob.id = block.blob ORDER BY level, row, col"
    ).fetchall()
    db.close()
    return blake2b(repr(rows).encode()).hexdigest()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A build that nothing disturbed; do not change it."""
    path = tmp_path_factory.mktemp("whole") / "hills.terrain"
    build_store(Hills(), GRID, path, provenance={"made": "here"})
    return path


def names(folder: Path) -> list[str]:
    """What lies in a folder."""
    return sorted(path.name for path in folder.iterdir())


def test_the_report_says_what_was_made(tmp_path: Path) -> None:
    """Counts of posts, holes, blocks; range; size; errors a level."""
    posts = Hills().read_rows(0, GRID.rows)
    posts[3, 4] = posts[1299, 699] = HOLE
    source = ArraySource(posts, GRID)
    path = tmp_path / "hills.terrain"
    report = build_store(source, GRID, path, provenance=source.provenance)
    assert (report.posts, report.holes) == (1300 * 700, 2)
    assert (report.lowest, report.highest) == (posts[posts != HOLE].min(), posts.max())
    assert report.bytes == path.stat().st_size
    said = info(path)
    assert report.blocks == said["blocks"] == sum(row["blocks"] for row in said["levels"])
    assert list(report.errors) == [row["error"] for row in said["levels"]]
    assert list(report.skipped) == [row["skipped"] for row in said["levels"]]
    assert report.errors[0] == 0 < report.errors[1] < report.errors[2] < report.errors[3]
    assert names(tmp_path) == ["hills.terrain"]


def test_two_builds_of_the_same_ground_are_the_same_file(whole: Path, tmp_path: Path) -> None:
    """Byte for byte."""
    build_store(Hills(), GRID, tmp_path / "again", provenance={"made": "here"})
    assert (tmp_path / "again").read_bytes() == whole.read_bytes()


CHILD = """
import os
import sys
import time
import test_build
from terrasim.store.build import build_store

def tell(fraction, message):
    print(fraction, message, flush=True)

def flush(descriptor):
    print("flushing", flush=True)
    time.sleep(60)

if sys.argv[2] == "flush":
    os.fsync = flush
build_store(test_build.Hills(), test_build.GRID, sys.argv[1], provenance={"made": "here"},
            progress=tell)
"""


@pytest.mark.parametrize("after", ["0.03", "0.3", "0.5", "0.8", "1.0", "flush"])
def test_a_killed_build_leaves_nothing_to_read_and_the_next_one_is_whole(
    whole: Path, tmp_path: Path, after: str
) -> None:
    """Killed while it writes levels, measures errors, marks the file complete, flushes it."""
    path = tmp_path / "hills.terrain"
    script = tmp_path / "child.py"
    script.write_text(CHILD)
    folders = os.pathsep.join(filter(None, (str(Path(__file__).parent), *sys.path)))
    child = subprocess.Popen(
        [sys.executable, str(script), str(path), after],
        env=os.environ | {"PYTHONPATH": folders},
        stdout=subprocess.PIPE,
        text=True,
    )
    with child:
        assert child.stdout is not None
        for line in child.stdout:
            if line >= after:
                break
        else:
            pytest.fail(f"the build ended before {after}")
        child.send_signal(signal.SIGKILL)
    if path.exists():
        # The last line came before the renaming, but not long before.
        assert after == "1.0"
        assert digest(path) == digest(whole)
        path.unlink()
    else:
        with pytest.raises(InputError, match="half-built; run the import again"):
            open_store(path)
    build_store(Hills(), GRID, path, provenance={"made": "here"})
    assert digest(path) == digest(whole)
    assert names(tmp_path) == ["child.py", "hills.terrain"]


def test_what_lies_where_the_store_grows_is_emptied(whole: Path, tmp_path: Path) -> None:
    """Whatever it is: a half-built store of other ground, its journal, noise."""
    for ending in (".building", ".building-wal", ".building-shm", ".building-journal"):
        (tmp_path / f"hills.terrain{ending}").write_bytes(os.urandom(100_000))
    build_store(Hills(), GRID, tmp_path / "hills.terrain", provenance={"made": "here"})
    assert digest(tmp_path / "hills.terrain") == digest(whole)
    assert names(tmp_path) == ["hills.terrain"]


class Broken(Hills):
    """Rows that end in an exception."""

    def __init__(self, error: BaseException, at: int = 600) -> None:
        super().__init__()
        self.error, self.at = error, at

    def read_rows(self, row: int, count: int) -> Counts:
        if row + count > self.at:
            raise self.error
        return super().read_rows(row, count)


@pytest.mark.parametrize("error", [InputError("damaged strip"), KeyboardInterrupt(), OSError(5)])
def test_a_build_that_fails_leaves_nothing(tmp_path: Path, error: BaseException) -> None:
    """And the reason comes through as it was."""
    with pytest.raises(type(error)) as caught:
        build_store(Broken(error), GRID, tmp_path / "hills.terrain", provenance={})
    assert caught.value is error
    assert names(tmp_path) == []


class FailingFile(apsw.VFSFile):
    """A file that takes no more than some bytes."""

    room = 200_000
    error: type[apsw.Error] = apsw.FullError

    def __init__(self, name: str | apsw.URIFilename | None, flags: list[int]) -> None:
        super().__init__("unix", name, flags)

    def xWrite(self, data: bytes, offset: int) -> None:  # noqa: N802 SQLite's name
        if offset + len(data) > self.room:
            raise self.error("no room")
        super().xWrite(data, offset)


class FailingDisk(apsw.VFS):
    """A disk of such files, which all connections use while it is there."""

    def __init__(self) -> None:
        super().__init__("failing", "unix", makedefault=True)

    def xOpen(  # noqa: N802 SQLite's name
        self, name: str | apsw.URIFilename | None, flags: list[int]
    ) -> FailingFile:
        return FailingFile(name, flags)


@pytest.fixture
def failing_disk() -> Iterator[None]:
    """Writes fail beyond 200 kB."""
    disk = FailingDisk()
    yield
    disk.unregister()
    # A disk that is still named by a connection must not outlive its file.
    gc.collect()


@pytest.mark.parametrize(
    ("error", "said"),
    [(apsw.FullError, "the disk is full; make room"), (apsw.IOError, "cannot be written")],
)
@pytest.mark.usefixtures("failing_disk")
def test_a_full_or_broken_disk_is_one_line_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: type[apsw.Error], said: str
) -> None:
    """The half-written file gives its room back."""
    monkeypatch.setattr(FailingFile, "error", error)
    with pytest.raises(RunError, match=said) as caught:
        build_store(Hills(), GRID, tmp_path / "hills.terrain", provenance={})
    assert "\n" not in str(caught.value)
    assert names(tmp_path) == []


def test_a_disk_that_is_full_at_the_last_flush_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Room that was promised may be missing when it is needed."""

    def no_room(descriptor: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", no_room)
    with pytest.raises(RunError, match="No space left on device; make room"):
        build_store(Hills(), GRID, tmp_path / "hills.terrain", provenance={})
    assert names(tmp_path) == []


def test_a_place_where_nothing_may_be_written_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Before a row is read: no folder, a file in its place, no permission, a name too long."""
    (tmp_path / "file").write_text("")
    unread = Broken(AssertionError("a row was read"), at=0)
    for name, said in (
        ("no/hills.terrain", "there is no folder"),
        ("file/hills.terrain", "there is no folder"),
        ("x" * 250, "File name too long; choose another path"),
    ):
        with pytest.raises(InputError, match=said):
            build_store(unread, GRID, tmp_path / name, provenance={})

    def forbidden(*_: object) -> int:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "open", forbidden)
    with pytest.raises(InputError, match="Permission denied; choose another path"):
        build_store(unread, GRID, tmp_path / "hills.terrain", provenance={})
    assert names(tmp_path) == ["file"]


def test_a_store_is_replaced_only_on_demand(whole: Path, tmp_path: Path) -> None:
    """And only a store is, whole, at one moment."""
    path = tmp_path / "hills.terrain"
    path.write_bytes(whole.read_bytes())
    flat = ArraySource(np.zeros((9, 9), np.int32), Grid(9, 9, 1.0))
    with pytest.raises(InputError, match="exists; remove it or choose another name"):
        build_store(flat, flat.grid, path, provenance={})
    assert digest(path) == digest(whole)
    build_store(flat, flat.grid, path, provenance={}, replace=True)
    assert info(path)["rows"] == 9
    (tmp_path / "notes.txt").write_text("keep me, " * 100)
    with pytest.raises(InputError, match="no terrasim store"):
        build_store(flat, flat.grid, tmp_path / "notes.txt", provenance={}, replace=True)
    assert (tmp_path / "notes.txt").read_text() == "keep me, " * 100
    assert names(tmp_path) == ["hills.terrain", "notes.txt"]


def test_a_store_in_use_is_not_replaced(whole: Path, tmp_path: Path) -> None:
    """Its log would be taken for the new one's."""
    path = tmp_path / "hills.terrain"
    path.write_bytes(whole.read_bytes())
    reader = apsw.Connection(str(path))
    reader.execute("BEGIN; SELECT count(*) FROM block").fetchall()
    flat = ArraySource(np.zeros((9, 9), np.int32), Grid(9, 9, 1.0))
    with pytest.raises(RunError, match="in use by another process"):
        build_store(flat, flat.grid, path, provenance={}, replace=True)
    reader.close()
    assert digest(path) == digest(whole)
    assert names(tmp_path) == ["hills.terrain"]


def test_two_builds_of_one_store_do_not_mix(whole: Path, tmp_path: Path) -> None:
    """The second is refused; the first goes on."""
    path = tmp_path / "hills.terrain"

    class Rival(Hills):
        def read_rows(self, row: int, count: int) -> Counts:
            with pytest.raises(RunError, match="is being written by another process"):
                build_store(Hills(), GRID, path, provenance={})
            return super().read_rows(row, count)

    build_store(Rival(), GRID, path, provenance={"made": "here"})
    assert digest(path) == digest(whole)


def test_provenance_may_be_told_when_all_rows_are_read(tmp_path: Path) -> None:
    """Some counts are known only then."""

    class Counting(Hills):
        rows = 0

        def read_rows(self, row: int, count: int) -> Counts:
            self.rows += count
            return super().read_rows(row, count)

    rows = Counting()
    build_store(rows, GRID, tmp_path / "s", provenance=lambda: {"rows read": rows.rows})
    assert info(tmp_path / "s")["provenance"] == {"rows read": 1300}


@pytest.mark.parametrize("provenance", [{"nodata": float("nan")}, {"file": Path("dem")}])
def test_provenance_that_is_no_json_is_refused_before_the_work(
    tmp_path: Path, provenance: object
) -> None:
    """NaN is none."""
    unread = Broken(AssertionError("a row was read"), at=0)
    with pytest.raises(InputError, match="provenance must be JSON"):
        build_store(unread, GRID, tmp_path / "s", provenance=provenance)
    assert names(tmp_path) == []


def test_progress_goes_from_zero_to_one(tmp_path: Path) -> None:
    """In order, through both passes."""
    told: list[tuple[float, str]] = []
    build_store(
        Hills(), GRID, tmp_path / "s", provenance={}, progress=lambda *said: told.append(said)
    )
    fractions = [fraction for fraction, _ in told]
    assert 0.0 < fractions[0] < 0.2
    assert fractions == sorted(fractions)
    assert told[-1] == (1.0, "done")
    assert list(dict.fromkeys(said for _, said in told)) == [
        "writing levels",
        "measuring errors",
        "done",
    ]


def test_memory_does_not_grow_with_the_rows(tmp_path: Path) -> None:
    """Twice the rows take the same peak: all buffers are full long before."""
    peaks = []
    for rows in (12_000, 24_000):
        tracemalloc.start()
        build_store(Hills(256), Grid(rows, 256, 1.0), tmp_path / f"{rows}", provenance={})
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[1] < peaks[0] + 1_000_000
    assert peaks[1] < 24_000 * 256 * 4
