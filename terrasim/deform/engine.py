"""Which engine did an operation: its kernels and the version of Warp, as a short hash."""

from __future__ import annotations

from functools import cache
from hashlib import blake2b
from importlib.metadata import version
from importlib.resources import files


@cache
def engine_hash() -> str:
    """Sixteen hex digits that change with the kernels' sources or with Warp.

    Two engines with the same hash do an operation alike; others may differ in the last count of a
    post, which whoever does a journal again counts.
    """
    said = blake2b(version("warp-lang").encode(), digest_size=8)
    for file in sorted(files("terrasim.kernels").iterdir(), key=lambda one: one.name):
        if file.name.endswith(".py"):
            said.update(file.name.encode() + file.read_bytes())
    return said.hexdigest()
