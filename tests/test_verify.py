"""Verification misses nothing, and a damaged store never gives wrong heights."""

from __future__ import annotations

from pathlib import Path

import apsw
import numpy as np
import pytest
from stored import FAR, NEAR, alter, build, changed, detail, killed, same, source

from terrasim.errors import InputError, RunError
from terrasim.grid import Block
from terrasim.sources.source import BlockData
from terrasim.store.branch import open_branch
from terrasim.store.codec import StoreCorrupt
from terrasim.store.store import open_store
from terrasim.store.verify import verify


def image(seed: int) -> BlockData:
    """A block as some operation leaves it."""
    return changed(source(), NEAR, seed)


@pytest.fixture(scope="module")
def edited(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A store with a history; do not change it."""
    path = build(tmp_path_factory.mktemp("verify") / "hill.store")
    with open_branch(path) as branch:
        for seed in range(4):
            branch.checkpoint({NEAR: image(seed)}, branch.append(b"op", idem=str(seed)))
        branch.snapshot("three")
        branch.fork("dev")
        branch.checkpoint({NEAR: image(5)}, branch.append(b"last"))
        branch.append(b"waits")
    return path


def test_a_sound_store_is_called_sound(edited: Path) -> None:
    """With what there is of each kind."""
    found = verify(edited)
    assert (found["sound"], found["problems"]) == (True, [])
    assert (found["branches"], found["snapshots"], found["journal_rows"]) == (2, 1, 6)
    assert found["blocks"] == found["blobs"] - 3 * 5


def test_a_store_in_use_is_verified_as_it_is(edited: Path, tmp_path: Path) -> None:
    """Whoever writes meanwhile."""
    path = killed(edited, tmp_path / "copy")
    with open_branch(path) as branch:
        branch.append(b"more")
        assert verify(path)["journal_rows"] == 7


def test_what_is_no_store_is_refused(tmp_path: Path) -> None:
    """It has nothing to be verified."""
    with pytest.raises(InputError, match="there is no store"):
        verify(tmp_path / "none")
    (tmp_path / "text").write_text("no store")
    with pytest.raises(InputError, match="no terrasim store"):
        verify(tmp_path / "text")


@pytest.mark.parametrize(
    ("sql", "said"),
    [
        ("UPDATE blob SET data = zeroblob(30) WHERE id = 1", "blob 1 is damaged"),
        ("DELETE FROM block WHERE level = 0 AND row = 0 AND col = 0", "the terrain has"),
        ("UPDATE block SET error = 3 WHERE level = 0", "is not the one that was written"),
        ("DELETE FROM meta WHERE key = 'grid'", "meta rows"),
        ("DELETE FROM journal WHERE (id & 1023) = 2", "journal row 3 is not as it was written"),
        ("DELETE FROM journal WHERE (id & 1023) = 6", "branch main: journal row 6"),
        ("UPDATE idem SET op = x'00'", "idem"),
        ("DELETE FROM checkpoint WHERE id = 6", "missing"),
        ("DELETE FROM epoch WHERE id = 1", "missing"),
        ("UPDATE checkpoint SET chain = zeroblob(16)", "not as it was written"),
        ("DELETE FROM blob WHERE codec = 2 AND id % 2", "missing or damaged"),
        ("UPDATE snapshot SET time = 0", "snapshot three is not as it was written"),
    ],
)
def test_what_was_altered_is_found(edited: Path, tmp_path: Path, sql: str, said: str) -> None:
    """And said in words."""
    path = killed(edited, tmp_path / "copy")
    assert alter(path, sql) > 0
    found = verify(path)
    assert not found["sound"]
    assert any(said in one for one in found["problems"]), found["problems"]


def every_read_is_right_or_refused(path: Path) -> bool:
    """Reads the main branch, a fork and a snapshot; returns whether anything was refused."""
    refused = False
    wanted = {("branch", "main"): image(5), ("branch", "dev"): image(3)}
    wanted |= {("snapshot", "three"): image(3)}
    for (kind, name), right in wanted.items():
        try:
            with open_store(path, **{kind: name}) as store:
                assert same(store.block(NEAR), right)
                assert same(store.block(FAR), source().block(FAR))
        except (InputError, RunError):
            refused = True
    try:
        with open_branch(path) as branch:
            assert same(branch.block(NEAR), image(5))
            assert list(branch.pending()) == [(6, b"waits", "")]
            assert [row.op for row in branch.rows()] == [b"op"] * 4 + [b"last", b"waits"]
            assert branch.append(b"op", idem="2") in (3, 7)
    except (InputError, RunError):
        refused = True
    return refused


def test_a_flipped_bit_never_gives_wrong_heights_or_operations(
    edited: Path, tmp_path: Path
) -> None:
    """Each read is right or refused, and verification finds what a read refuses.

    Most bits are flipped in the pages of the history, where they do most.
    """
    data = bytearray(edited.read_bytes())
    rng = np.random.default_rng(3)
    pages = len(data) // 4096
    small = [page for page in range(pages) if data[page * 4096 : page * 4096 + 4096].count(0) > 500]
    heads = rng.choice(small, 30) * 4096 + rng.integers(0, 40, 30)
    inside = rng.choice(small, 40) * 4096 + rng.integers(0, 4096, 40)
    ends = rng.choice(small, 40) * 4096 + rng.integers(3000, 4096, 40)
    refused = 0
    for place in map(int, [*heads, *inside, *ends, *rng.integers(0, len(data), 20)]):
        bit = 1 << int(rng.integers(8))
        data[place] ^= bit
        path = tmp_path / "flipped.store"
        for ending in ("", "-wal", "-shm", "-writer"):
            path.with_name(path.name + ending).unlink(missing_ok=True)
        path.write_bytes(data)
        sound = verify_or_refuse(path)
        if every_read_is_right_or_refused(path):
            refused += 1
            assert not sound, place
        data[place] ^= bit
    assert refused > 20


@pytest.mark.parametrize(
    "sql",
    [
        "UPDATE blob SET data = (SELECT data FROM blob WHERE id = 1) WHERE id = {detail}",
        "UPDATE blob SET data = substr(data, 1, length(data) - 1) || x'01' WHERE id = {leaf}",
        "UPDATE blob SET data = substr(data, 1, length(data) - 9) || zeroblob(9) WHERE id = {leaf}",
        "UPDATE blob SET data = (SELECT data FROM blob WHERE id = {other}) WHERE id = {leaf}",
    ],
)
def test_what_a_tree_or_a_detail_blob_says_is_checked(tmp_path: Path, sql: str) -> None:
    """Bounds of a block stand in its node alone, detail posts in their blob alone."""
    path = build(tmp_path / "a.store")
    with open_branch(path) as branch:
        branch.set_detail_factor(2)
        branch.checkpoint({Block(-1, 0, 0): detail(1)}, 0)
        branch.checkpoint({Block(-1, 0, 0): detail(2)}, 0)
    db = apsw.Connection(str(path))
    nodes = [row[0] for row in db.execute("SELECT id FROM blob WHERE codec = 2 ORDER BY id")]
    [(blob,)] = db.execute("SELECT max(id) FROM blob WHERE codec = 1").fetchall()
    leaves = [one for one in nodes if is_leaf(db, one)]
    db.close()
    filled = sql.format(detail=blob, leaf=leaves[-1], other=leaves[0])
    assert alter(path, filled) == 1
    with open_store(path) as store, pytest.raises(StoreCorrupt):
        store.block(Block(-1, 0, 0))
    assert not verify(path)["sound"]


def is_leaf(db: apsw.Connection, blob: object) -> bool:
    """Whether a node stands right above blocks."""
    [(data,)] = db.execute("SELECT data FROM blob WHERE id = ?", (blob,)).fetchall()
    return isinstance(data, bytes) and data[1] == 1


def verify_or_refuse(path: Path) -> bool:
    """Whether a store is found sound."""
    try:
        return bool(verify(path)["sound"])
    except (InputError, RunError):
        return False
