"""The commands on stores that check, export and collect: what they say is true."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from edited_ground import held
from store_commands import ALL, GRID, LISTS, Ran, hill, one_line, play, posts, runner, told
from stored import alter, killed

import terrasim as ts
from terrasim.counts import HOLE, to_metres
from terrasim.deform.edits import edits_of
from terrasim.store.branch import open_branch
from terrasim.store.history import history


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


def test_a_sound_store_is_said_to_be(ran: Ran, store: Path) -> None:
    found = told(ran, "verify", store)
    assert (found["sound"], found["problems"], found["store"]) == (True, [], str(store))
    assert (found["journal_rows"], found["branches"], found["snapshots"]) == (5, 1, 1)
    status, out, error = ran("verify", store)
    assert (status, error) == (0, "")
    assert "sound: True" in out


@pytest.mark.parametrize("imported", [True, False])
def test_a_damaged_block_is_named_and_never_read(ran: Ran, store: Path, imported: bool) -> None:
    """One of the import, or one that was changed: ``verify`` says which, with status 1."""
    which, block = ("min", "block (0, -1, 0)") if imported else ("max", "block (0, 0, 0)")
    sql = f"(SELECT {which}(id) FROM blob WHERE codec != 2)"
    assert alter(store, f"UPDATE blob SET data = zeroblob(9) WHERE id = {sql}") == 1
    rows = held(store)
    status, out, error = ran("verify", store, "--json")
    found = json.loads(out)
    assert (status, error, found["sound"]) == (1, "", False)
    assert any(block in one for one in found["problems"]), found["problems"]
    status, out, _ = ran("verify", store)
    assert status == 1
    assert "sound: False" in out
    assert block in out
    for words in (("export", store, "a.tif"), ("export", store, "a.exr"), ("backup", store, "b")):
        status, out, error = ran(*words)
        assert (status, out) == (1, ""), words
        one_line(error)
    assert held(store) == rows
    assert {one.name for one in Path().iterdir()} == {"s"}


def test_a_store_cut_short_is_one_line_for_every_command(ran: Ran, store: Path) -> None:
    """Wherever it is cut: status 1 or 2, no traceback, and nothing is made."""
    whole = store.read_bytes()
    for size in (1, 100, 3000, 4096, len(whole) // 2, len(whole) - 4096):
        for first, *rest in ALL:
            for one in store.parent.iterdir():
                one.unlink()
            store.write_bytes(whole[:size])
            status, out, error = ran(first, store, *rest)
            if first == "verify" and status == 1:
                assert "sound: False" in out
                continue
            assert status in {1, 2} or first in LISTS, (size, first)
            assert not status or one_line(error)
            assert {one.name for one in Path().iterdir()} == {"s"}


def test_a_geotiff_of_a_snapshot_has_its_crs_place_and_exact_heights(ran: Ran, store: Path) -> None:
    import rasterio

    said = told(ran, "export", store, "a.tif", "--snapshot", "three")
    assert said["file"] == "a.tif"
    assert (said["rows"], said["cols"], said["spacing_m"], said["holes"]) == (60, 50, 0.5, 1)
    assert (said["crs"], said["rounding_m"]) == ("EPSG:32611", 0.0)
    assert said["bytes"] == Path("a.tif").stat().st_size
    want = posts(store, snapshot="three")
    with rasterio.open("a.tif") as file:
        found = file.read(1)
        assert file.crs.to_epsg() == 32611
        assert file.xy(0, 0) == (GRID.post_x(GRID.col), GRID.post_y(GRID.row + GRID.rows - 1))
    metres = to_metres(want, GRID.datum)
    np.testing.assert_array_equal(found, np.where(want == HOLE, np.nan, metres))
    told(ran, "export", store, "b.tif")
    told(ran, "export", store, "c.tif", "--branch", "main")
    with rasterio.open("b.tif") as newest, rasterio.open("c.tif") as main:
        np.testing.assert_array_equal(newest.read(1), main.read(1))
        metres = to_metres(posts(store), GRID.datum)
        assert np.nanmax(np.abs(newest.read(1) - metres)) == 0.0
        assert not np.array_equal(newest.read(1), found, equal_nan=True)


def test_an_exr_has_the_heights_as_near_as_it_says(ran: Ran, store: Path) -> None:
    import OpenImageIO

    said = told(ran, "export", store, "a.exr", "--snapshot", "three")
    image = OpenImageIO.ImageBuf("a.exr")
    pixels = np.asarray(image.get_pixels(OpenImageIO.FLOAT)).reshape(GRID.rows, GRID.cols)
    want = posts(store, snapshot="three")
    metres = np.where(want == HOLE, np.nan, to_metres(want, GRID.datum))
    assert np.isnan(pixels).sum() == said["holes"] == 1
    apart = float(np.nanmax(np.abs(pixels.astype(np.float64) - metres)))
    assert apart == said["rounding_m"]
    assert 0.0 < apart <= 2.0**-18
    assert image.spec().getattribute("terrasim:crs") == "EPSG:32611"
    status, out, _ = ran("export", store, "b.exr")
    assert status == 0
    assert out.startswith("file: b.exr\nrows: 60\n")


def test_a_collection_lets_go_of_what_nobody_needs_and_says_how_much(ran: Ran, store: Path) -> None:
    """And no more: heights and snapshot stay."""
    early = posts(store, snapshot="three")
    ran("reset", store, "three")
    found = told(ran, "collect", store)
    assert set(found) == {
        "store",
        "trimmed_rows",
        "checkpoints",
        "epochs",
        "rows",
        "blobs",
        "bytes",
    }
    assert (found["rows"], found["trimmed_rows"]) == (2, 0)
    assert found["blobs"] > 0
    np.testing.assert_array_equal(posts(store, snapshot="three"), early)
    np.testing.assert_array_equal(posts(store), early)
    assert told(ran, "verify", store)["unused_blobs"] == 0
    again = told(ran, "collect", store)
    assert [again[key] for key in ("checkpoints", "epochs", "rows", "blobs")] == [0, 0, 0, 0]
    status, out, _ = ran("collect", store)
    assert status == 0
    assert "trimmed_rows: 0\n" in out


def test_a_collection_keeps_as_many_rows_as_it_is_told(ran: Ran, store: Path) -> None:
    """Counted back from the branch, row 5, and from the snapshot, row 3; what is later stays."""
    early, late = posts(store, snapshot="three"), posts(store)
    assert told(ran, "collect", store, "--keep", 10**30)["trimmed_rows"] == 0
    assert told(ran, "collect", store, "--keep", 5)["trimmed_rows"] == 0
    found = told(ran, "collect", store, "--keep", 2)
    assert (found["trimmed_rows"], found["rows"]) == (1, 0)
    assert [row.seq for row in history(store)] == [5, 4, 3, 2]
    status, out, _ = ran("collect", store, "--keep", 0)
    assert status == 0
    np.testing.assert_array_equal(posts(store, snapshot="three"), early)
    assert "trimmed_rows: 2\n" in out
    assert [row.seq for row in history(store)] == [5, 4]
    status, _, error = ran("undo", store, 3)
    assert status == 2
    assert "operation 3 is not in the journal" in one_line(error)
    ran("snapshot", store, "three", "--drop")
    assert told(ran, "collect", store, "--keep", 0)["trimmed_rows"] == 2
    assert history(store) == []
    np.testing.assert_array_equal(posts(store), late)
    assert told(ran, "verify", store)["sound"]
    with ts.open_terrain(store) as terrain:
        assert edits_of(terrain).commit(hill(0.0)).seq == 6


def test_rows_that_no_checkpoint_holds_are_kept_by_a_collection(
    ran: Ran, store: Path, tmp_path: Path
) -> None:
    with open_branch(store) as branch:
        branch.append(b"waits")
        killed(store, tmp_path / "k")
    assert told(ran, "collect", "k/hill.store", "--keep", 0)["trimmed_rows"] == 3
    assert told(ran, "snapshot", "k/hill.store")["snapshots"][0]["name"] == "three"
    assert [row.seq for row in history("k/hill.store")] == [6, 5, 4]
    with open_branch("k/hill.store") as branch:
        branch.drop_snapshot("three")
        assert branch.trim(0) == 2
        assert [op for _, op, _ in branch.pending()] == [b"waits"]
