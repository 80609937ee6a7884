"""A terrain whose ground stays changed: opened on a branch of a store."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Any

from terrasim.deform.edits import Edits
from terrasim.errors import RunError
from terrasim.store.branch import open_branch
from terrasim.terrain import Terrain


def open_terrain(
    path: str | Path,
    branch: str = "main",
    *,
    create: bool = False,
    detail_factor: int | None = None,
    **options: Any,
) -> Terrain:
    """Open a branch of a store for reading and changing.

    What is done to the terrain is acknowledged when its journal row is on the disk. Opening is the
    newest checkpoint and the rows after it, done once more. Close the terrain, or use it as a
    context manager: until then nobody else can write to the store.

    Args:
        path: The store.
        branch: Name of the branch.
        create: Begin the branch on the terrain as imported if there is none.
        detail_factor: Cells of detail along a cell's side. The store keeps it; once there is
            detail, it cannot be another.
        options: Those of :class:`~terrasim.terrain.Terrain`.

    Returns:
        The terrain; ``terrain.edits`` holds its snapshots, resets and checkpoints.

    Raises:
        InputError: If there is no such store or branch, or an option is wrong.
        RunError: If the store is open for writing already, or cannot be read.
        StoreCorrupt: If something that was acknowledged is lost or damaged.
    """
    ground = open_branch(path, branch, create=create)
    before = ground.detail_factor
    try:
        if detail_factor is not None and detail_factor != before:
            ground.set_detail_factor(detail_factor)
        terrain = Terrain(ground, **options)
    except BaseException:
        if ground.detail_factor != before:
            with suppress(RunError):
                ground.set_detail_factor(before)
        ground.close()
        raise
    try:
        terrain.edits = Edits(terrain, ground)
    except BaseException:
        terrain.close()
        ground.close()
        raise
    return terrain
