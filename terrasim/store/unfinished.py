"""A file that grows beside its final name and takes that name when it is whole and on the disk."""

from __future__ import annotations

import errno
import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from terrasim.errors import InputError, RunError

_SIDE_FILES = ("-journal", "-wal", "-shm")


def beside(path: Path, ending: str) -> Path:
    """The file whose name goes on where the path's ends."""
    return path.with_name(path.name + ending)


@contextmanager
def unfinished(path: Path, ending: str) -> Iterator[Path]:
    """An empty file to fill, which becomes ``path`` at the end and vanishes on an error.

    What a killed process left under the same name is emptied. The file is locked meanwhile.

    Raises:
        InputError: If no file can be made there.
        RunError: If another process fills it, or the disk is full.
    """
    growing = beside(path, ending)
    with _explained(path):
        lock = _claim(growing)
    try:
        try:
            yield growing
            with _explained(path):
                os.fsync(lock)
                growing.replace(path)
                _flush_folder(path.parent)
        except BaseException:
            _remove(growing)
            raise
    finally:
        # The lock ends with it, as it does when the process is killed.
        os.close(lock)


def _claim(growing: Path) -> int:
    """Make or empty the file and lock it; returns its descriptor."""
    while True:
        lock = os.open(growing, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o666)
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            # Between the two calls it may have been finished and renamed: then it is not ours.
            if growing.exists() and os.path.samestat(os.fstat(lock), growing.stat()):
                os.ftruncate(lock, 0)
                for ending in _SIDE_FILES:
                    beside(growing, ending).unlink(missing_ok=True)
                return lock
        except BaseException:
            os.close(lock)
            raise
        os.close(lock)


def _remove(growing: Path) -> None:
    for ending in ("", *_SIDE_FILES):
        beside(growing, ending).unlink(missing_ok=True)


def _flush_folder(folder: Path) -> None:
    # The new name is on the disk only when the folder is.
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    try:
        yield
    except BlockingIOError:
        raise RunError(f"{path} is being written by another process; wait for it") from None
    except OSError as error:
        if error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EIO}:
            raise RunError(f"{path} cannot be written: {error.strerror}; make room") from None
        raise InputError(
            f"{path} cannot be written: {error.strerror}; choose another path"
        ) from None
