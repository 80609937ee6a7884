"""A store gives back what was built, or says why not."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import apsw
import numpy as np
import pytest

from terrasim.counts import HOLE, Counts
from terrasim.errors import InputError, RunError
from terrasim.grid import Block, Grid
from terrasim.sources.array_source import ArraySource
from terrasim.store.build import build_store
from terrasim.store.info import info
from terrasim.store.store import StoreCorrupt, StoreSource, open_store
from terrasim.store.store_file import APPLICATION_ID, SCHEMA_VERSION

GRID = Grid(600, 530, 0.1 + 0.2, x=1 / 3, y=-5e6, row=-300, col=77, datum=1234.5, crs="EPSG:32611")
PROVENANCE = {"files": ["a.tif", "b.tif"], "unit": "metre", "filled": 12, "seam": {"max": 0.5}}


def ground() -> Counts:
    """Smooth ground with noise, two holes and a level part."""
    rng = np.random.default_rng(7)
    y, x = np.mgrid[0 : GRID.rows, 0 : GRID.cols] / 100.0
    posts: Counts = np.rint(1e5 * np.sin(x) * np.cos(y) + rng.normal(0, 50, x.shape)).astype(
        np.int32
    )
    posts[:300, -200:] = 4242
    posts[40, 50] = posts[500, 10] = HOLE
    return posts


@pytest.fixture(scope="module")
def source() -> ArraySource:
    """The terrain in memory."""
    return ArraySource(ground(), GRID)


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory, source: ArraySource) -> Path:
    """The same as a store; do not change it."""
    path = tmp_path_factory.mktemp("store") / "hill.terrain"
    build_store(source, GRID, path, provenance=PROVENANCE, synthetic="noise (seed 7)")
    return path


@pytest.fixture
def copy(built: Path, tmp_path: Path) -> Path:
    """A copy to damage."""
    path = tmp_path / "copy.terrain"
    shutil.copy(built, path)
    return path


def keys(grid: Grid) -> list[Block]:
    """All blocks of all levels."""
    spans = [(level, grid.blocks(level)) for level in range(grid.levels)]
    return [
        Block(level, row, col)
        for level, span in spans
        for row in range(span.row0, span.row1)
        for col in range(span.col0, span.col1)
    ]


def same(store: StoreSource, source: ArraySource, key: Block) -> bool:
    """Whether a block is the source's in all it says."""
    got, wanted = store.block(key), source.block(key)
    numbers = (got.lowest, got.highest, got.error) == (wanted.lowest, wanted.highest, wanted.error)
    return numbers and bool(np.array_equal(got.posts, wanted.posts))


def test_every_block_is_the_sources_with_its_range_and_error(
    built: Path, source: ArraySource
) -> None:
    """All levels, the extended edges and negative indices included."""
    with open_store(built) as store:
        assert all(same(store, source, key) for key in keys(GRID))
        assert len(keys(GRID)) == store.summary["blocks"] == 12 + 4 + 2


def test_posts_are_the_sources_at_any_indices(built: Path, source: ArraySource) -> None:
    """Out of order, repeated, far outside, one at a time, none at all."""
    rng = np.random.default_rng(1)
    rows, cols = rng.integers(-900, 900, (2, 60))
    cases: list[tuple[list[int], list[int]]] = [
        (rows.tolist(), cols.tolist()),
        (list(range(-310, 310)), list(range(60, 620))),
        ([5, 5, -(2**30)], [2**30, 256, 255]),
        ([0], [100]),
        ([], [100]),
        ([3], []),
    ]
    with open_store(built) as store:
        for level in range(GRID.levels):
            for r, c in cases:
                at = np.array(r, dtype=np.int64), np.array(c, dtype=np.int64)
                got = store.posts(level, *at)
                assert got.dtype == np.int32
                np.testing.assert_array_equal(got, source.posts(level, *at))


def test_placement_and_provenance_survive_to_the_last_bit(built: Path) -> None:
    """Also those numbers that decimals do not hold."""
    with open_store(built) as store:
        assert store.grid == GRID
        assert store.provenance == PROVENANCE
        assert store.synthetic == "noise (seed 7)"


def test_info_says_what_is_there(built: Path, source: ArraySource) -> None:
    """Sizes, range, holes, errors a level, provenance."""
    said = info(built)
    assert (said["rows"], said["cols"], said["spacing"]) == (600, 530, GRID.spacing)
    assert (said["crs"], said["datum"], said["holes"]) == ("EPSG:32611", 1234.5, 2)
    posts = ground()
    assert said["lowest_m"] == pytest.approx(posts[posts != HOLE].min() * 1e-5 + 1234.5)
    assert said["highest_m"] == pytest.approx(posts.max() * 1e-5 + 1234.5)
    assert said["bytes"] == built.stat().st_size
    assert said["bytes_per_post"] == said["bytes"] / (600 * 530)
    assert said["ratio"] == pytest.approx(4 / said["bytes_per_post"])
    for level, row in enumerate(said["levels"]):
        errors = [source.block(key).error for key in keys(GRID) if key.level == level]
        assert (row["blocks"], row["error"]) == (len(errors), max(errors))
    assert said["blobs"] < said["blocks"]
    assert (said["provenance"], said["synthetic"]) == (PROVENANCE, "noise (seed 7)")


