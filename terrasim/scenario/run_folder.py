"""A run's folder grows beside its final name and takes that name when it is whole."""

from __future__ import annotations

import errno
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from terrasim.errors import InputError, RunError

RECORD = "run.json"
"""The file that tells a run's folder from any other."""


@contextmanager
def run_folder(path: Path) -> Iterator[Path]:
    """A new folder to fill, which becomes ``path`` at the end and vanishes on an error.

    The folder of an earlier run is replaced; any other folder with something in it is refused.

    Raises:
        InputError: If the folder cannot be made there, or something else is there.
        RunError: If the disk is full.
    """
    check_place(path)
    with _explained(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        growing = Path(tempfile.mkdtemp(prefix=f".{path.name}-", dir=path.parent))
    try:
        # As a folder made without the caution of mkdtemp.
        growing.chmod(0o755)
        with _full(path):
            yield growing
        with _explained(path):
            _put(growing, path)
    except BaseException:
        shutil.rmtree(growing, ignore_errors=True)
        raise


def check_place(path: Path) -> None:
    """Refuse a place that holds something other than an earlier run.

    Raises:
        InputError: If it does.
    """
    if path.name in {"", ".", ".."}:
        raise InputError(f"{path}: is no name for a new folder; choose one with --out")
    with _explained(path):
        if path.is_symlink() or (path.exists() and not path.is_dir()):
            raise InputError(f"{path}: is no folder; choose another with --out")
        if path.is_dir() and any(path.iterdir()) and not (path / RECORD).is_file():
            raise InputError(
                f"{path}: holds something other than a run (no {RECORD}); remove it or choose "
                "another folder with --out"
            )


def _put(growing: Path, path: Path) -> None:
    if not path.exists():
        growing.rename(path)
        return
    # The old run stays whole until the new one is in its place.
    old = Path(tempfile.mkdtemp(prefix=f".{path.name}-old-", dir=path.parent))
    path.rename(old / path.name)
    try:
        growing.rename(path)
    except BaseException:
        (old / path.name).rename(path)
        old.rmdir()
        raise
    shutil.rmtree(old, ignore_errors=True)


@contextmanager
def _full(path: Path) -> Iterator[None]:
    """What the system says while the folder is filled, in one line."""
    try:
        yield
    except OSError as error:
        raise RunError(
            f"{path}: cannot be written ({error.strerror or error}); make room or choose another "
            "folder with --out"
        ) from None


@contextmanager
def _explained(path: Path) -> Iterator[None]:
    try:
        yield
    except OSError as error:
        reason = error.strerror or str(error)
        if error.errno in {errno.ENOSPC, errno.EDQUOT, errno.EIO}:
            raise RunError(f"{path}: cannot be written ({reason}); make room") from None
        raise InputError(
            f"{path}: no run can be written there ({reason}); choose another folder with --out"
        ) from None
