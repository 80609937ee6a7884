"""A disk that is full, broken or read-only from some call on: an SQLite VFS that fails."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import apsw

KINDS = ("full", "short", "write", "sync", "truncate", "read-only")


@dataclass(frozen=True)
class Fault:
    """What goes wrong, and when."""

    kind: str
    """``full``: no room; ``short``: room for half of it; ``write``, ``sync``, ``truncate``: that
    call fails; ``read-only``: nothing can be changed."""
    at: int
    """Which of the calls that can fail so is the first to fail, from 1 on."""
    lasting: bool = True
    """Whether all later ones fail too, until the disk is mended."""

    def concerns(self, call: str) -> bool:
        """Whether a call can fail so."""
        if self.kind == "read-only":
            return True
        return call == (self.kind if self.kind in {"sync", "truncate"} else "write")


class FaultyVFS(apsw.VFS):
    """The system's VFS with a fault."""

    def __init__(self, name: str) -> None:
        """Register it under a name."""
        self.fault: Fault | None = None
        self.failures = 0
        """How many calls have failed."""
        self.changes = 0
        """How many calls that change a file there were, failed ones too."""
        self._calls = 0
        super().__init__(name, "", maxpathname=0)

    def begin(self, fault: Fault | None) -> None:
        """Have another fault, or none, and count from one again."""
        self.fault, self._calls, self.failures = fault, 0, 0

    def fails(self, call: str) -> bool:
        """Whether a call fails now."""
        self.changes += call != "create"
        if self.fault is None or not self.fault.concerns(call):
            return False
        self._calls += 1
        late = self._calls > self.fault.at and self.fault.lasting
        bad = self._calls == self.fault.at or late
        self.failures += bad
        return bad

    def error(self) -> apsw.Error:
        """What the system says."""
        assert self.fault is not None
        if self.fault.kind in {"full", "short"}:
            return apsw.FullError("no room")
        return apsw.IOError("the disk is broken")

    def xOpen(self, name: Any, flags: list[int]) -> apsw.VFSFile:  # noqa: N802 apsw's name
        """Open a file."""
        text = name.filename() if isinstance(name, apsw.URIFilename) else name
        if text and not Path(str(text)).exists() and self.fails("create"):
            raise apsw.CantOpenError("nothing can be made here")
        return _FaultyFile(self, name, flags)


class _FaultyFile(apsw.VFSFile):
    def __init__(self, vfs: FaultyVFS, name: Any, flags: list[int]) -> None:
        super().__init__("", name, flags)
        self._vfs = vfs

    def xWrite(self, data: bytes, offset: int) -> None:  # noqa: N802 apsw's name
        if self._vfs.fails("write"):
            if self._vfs.fault and self._vfs.fault.kind == "short":
                super().xWrite(bytes(data)[: len(data) // 2], offset)
            raise self._vfs.error()
        super().xWrite(data, offset)

    def xSync(self, flags: int) -> None:  # noqa: N802 apsw's name
        if self._vfs.fails("sync"):
            raise self._vfs.error()
        super().xSync(flags)

    def xTruncate(self, newsize: int) -> None:  # noqa: N802 apsw's name
        if self._vfs.fails("truncate"):
            raise self._vfs.error()
        super().xTruncate(newsize)
