"""The commands on stores: what they print is true, and what is refused changes nothing."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import apsw
import numpy as np
import pytest
from edited_ground import held
from store_commands import (
    ALL,
    GRID,
    LISTS,
    Ran,
    files,
    fresh,
    hill,
    one_line,
    play,
    posts,
    runner,
    told,
)
from stored import killed

import terrasim as ts
from terrasim.deform.edits import edits_of
from terrasim.store.history import history
from terrasim.store.names import branches, snapshots


@pytest.fixture
def ran(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Ran:
    """Runs a command in a folder of its own."""
    monkeypatch.chdir(tmp_path)
    return runner(capsys)


@pytest.fixture(scope="module")
def played(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What all tests begin with; do not change it."""
    return play(tmp_path_factory.mktemp("cli") / "hill.store")


@pytest.fixture
def store(played: Path, tmp_path: Path) -> Path:
    """A copy of it to be changed, by the name ``s/hill.store``."""
    killed(played, tmp_path / "s")
    return Path("s/hill.store")


def test_the_history_is_the_journal_s_newest_rows_first(ran: Ran, store: Path) -> None:
    rows = told(ran, "history", store)["operations"]
    assert [
        (row["seq"], row["summary"], row["idempotency_key"], row["engine"], row["bytes"])
        for row in rows
    ] == [(row.seq, row.summary, row.idem, row.engine, len(row.op)) for row in history(store)]
    assert [row["seq"] for row in rows] == [5, 4, 3, 2, 1]
    assert all(re.fullmatch(r"\d{4}-\d\d-\d\d \d\d:\d\d:\d\d", row["time"]) for row in rows)
    assert [row["seq"] for row in told(ran, "history", store, "--limit", 2)["operations"]] == [5, 4]
    assert told(ran, "history", store, "--limit", 0)["operations"] == []
    assert len(told(ran, "history", store, "--limit", 10**30)["operations"]) == 5