def test_a_terrain_of_holes_alone_has_no_range(tmp_path: Path) -> None:
    """Its information is still JSON: no NaN."""
    grid = Grid(3, 4, 1.0)
    holes = ArraySource(np.full((3, 4), HOLE, np.int32), grid)
    build_store(holes, grid, tmp_path / "void", provenance={})
    said = info(tmp_path / "void")
    assert (said["lowest_m"], said["highest_m"], said["holes"]) == (None, None, 12)
    with open_store(tmp_path / "void") as store:
        assert same(store, holes, Block(0, 0, 0))


def test_many_threads_read_at_once(built: Path, source: ArraySource) -> None:
    """Each gets what it asked for."""
    wanted = keys(GRID) * 4
    np.random.default_rng(0).shuffle(wanted)
    rows, cols = np.arange(-300, 300), np.arange(77, 607)
    with open_store(built) as store, ThreadPoolExecutor(6) as pool:
        blocks = pool.map(lambda key: same(store, source, Block(*key)), wanted)
        posts = pool.map(lambda _: store.posts(0, rows, cols), range(4))
        assert all(blocks)
        for got in posts:
            np.testing.assert_array_equal(got, ground())


def test_a_reader_waits_for_no_other_reader(
    built: Path, source: ArraySource, monkeypatch: pytest.MonkeyPatch
) -> None:
    """While one thread is held up in decoding, another reads the same store."""
    with open_store(built) as store, ThreadPoolExecutor(1) as pool:

        def decode_slowly(blob: bytes) -> Counts:
            monkeypatch.undo()
            assert pool.submit(same, store, source, Block(1, -1, 0)).result(timeout=60)
            return ground()[:256, :256]

        monkeypatch.setattr("terrasim.store.imported.unpack", decode_slowly)
        store.posts(0, np.array([0]), np.array([300]))


def test_reading_leaves_one_file_behind(built: Path) -> None:
    """What SQLite keeps beside it is gone when the store is closed."""
    store = open_store(built)
    store.block(Block(0, 0, 1))
    store.close()
    assert [p.name for p in built.parent.iterdir()] == [built.name]


def test_a_closed_store_opens_again_when_it_is_read(built: Path, source: ArraySource) -> None:
    """Closing gives back what is idle and nothing else."""
    store = open_store(built)
    store.close()
    assert same(store, source, Block(0, 0, 1))
    store.close()


def test_the_file_is_marked_and_ready_for_one_writer_and_many_readers(built: Path) -> None:
    """Application id, schema version, write-ahead log, room to give back."""
    db = apsw.Connection(str(built))
    said = [db.pragma(n) for n in ("application_id", "user_version", "journal_mode", "auto_vacuum")]
    assert said == [APPLICATION_ID, SCHEMA_VERSION, "wal", 2]
    assert db.pragma("integrity_check") == "ok"
    db.close()


