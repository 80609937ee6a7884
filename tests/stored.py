"""A small terrain in a store, changes to it, and disks that fail, for tests of the store."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import apsw
import numpy as np

from terrasim.counts import HOLE, Counts
from terrasim.grid import Block, Grid
from terrasim.sources.array_source import ArraySource
from terrasim.sources.source import BlockData, Source, describe
from terrasim.store.build import build_store

GRID = Grid(300, 280, 1.0, row=-40, col=10)
NEAR = Block(0, 0, 0)
"""A level-0 block with ground and a hole."""
FAR = Block(0, -1, 1)
"""Another."""
ENDINGS = ("", "-wal", "-writer")


@cache
def ground() -> Counts:
    """Noise with a hole."""
    posts: Counts = np.random.default_rng(7).normal(0, 500, (GRID.rows, GRID.cols)).astype(np.int32)
    posts[60, 50] = HOLE
    return posts


def source() -> ArraySource:
    """The terrain in memory."""
    return ArraySource(ground(), GRID)


def build(path: Path) -> Path:
    """The terrain as a store."""
    build_store(source(), GRID, path, provenance={"made": "here"})
    return path


def changed(from_: Source, key: Block, seed: int) -> BlockData:
    """A block with something added to a part of it; holes stay."""
    data = from_.block(key)
    posts, rng = data.posts.copy(), np.random.default_rng(seed)
    row, col = rng.integers(0, 200, 2)
    part = posts[row : row + 50, col : col + 40]
    part[part != HOLE] += int(rng.integers(1, 1000))
    return describe(posts, data.error)


def detail(seed: int) -> BlockData:
    """A detail block that is not zero."""
    posts = np.zeros((256, 256), np.int32)
    posts[3:9, 4:7] = seed + 1
    return describe(posts, 0)


def same(one: BlockData, other: BlockData) -> bool:
    """Whether two blocks are alike in all they say."""
    numbers = (one.lowest, one.highest, one.error) == (other.lowest, other.highest, other.error)
    return numbers and bool(np.array_equal(one.posts, other.posts))


def killed(path: Path, folder: Path) -> Path:
    """What a store's files hold now, as if its process had been killed: in another folder."""
    folder.mkdir()
    for ending in ENDINGS:
        name = path.with_name(path.name + ending)
        if name.exists():
            shutil.copy(name, folder / name.name)
    return folder / path.name


def alter(path: Path, sql: str) -> int:
    """Change a store behind its back; returns how many rows."""
    db = apsw.Connection(str(path))
    db.execute(sql).fetchall()
    count = db.total_changes()
    db.close()
    return count


def well(method: str, file: str) -> None:
    """A disk that does what it should."""


class FailingVFS(apsw.VFS):
    """The system's VFS until ``fail`` says no.

    ``fail`` is called before each write and sync of a file with the method's name and the file's,
    and may raise.
    """

    def __init__(self, name: str) -> None:
        """Register it under a name."""
        self.fail: Callable[[str, str], None] = well
        super().__init__(name, "", maxpathname=0)

    def xOpen(self, name: Any, flags: list[int]) -> apsw.VFSFile:  # noqa: N802 apsw's name
        """Open a file."""
        return _FailingFile(self, name, flags)


class _FailingFile(apsw.VFSFile):
    def __init__(self, vfs: FailingVFS, name: Any, flags: list[int]) -> None:
        super().__init__("", name, flags)
        text = name.filename() if isinstance(name, apsw.URIFilename) else name
        self._name = Path(str(text)).name if text else ""
        self._vfs = vfs

    def xWrite(self, data: bytes, offset: int) -> None:  # noqa: N802 apsw's name
        self._vfs.fail("write", self._name)
        super().xWrite(data, offset)

    def xSync(self, flags: int) -> None:  # noqa: N802 apsw's name
        self._vfs.fail("sync", self._name)
        super().xSync(flags)


def broken_disk(method: str, ending: str, count: int = 0) -> Callable[[str, str], None]:
    """A disk that fails at one kind of call on one kind of file, after so many that go well."""
    left = [count]

    def fail(called: str, file: str) -> None:
        if called == method and file.endswith(ending):
            left[0] -= 1
            if left[0] < 0:
                raise apsw.IOError("the disk is broken")

    return fail


def full_disk(method: str, file: str) -> None:
    """A disk without room."""
    if method == "write":
        raise apsw.FullError("no room")
