"""Hashes that say whether two runs came to the same end, to the bit."""

from __future__ import annotations

from hashlib import blake2b

import numpy as np

from terrasim.grid import Block
from terrasim.terrain import Terrain


def hash_heights(terrain: Terrain) -> str:
    """Hash of all ground that differs from its source, at every level, 32 hex digits.

    It does not depend on which blocks are resident: what was edited is written back first.
    """
    digest = blake2b(digest_size=16)
    for key in changed_blocks(terrain):
        data = terrain.ground.block(key)
        bounds = [data.lowest, data.highest, data.error]
        digest.update(np.array([*key, *bounds], dtype="<i8").tobytes())
        digest.update(data.posts.astype("<i4").tobytes())
    return digest.hexdigest()


def changed_blocks(terrain: Terrain) -> list[Block]:
    """All blocks that differ from the terrain's first source, in order, written back."""
    terrain.settle()
    terrain.cache.flush()
    keys = set(terrain.ground.edited)
    branch = terrain.edits and terrain.edits.branch
    if branch:
        # What the store holds by now, the ground has let go of.
        keys.update(branch.changed())
    return sorted(keys)


def hash_arrays(*arrays: np.ndarray[tuple[int, ...], np.dtype[np.generic]]) -> str:
    """Hash of some arrays with their types and shapes, 32 hex digits."""
    digest = blake2b(digest_size=16)
    for array in arrays:
        digest.update(f"{array.dtype.str} {array.shape} ".encode())
        digest.update(np.ascontiguousarray(array).tobytes())
    return digest.hexdigest()
