"""A disk that can lose power: an SQLite VFS that records every write and sync, and its crashes.

A crash may keep any of the writes that were not followed by a sync of their file, whole or torn at
a sector's border; what was synced is there. Killing a process cannot show a missing sync, because
the system writes everything in the end: this can.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import apsw
import numpy as np

SECTOR = 512
"""What a disk writes whole or not at all [bytes]."""


@dataclass(frozen=True)
class Event:
    """Something that happened to the disk, or a mark of the test."""

    kind: str
    """``write``, ``truncate``, ``sync``, ``delete`` or ``mark``."""
    file: str = ""
    """Name of the file."""
    offset: int = 0
    """Where it was written, or its new length."""
    data: bytes = b""
    """What was written."""
    mark: object = None
    """What the test noted."""


@dataclass
class Log:
    """Everything that happened, in order."""

    events: list[Event] = field(default_factory=list)

    def mark(self, note: object) -> None:
        """Note something of the test, such as an acknowledgement."""
        self.events.append(Event("mark", mark=note))

    def syncs(self) -> list[int]:
        """Places right after each sync."""
        return [i + 1 for i, event in enumerate(self.events) if event.kind == "sync"]

    def marks(self, end: int) -> list[object]:
        """The test's notes before a place."""
        return [event.mark for event in self.events[:end] if event.kind == "mark"]

    def crash(self, end: int, seed: int, files: dict[str, bytes]) -> dict[str, bytes]:
        """What the files hold after power was lost at a place.

        Args:
            end: How many events had happened.
            seed: Which of the writes without a sync are kept; 0 keeps none, -1 all.
            files: What the files held at first.
        """
        rng = np.random.default_rng(abs(seed))
        last_sync = {}
        for i, event in enumerate(self.events[:end]):
            if event.kind == "sync":
                # A file system that journals names keeps their order: any sync makes them safe.
                last_sync[event.file] = last_sync[""] = i
        held = {name: bytearray(content) for name, content in files.items()}
        for i, event in enumerate(self.events[:end]):
            if event.kind in {"mark", "sync"}:
                continue
            safe = i < last_sync.get("" if event.kind == "delete" else event.file, -1)
            if safe or seed == -1:
                _do(held, event, None)
            elif seed > 0:
                _do(held, event, rng)
        return {name: bytes(content) for name, content in held.items()}


def _do(held: dict[str, bytearray], event: Event, rng: np.random.Generator | None) -> None:
    """Let an event happen, or with a generator: perhaps, and perhaps in part."""
    if event.kind == "delete":
        if rng is None or rng.random() < 0.5:
            held.pop(event.file, None)
        return
    content = held.setdefault(event.file, bytearray())
    if event.kind == "truncate":
        if rng is None or rng.random() < 0.5:
            del content[event.offset :]
            content.extend(bytes(event.offset - len(content)))
        return
    for start, piece in _sectors(event):
        if rng is not None and rng.random() < 0.5:
            continue
        if len(content) < start + len(piece):
            content.extend(bytes(start + len(piece) - len(content)))
        content[start : start + len(piece)] = piece


def _sectors(event: Event) -> Iterator[tuple[int, bytes]]:
    """A write in the pieces that a disk writes whole."""
    start, end = event.offset, event.offset + len(event.data)
    while start < end:
        stop = min(end, (start // SECTOR + 1) * SECTOR)
        yield start, event.data[start - event.offset : stop - event.offset]
        start = stop


class RecordingVFS(apsw.VFS):
    """The system's VFS, with a log of what is written through it."""

    def __init__(self, name: str, log: Log) -> None:
        """Register it under a name."""
        self.log = log
        super().__init__(name, "", maxpathname=0)

    def xOpen(self, name: Any, flags: list[int]) -> apsw.VFSFile:  # noqa: N802 apsw's name
        """Open a file and record what happens to it."""
        return _RecordedFile(self.log, name, flags)

    def xDelete(self, filename: str, syncdir: bool) -> None:  # noqa: N802, apsw's
        """Delete a file."""
        super().xDelete(filename, syncdir)
        self.log.events.append(Event("delete", Path(filename).name))
        if syncdir:
            self.log.events.append(Event("sync", Path(filename).name))


class _RecordedFile(apsw.VFSFile):
    def __init__(self, log: Log, name: Any, flags: list[int]) -> None:
        super().__init__("", name, flags)
        text = name.filename() if isinstance(name, apsw.URIFilename) else name
        self._name = Path(str(text)).name if text else ""
        self._log = log

    def xWrite(self, data: bytes, offset: int) -> None:  # noqa: N802 apsw's name
        super().xWrite(data, offset)
        self._log.events.append(Event("write", self._name, offset, bytes(data)))

    def xTruncate(self, newsize: int) -> None:  # noqa: N802 apsw's name
        super().xTruncate(newsize)
        self._log.events.append(Event("truncate", self._name, newsize))

    def xSync(self, flags: int) -> None:  # noqa: N802 apsw's name
        super().xSync(flags)
        self._log.events.append(Event("sync", self._name))
