"""A study's folder: its results, its table, its page."""

from __future__ import annotations

import os
from pathlib import Path

from terrasim.errors import InputError, RunError

MARK = "study.json"
"""The file that tells a study's folder from any other."""


def check_study_place(path: Path) -> None:
    """Make a folder for a study, or go on in that of an earlier one.

    Raises:
        InputError: If something else is there, or no folder can be made.
    """
    if path.name in {"", ".", ".."}:
        raise InputError(f"{path}: is no name for a folder; choose one with --out")
    try:
        if path.exists() and not path.is_dir():
            raise InputError(f"{path}: is no folder; choose another with --out")
        if path.is_dir() and any(path.iterdir()) and not (path / MARK).is_file():
            raise InputError(
                f"{path}: holds something other than a study (no {MARK}); remove it or choose "
                "another folder with --out"
            )
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"{path}: no study can be written there ({error.strerror or error}); choose another "
            "folder with --out"
        ) from None


def write_text(path: Path, text: str) -> None:
    """Write a file whole or not at all.

    Raises:
        RunError: If it cannot be written.
    """
    growing = path.with_name(f".{path.name}.{os.getpid()}")
    try:
        growing.write_text(text, encoding="utf-8")
        growing.replace(path)
    except OSError as error:
        raise RunError(f"{path}: cannot be written ({error.strerror}); make room") from None