def test_a_store_that_may_not_be_written_can_be_read(
    built: Path, source: ArraySource, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From a read-only disk, whatever its name, leaving nothing beside it."""
    path = tmp_path / "what? #1 50%.terrain"
    shutil.copy(built, path)
    monkeypatch.setattr(os, "access", lambda _, mode: mode != os.W_OK)
    with open_store(path) as store:
        assert same(store, source, Block(0, 0, 1))
        assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "no terrasim store"),
        (b"ncols 4\nnrows 5\n" * 100, "no terrasim store"),
        (b"SQLite format 3\0", "no terrasim store"),
        (bytes(5000), "no terrasim store"),
    ],
)
def test_another_kind_of_file_is_refused(tmp_path: Path, content: bytes, said: str) -> None:
    """With its name, the rule and the remedy; the file stays as it is."""
    path = tmp_path / "ground.asc"
    path.write_bytes(content)
    with pytest.raises(InputError, match=said) as error:
        open_store(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)
    assert path.read_bytes() == content
    assert len(list(tmp_path.iterdir())) == 1


def test_what_is_not_there_is_refused(tmp_path: Path) -> None:
    """A missing file, a folder."""
    with pytest.raises(InputError, match="there is no store"):
        open_store(tmp_path / "none.terrain")
    with pytest.raises(InputError, match="no file"):
        open_store(tmp_path)
    assert list(tmp_path.iterdir()) == []


def test_another_sqlite_file_is_refused(tmp_path: Path) -> None:
    """By its application id."""
    db = apsw.Connection(str(tmp_path / "mail.db"))
    db.execute("CREATE TABLE meta (key, value); INSERT INTO meta VALUES ('state', 'complete')")
    db.close()
    with pytest.raises(InputError, match="no terrasim store"):
        open_store(tmp_path / "mail.db")


def change(path: Path, sql: str) -> None:
    """Alter a store behind its back."""
    db = apsw.Connection(str(path))
    db.execute(sql).fetchall()
    db.close()


def test_a_newer_schema_is_refused(copy: Path) -> None:
    """With both versions in the message."""
    change(copy, "PRAGMA user_version = 3")
    with pytest.raises(InputError, match="schema version 3, this release reads 1 to 2"):
        open_store(copy)


def test_a_half_built_store_is_refused(copy: Path, tmp_path: Path) -> None:
    """By its mark, and by the name it has while it grows."""
    change(copy, "UPDATE meta SET value = 'building' WHERE key = 'state'")
    with pytest.raises(InputError, match="half-built; run the import again"):
        open_store(copy)
    copy.rename(tmp_path / "next.terrain.building")
    with pytest.raises(InputError, match="half-built; run the import again"):
        open_store(tmp_path / "next.terrain")


def test_an_sqlite_with_the_log_bug_is_refused(
    built: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """3.51.2 is the last that has it."""
    monkeypatch.setattr(apsw, "sqlite_lib_version", lambda: "3.51.2")
    with pytest.raises(RunError, match=r"3\.51\.3 or newer"):
        open_store(built)


@pytest.mark.parametrize(
    "sql",
    [
        "DELETE FROM block WHERE level = 0 AND row = 0 AND col = 1",
        "UPDATE block SET blob = (SELECT blob FROM block WHERE level = 1 LIMIT 1) WHERE level = 0",
        "UPDATE block SET error = error + 1",
        "UPDATE block SET lowest = lowest - 1",
        "UPDATE block SET highest = highest + 0.5",
        "UPDATE block SET row = row + 4 WHERE row < 0; UPDATE block SET row = row - 1",
        "UPDATE blob SET data = substr(data, 1, length(data) - 1)",
        "UPDATE blob SET data = 'text'",
        "UPDATE blob SET hash = randomblob(16)",
        "DROP TABLE block",
    ],
)
def test_what_was_altered_is_never_read_as_ground(copy: Path, sql: str) -> None:
    """A lost row, a row that points elsewhere, other numbers, other bytes."""
    change(copy, sql)
    with open_store(copy) as store:
        with pytest.raises(StoreCorrupt) as error:
            store.block(Block(0, 0, 1))
        assert str(copy) in str(error.value)
        assert "\n" not in str(error.value)
        with pytest.raises(StoreCorrupt):
            store.posts(0, np.array([10]), np.array([300]))


@pytest.mark.parametrize(
    "sql",
    [
        "DELETE FROM meta WHERE key = 'grid'",
        "UPDATE meta SET value = replace(value, '77', '78')",
        "DELETE FROM meta",
        "UPDATE meta SET value = 'ready' WHERE key = 'state'",
    ],
)
def test_altered_meta_rows_are_refused(copy: Path, sql: str) -> None:
    """A terrain is never read in another place."""
    change(copy, sql)
    with pytest.raises(StoreCorrupt, match="meta rows are damaged"):
        open_store(copy)


def every_read_is_right_or_refused(path: Path, source: ArraySource) -> int:
    """Returns how many reads were refused, opening counted as all of them."""
    refused = 0
    try:
        store = open_store(path)
    except (InputError, RunError):
        return len(keys(GRID))
    assert store.grid == GRID
    for key in keys(GRID):
        try:
            assert same(store, source, key)
        except StoreCorrupt:
            refused += 1
    store.close()
    return refused


@pytest.mark.parametrize("length", [1, 99, 100, 4095, 4096, 50_000, -4096, -1])
def test_a_file_that_is_cut_short_is_refused(copy: Path, source: ArraySource, length: int) -> None:
    """Wherever it ends."""
    os.truncate(copy, length if length > 0 else copy.stat().st_size + length)
    assert every_read_is_right_or_refused(copy, source) == len(keys(GRID))


def test_a_flipped_bit_anywhere_never_gives_wrong_heights(
    built: Path, tmp_path: Path, source: ArraySource
) -> None:
    """Each read is right or raises StoreCorrupt: bits of pages and of the header, one at a time."""
    data = bytearray(built.read_bytes())
    rng = np.random.default_rng(3)
    heads = rng.integers(0, len(data) // 4096, 25) * 4096 + rng.integers(0, 16, 25)
    places = [*rng.integers(0, 8 * len(data), 60), *(heads * 8 + 3), *range(0, 8 * 100, 31)]
    refused = 0
    for bit in map(int, places):
        data[bit // 8] ^= 1 << bit % 8
        path = tmp_path / f"{bit}.terrain"
        path.write_bytes(data)
        refused += every_read_is_right_or_refused(path, source)
        path.unlink()
        data[bit // 8] ^= 1 << bit % 8
    assert refused > len(places) // 4


@pytest.mark.parametrize(
    "act",
    [
        lambda store: store.block(Block(3, 0, 0)),
        lambda store: store.block(Block(-1, 0, 0)),
        lambda store: store.block(Block(0, 2, 0)),
        lambda store: store.block(Block(1, 0, -1)),
        lambda store: store.posts(3, np.array([0]), np.array([0])),
    ],
)
def test_a_block_the_terrain_does_not_have_is_refused(
    built: Path, act: Callable[[StoreSource], object]
) -> None:
    """That is the caller's mistake, not the file's."""
    with open_store(built) as store, pytest.raises(InputError, match="level"):
        act(store)
