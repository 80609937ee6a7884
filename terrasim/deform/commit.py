"""Changing the ground of a terrain: stamps, slumping, taking back."""

from __future__ import annotations

from collections.abc import Sequence

from terrasim.deform.anchored import Anchor
from terrasim.deform.edits import Receipt, edits_of
from terrasim.deform.ledger import Ledger
from terrasim.deform.operations import (
    Operation,
    Relaxing,
    Stamping,
    Undoing,
    decode,
    encode,
    summary,
)
from terrasim.deform.overlap import overlap
from terrasim.deform.patch import Patch
from terrasim.deform.relaxation import Rect
from terrasim.deform.stamps import Stamp
from terrasim.errors import InputError
from terrasim.terrain import Terrain


def apply(
    terrain: Terrain, stamps: Sequence[Stamp], *, anchor: Anchor = (0, 0), wait: bool = True
) -> Ledger:
    """Make stamps, one after another, at every level.

    On a terrain with a store they are acknowledged, that is on the disk, when this returns.

    Args:
        terrain: The terrain.
        stamps: Stamps, their places in metres from the anchor. Those that add give the same bits
            in any order and in any number of calls.
        anchor: Level-0 post (row, column) that the stamps' places start from; it need not lie on
            the terrain. With an anchor nearby, places are as precise far away as at the origin.
        wait: Change the ground now. Otherwise stamps that only add may wait until the ground is
            next read; the bits are the same, and the ledger counts them as ``pending``.

    Returns:
        What happened to the posts of level 0.

    Raises:
        InputError: If a stamp cannot be made here; nothing is changed then.
        RunError: If the journal cannot be written: nothing is changed; or if a block cannot be
            read: then the terrain must be opened again.
    """
    return edits_of(terrain).commit(Stamping(tuple(stamps), anchor), wait=wait).ledger


def relax(
    terrain: Terrain,
    regions: Sequence[Rect],
    *,
    angle_deg: float,
    iterations: int,
    detail: bool = False,
) -> Ledger:
    """Let ground that is steeper than its angle of repose slump.

    Args:
        terrain: The terrain.
        regions: Rectangles of posts in which something may be too steep.
        angle_deg: Angle of repose [degrees].
        iterations: Most iterations.
        detail: Let the posts of the detail grid slump instead of the terrain's own.

    Returns:
        What happened to the posts; nothing is lost or won.

    Raises:
        InputError: If a number is out of its range; nothing is changed then.
        RunError: As :func:`apply`.
    """
    operation = Relaxing(tuple(regions), angle_deg, iterations, detail)
    return edits_of(terrain).commit(operation).ledger


def undo(terrain: Terrain, seq: int, *, idem: str | None = None) -> Receipt:
    """Take back an operation that only added, exactly.

    Args:
        terrain: A terrain with a store.
        seq: The operation's number in the journal.
        idem: A key of the caller's, as for :meth:`~terrasim.deform.edits.Edits.commit`.

    Raises:
        InputError: If there is no such operation, it was taken back already, or it cannot be taken
            back exactly: it did more than add, or what came after it built on it.
    """
    edits = edits_of(terrain)
    branch = edits.require_branch()
    if isinstance(seq, bool) or not isinstance(seq, int):
        raise InputError(f"the operation to take back must be a whole number, got {seq!r}")
    rows = list(branch.rows(seq)) if 0 < seq <= branch.last_seq else []
    if not rows or rows[0].seq != seq:
        raise InputError(f"operation {seq} is not in the journal of this branch; see its history")
    operation = decode(rows[0].op)
    if isinstance(operation, Stamping) and not operation.additive:
        raise InputError(f"operation {seq} did more than add; reset to a snapshot instead")
    if not isinstance(operation, Stamping | Patch):
        raise InputError(f"operation {seq} ({summary(operation)}) cannot be taken back exactly")
    undoing = Undoing(seq, operation)
    if idem is None or branch.earlier(encode(undoing), idem) is None:
        later = [(row.seq, decode(row.op)) for row in rows[1:]]
        _refuse_built_upon(terrain, seq, operation, later)
    return edits.commit(undoing, idem=idem)


def _refuse_built_upon(
    terrain: Terrain, seq: int, operation: Operation, later: list[tuple[int, Operation]]
) -> None:
    for other_seq, other in later:
        if isinstance(other, Undoing):
            if other.seq == seq:
                raise InputError(f"operation {seq} was taken back already by {other_seq}")
            continue
        adds = isinstance(other, Patch) or (isinstance(other, Stamping) and other.additive)
        if not adds and overlap(terrain, operation, other):
            raise InputError(
                f"operation {seq} cannot be taken back exactly: operation {other_seq} "
                f"({summary(other)}) built on it; reset to a snapshot instead"
            )
