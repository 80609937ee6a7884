"""Check that the wheel and the sdist hold every file of the package, and nothing twice."""

from __future__ import annotations

import subprocess
import sys
import tarfile
import zipfile
from collections import Counter

PLACES = {"kernels/": "terrasim/kernels/", "server/": "terrasim/server/", "terrasim/": "terrasim/"}
"""Folder of the checkout, and where its files lie in the wheel."""


def tracked() -> list[str]:
    """Files of the package that git knows; a link is one of its own targets, so it is left out."""
    listing = subprocess.run(
        ["git", "ls-files", "--stage", *PLACES], check=True, capture_output=True, text=True
    )
    lines = [line.split(maxsplit=3) for line in listing.stdout.splitlines()]
    return [path for mode, _, _, path in lines if mode != "120000"]


def in_wheel(path: str) -> str:
    """Where a tracked file lies in the wheel."""
    folder = path[: path.index("/") + 1]
    return PLACES[folder] + path.removeprefix(folder)


def missing(wheel: str, sdist: str) -> list[str]:
    """Complaints, one a line."""
    with zipfile.ZipFile(wheel) as archive:
        held = Counter(archive.namelist())
    with tarfile.open(sdist) as archive:
        shipped = {name.partition("/")[2] for name in archive.getnames()}
    return [
        *(f"wheel lacks {in_wheel(path)}" for path in tracked() if in_wheel(path) not in held),
        *(f"wheel holds {name} twice" for name, count in held.items() if count > 1),
        *(f"wheel holds {name}" for name in held if not name.startswith("terrasim")),
        *(f"sdist lacks {path}" for path in tracked() if path not in shipped),
        *(f"sdist lacks {path}" for path in ("LICENSE", "README.md") if path not in shipped),
    ]


if __name__ == "__main__":
    complaints = missing(*sys.argv[1:])
    print("\n".join(complaints) or f"wheel and sdist hold all {len(tracked())} files")
    sys.exit(bool(complaints))
