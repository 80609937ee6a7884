"""A store of schema version 1 is read as it is, and brought up when it is first written."""

from __future__ import annotations

import shutil
from pathlib import Path

import apsw
import pytest
from power_loss import Log, RecordingVFS
from stored import NEAR, build, changed, same, source

from terrasim.errors import InputError
from terrasim.store.branch import open_branch
from terrasim.store.history import history
from terrasim.store.info import info
from terrasim.store.names import branches, snapshots
from terrasim.store.records import SCHEMA
from terrasim.store.store import open_store
from terrasim.store.store_file import SCHEMA_VERSION
from terrasim.store.verify import verify


def older(path: Path) -> Path:
    """A store as version 1 made it."""
    build(path)
    db = apsw.Connection(str(path))
    for line in SCHEMA.split("CREATE TABLE ")[1:]:
        db.execute(f"DROP TABLE {line.split()[0]}")
    db.pragma("user_version", 1)
    db.execute("VACUUM")
    db.close()
    return path


def tables(path: Path) -> set[object]:
    """Names of a file's tables."""
    db = apsw.Connection(str(path))
    found = {row[0] for row in db.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")}
    db.close()
    return found


def test_an_older_store_is_read_and_stays_as_it_is(tmp_path: Path) -> None:
    """By readers, by verification."""
    path = older(tmp_path / "a.store")
    before = path.read_bytes()
    with open_store(path) as store:
        assert store.schema_version == 1
        assert same(store.block(NEAR), source().block(NEAR))
    assert info(path)["schema_version"] == 1
    assert verify(path)["sound"]
    assert not snapshots(path)
    assert not branches(path)
    for act in (
        lambda: open_store(path, branch="main"),
        lambda: open_store(path, snapshot="x"),
        lambda: history(path),
    ):
        with pytest.raises(InputError, match="schema version 1 and has no branches"):
            act()
    assert path.read_bytes() == before
    assert tables(path) == {"meta", "blob", "block"}


def test_an_older_store_is_brought_up_when_it_is_written(tmp_path: Path) -> None:
    """In place; what was imported is untouched."""
    path = older(tmp_path / "a.store")
    with open_branch(path) as branch:
        assert same(branch.block(NEAR), source().block(NEAR))
        branch.checkpoint({NEAR: changed(branch, NEAR, 1)}, branch.append(b"op"))
    with open_store(path) as store:
        assert store.schema_version == SCHEMA_VERSION == 2
        assert same(store.block(NEAR), changed(source(), NEAR, 1))
    assert verify(path)["sound"]
    assert [row.op for row in history(path)] == [b"op"]


def test_a_newer_store_is_refused(tmp_path: Path) -> None:
    """For writing and for reading; nothing is changed."""
    path = build(tmp_path / "a.store")
    db = apsw.Connection(str(path))
    db.pragma("user_version", 3)
    db.close()
    before = path.read_bytes()
    for act in (open_branch, open_store, verify):
        with pytest.raises(InputError, match="schema version 3, this release reads 1 to 2"):
            act(path)
    assert path.read_bytes() == before


def test_power_may_fail_while_it_is_brought_up(tmp_path: Path) -> None:
    """It is of the one version or of the other, whole."""
    path, log = older(tmp_path / "a.store"), Log()
    files = {path.name: path.read_bytes()}
    vfs = RecordingVFS("recording-migrate", log)
    open_branch(path, vfs="recording-migrate").close()
    vfs.unregister()
    seen = set()
    for end in range(1, len(log.events) + 1, 3):
        folder = tmp_path / f"crash-{end}"
        folder.mkdir()
        for name, content in log.crash(end, end % 4, dict(files)).items():
            (folder / name).write_bytes(content)
        copy = folder / path.name
        with open_store(copy) as store:
            seen.add(store.schema_version)
            assert same(store.block(NEAR), source().block(NEAR))
        open_branch(copy).close()
        assert verify(copy)["sound"]
        shutil.rmtree(folder)
    assert seen == {1, 2}