def test_tables_show_keys_and_names_as_they_are(
    ran: Ran, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No markup and no emoji is made of them, and a long name is not cut off."""
    status, out, _ = ran("history", store)
    assert status == 0
    assert "…" not in out
    monkeypatch.setenv("COLUMNS", "160")
    _, out, _ = ran("history", store, "--limit", 3)
    assert " job:x:2 [red] " in out
    monkeypatch.setenv("COLUMNS", "80")
    long = "n" * 64
    status, out, _ = ran("snapshot", store, long)
    assert status == 0
    assert out.count("n") > 64
    assert "…" not in out
    _, out, _ = ran("export", store, "a:x:b.tif")
    assert out.splitlines()[0] == "file: a:x:b.tif"


def test_without_a_name_names_are_listed_and_nothing_is_written(ran: Ran, store: Path) -> None:
    before = files(store.parent)
    one, other = told(ran, "snapshot", store), told(ran, "branch", store)
    assert [(row["name"], row["seq"], row["branch"]) for row in one["snapshots"]] == [
        ("three", 3, "main")
    ]
    assert [(row["name"], row["seq"]) for row in other["branches"]] == [("main", 5)]
    for name in LISTS:
        assert ran(name, store)[0] == 0
    assert {name: data for name, data in files(store.parent).items() if name in before} == before


def test_a_fresh_store_has_nothing_to_list(ran: Ran, tmp_path: Path) -> None:
    fresh(tmp_path / "a.store")
    for name, what in zip(LISTS, ("operations", "snapshots", "branches"), strict=True):
        assert ran(name, "a.store") == (0, f"no {what}\n", "")
        assert told(ran, name, "a.store")[what] == []


def test_a_snapshot_is_the_state_of_its_branch_and_can_be_dropped(ran: Ran, store: Path) -> None:
    rows = told(ran, "snapshot", store, "five")["snapshots"]
    assert {row["name"]: row["seq"] for row in rows} == {"five": 5, "three": 3}
    np.testing.assert_array_equal(posts(store, snapshot="five"), posts(store))
    assert not np.array_equal(posts(store, snapshot="three"), posts(store))
    rows = told(ran, "snapshot", store, "three", "--drop")["snapshots"]
    assert [row["name"] for row in rows] == ["five"]
    assert list(snapshots(store)) == ["five"]


def test_a_branch_begins_at_the_state_it_is_told(ran: Ran, store: Path) -> None:
    told(ran, "branch", store, "now")
    rows = told(ran, "branch", store, "early", "--at", "three")["branches"]
    assert [row["name"] for row in rows] == ["early", "main", "now"] == sorted(branches(store))
    np.testing.assert_array_equal(posts(store, branch="now"), posts(store))
    np.testing.assert_array_equal(posts(store, branch="early"), posts(store, snapshot="three"))
    assert len(told(ran, "history", store, "--branch", "early")["operations"]) == 3
    told(ran, "snapshot", store, "s", "--branch", "early")
    assert snapshots(store)["s"].branch == "early"
    assert [row["name"] for row in told(ran, "branch", store, "now", "--drop")["branches"]] == [
        "early",
        "main",
    ]


def test_what_waits_for_a_checkpoint_is_in_a_snapshot_and_a_branch(
    ran: Ran, store: Path, tmp_path: Path
) -> None:
    """As it stands when a writer was killed."""
    with ts.open_terrain(store) as terrain:
        edits_of(terrain).commit(hill(3.0))
        killed(store, tmp_path / "k")
    copy = Path("k/hill.store")
    assert branches(copy)["main"].seq == 5
    told(ran, "snapshot", copy, "six")
    told(ran, "branch", copy, "dev")
    assert (snapshots(copy)["six"].seq, len(history(copy, "dev"))) == (6, 6)
    np.testing.assert_array_equal(posts(copy, snapshot="six"), posts(store))


def test_a_reset_goes_back_exactly(ran: Ran, store: Path) -> None:
    want = posts(store, snapshot="three")
    assert told(ran, "reset", store, "three") == {
        "store": str(store),
        "branch": "main",
        "reset_to": "three",
    }
    np.testing.assert_array_equal(posts(store), want)
    status, out, _ = ran("reset", store, "three", "--branch", "main")
    assert (status, out) == (0, f"store: {store}\nbranch: main\nreset_to: three\n")


def test_an_undo_takes_back_one_operation_exactly(ran: Ran, store: Path) -> None:
    """The same posts as without it, and the ledger says how much went."""
    ran("branch", store, "dev", "--at", "three")
    ran("branch", store, "two", "--at", "three")
    before = posts(store, branch="dev").astype(np.int64)
    found = told(ran, "undo", store, 2, "--branch", "dev")
    after = posts(store, branch="dev")
    assert (found["undone"], found["seq"]) == (2, 6)
    assert found["ledger"]["removed"] == int((before - after).sum()) > 0
    np.testing.assert_array_equal(posts(store, branch="two"), before)
    assert told(ran, "history", store, "--branch", "dev")["operations"][0]["seq"] == 6
    status, out, _ = ran("undo", store, 3, "--branch", "dev")
    assert status == 0
    assert "undone: 3" in out
    left = posts(store, branch="dev").astype(np.int64)
    with ts.open_terrain(fresh(store.parent / "a.store")) as terrain:
        edits_of(terrain).commit(hill(0.0))
    np.testing.assert_array_equal(left, posts(store.parent / "a.store"))


@pytest.mark.parametrize(
    ("words", "what"),
    [
        ("history S --branch no", "there is no branch 'no'; the store has main"),
        ("history S --limit -1", "limit must not be negative, got -1"),
        ("history S --limit many", "Invalid value for '--limit'"),
        ("snapshot S three", "there is a snapshot 'three' already; choose another name"),
        ("snapshot S no --drop", "there is no snapshot 'no'; the store has three"),
        ("snapshot S -- -x", "a name is 1 to 64 letters"),
        ("snapshot S a --branch no", "there is no branch 'no'; the store has main"),
        ("snapshot S --drop", "--drop needs a name, got none"),
        ("branch S main", "there is a branch 'main' already; choose another name"),
        ("branch S main --drop", "'main' cannot be dropped"),
        ("branch S no --drop", "there is no branch 'no'; the store has main"),
        ("branch S a/b", "a name is 1 to 64 letters"),
        ("branch S dev --at no", "there is no snapshot 'no'; the store has three"),
        ("branch S --at three", "--at needs a name, got none"),
        ("branch S --drop", "--drop needs a name, got none"),
        ("branch S dev --drop --at three", "give one, got both"),
        ("reset S", "Missing argument"),
        ("reset S no", "there is no snapshot 'no'; the store has three"),
        ("reset S three --branch no", "there is no branch 'no'; the store has main"),
        ("undo S 6", "operation 6 is not in the journal of this branch; see its history"),
        ("undo S -- -1", "operation -1 is not in the journal"),
        ("undo S 99999999999999999999999", "is not in the journal of this branch"),
        ("undo S one", "Invalid value for 'seq'"),
        ("undo S 4", "operation 5 (1 x fill gaussian) built on it; reset to a snapshot instead"),
        ("undo S 5", "operation 5 did more than add; reset to a snapshot instead"),
        ("undo S 1 --branch no", "there is no branch 'no'; the store has main"),
        ("collect S --keep -1", "Invalid value for '--keep'"),
        ("collect S --keep few", "Invalid value for '--keep'"),
        ("backup S", "Missing argument"),
        ("backup S S", "is the store itself; choose another name"),
        ("backup S S --replace", "is the store itself; choose another name"),
        ("backup S text", "text exists; remove it or choose another name"),
        ("backup S text --replace", "text is no terrasim store"),
        ("backup S none/b", "there is no folder none"),
        ("backup S s --replace", "s"),
        ("export S a.png", "exports are .tif, .tiff or .exr, got '.png'"),
        ("export S a", "exports are .tif, .tiff or .exr, got 'none'"),
        ("export S taken.tif", "taken.tif exists; remove it or choose another name"),
        ("export S none/a.tif", "there is no folder none"),
        ("export S a.tif --snapshot no", "there is no snapshot 'no'; the store has three"),
        ("export S a.exr --branch no", "there is no branch 'no'; the store has main"),
        ("export S a.tif --branch main --snapshot three", "give a branch or a snapshot, got both"),
        ("export S \udcff.tif", "names must be UTF-8"),
        ("backup S \udcff.store", "names must be UTF-8"),
    ],
)
def test_bad_input_is_one_line_and_status_2_and_changes_nothing(
    ran: Ran, store: Path, tmp_path: Path, words: str, what: str
) -> None:
    (tmp_path / "text").write_text("mine")
    (tmp_path / "taken.tif").write_text("mine")
    rows = held(store)
    # Looking so leaves the files in which readers share a log.
    there = set(tmp_path.rglob("*"))
    status, out, error = ran(*[str(store) if word == "S" else word for word in words.split()])
    assert what in one_line(error)
    assert (status, out) == (2, "")
    assert set(tmp_path.rglob("*")) <= there
    assert held(store) == rows
    assert (tmp_path / "text").read_text() == (tmp_path / "taken.tif").read_text() == "mine"


@pytest.mark.parametrize("json_too", [False, True])
def test_what_is_no_store_is_refused_by_every_command(
    ran: Ran, tmp_path: Path, json_too: bool
) -> None:
    """And is left as it is, with nothing made beside it."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "empty").write_bytes(b"")
    (tmp_path / "text").write_text("heights " * 2000)
    db = apsw.Connection(str(tmp_path / "other.db"))
    db.execute("CREATE TABLE mine (x)")
    db.close()
    before = files(tmp_path)
    for name, what in (
        ("none", "there is no store at none; make one with terrasim import"),
        ("folder", "folder is no file; name a terrasim store"),
        ("empty", "empty is no terrasim store"),
        ("text", "text is no terrasim store"),
        ("other.db", "other.db is no terrasim store"),
    ):
        for first, *rest in ALL:
            status, out, error = ran(first, name, *rest, *["--json"] * json_too)
            assert what in one_line(error), (first, rest)
            assert (status, out) == (2, ""), (first, rest)
    assert files(tmp_path) == before


HOLDER = """
import sys
from terrasim.store.branch import open_branch
with open_branch(sys.argv[1]) as branch:
    branch.append(b"mine")
    print("held", flush=True)
    sys.stdin.readline()
"""


def test_a_second_writer_is_refused_and_readers_are_not(ran: Ran, store: Path) -> None:
    """While another process writes; it is not disturbed."""
    with subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(store)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    ) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        before = held(store)
        for first, *rest in (
            ("snapshot", "a"),
            ("branch", "a", "--at", "three"),
            ("reset", "three"),
            ("undo", "3"),
            ("collect", "--keep", "1"),
        ):
            status, out, error = ran(first, store, *rest)
            assert (status, out) == (1, ""), first
            assert f"{store} is open for writing already; a store has one writer" in one_line(error)
        assert told(ran, "history", store)["operations"][0]["seq"] == 6
        assert told(ran, "verify", store)["journal_rows"] == 6
        assert told(ran, "backup", store, "copy.store")["journal_rows"] == 6
        assert told(ran, "export", store, "a.tif")["rows"] == GRID.rows
        assert [row["name"] for row in told(ran, "snapshot", store)["snapshots"]] == ["three"]
        assert held(store) == before
        holder.communicate("\n")
    assert holder.returncode == 0
    assert history(store)[0].op == b"mine"


def test_a_backup_is_the_store_as_it_is_while_it_is_written(ran: Ran, store: Path) -> None:
    """With rows that no checkpoint holds; going on leaves the copy alone."""
    with ts.open_terrain(store) as terrain:
        edits_of(terrain).commit(hill(3.0))
        said = told(ran, "backup", store, "copy.store")
        assert held(Path("copy.store")) == held(store)
        edits_of(terrain).commit(hill(4.0))
    assert (said["store"], said["sound"], said["journal_rows"]) == ("copy.store", True, 6)
    assert [row.seq for row in history("copy.store")] == [6, 5, 4, 3, 2, 1]
    status, out, _ = ran("backup", store, "copy.store", "--replace")
    assert status == 0
    assert "store: copy.store\nsound: True\nproblems: []\n" in out
    assert history("copy.store")[0].seq == 7
    np.testing.assert_array_equal(posts(Path("copy.store")), posts(store))
