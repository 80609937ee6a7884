"""Doing an operation, whichever it is; no journal is asked."""

from __future__ import annotations

from dataclasses import dataclass

from terrasim.deform.apply import apply_stamps, check_stamps
from terrasim.deform.ledger import Ledger
from terrasim.deform.operations import Operation, Relaxing, Stamping, Undoing
from terrasim.deform.patch import Patch, apply_patch, check_patch
from terrasim.deform.relaxation import Rect, check_relaxation, relax
from terrasim.errors import InputError
from terrasim.terrain import Terrain


@dataclass(frozen=True)
class Done:
    """What an operation did."""

    ledger: Ledger
    """To the posts."""
    awake: tuple[Rect, ...] = ()
    """Where ground goes on slumping: it was not given iterations enough."""


def check(terrain: Terrain, operation: Operation) -> None:
    """Refuse what cannot be done on this terrain, before a journal or the ground changes.

    Raises:
        InputError: If it is no operation, a place cannot be numbered, or the terrain has no detail
            to change.
    """
    if isinstance(operation, Stamping):
        check_stamps(terrain, operation.stamps, anchor=operation.anchor)
    elif isinstance(operation, Patch):
        check_patch(terrain, operation)
    elif isinstance(operation, Relaxing):
        check_relaxation(
            terrain,
            operation.regions,
            angle_deg=operation.angle_deg,
            iterations=operation.iterations,
            detail=operation.detail,
        )
    elif isinstance(operation, Undoing):
        _check_undoing(terrain, operation.seq, operation.operation)
    else:
        raise InputError(f"an operation must be one, got a {type(operation).__name__}")


def _check_undoing(terrain: Terrain, seq: object, undone: object) -> None:
    """Refuse what a journal would hold and nobody could do again."""
    if type(seq) is not int:
        raise InputError(f"the operation to take back must be a whole number, got {seq!r}")
    if isinstance(undone, Stamping):
        check_stamps(terrain, undone.stamps, anchor=undone.anchor, undo=True)
    elif isinstance(undone, Patch):
        check_patch(terrain, undone)
    else:
        raise InputError(f"a {type(undone).__name__} cannot be taken back exactly")


def perform(terrain: Terrain, operation: Operation) -> Done:
    """Change the ground.

    Raises:
        InputError: As :func:`check`.
        RunError: If a block cannot be read or written; the ground may be half-changed then.
    """
    if isinstance(operation, Stamping):
        return Done(apply_stamps(terrain, operation.stamps, anchor=operation.anchor))
    if isinstance(operation, Patch):
        return Done(apply_patch(terrain, operation))
    if isinstance(operation, Relaxing):
        relaxed = relax(
            terrain,
            operation.regions,
            angle_deg=operation.angle_deg,
            iterations=operation.iterations,
            detail=operation.detail,
        )
        return Done(relaxed.ledger, tuple(relaxed.awake))
    return Done(_take_back(terrain, operation.operation))


def _take_back(terrain: Terrain, operation: Stamping | Patch) -> Ledger:
    if isinstance(operation, Patch):
        back = Patch(operation.row, operation.col, -operation.counts, operation.detail)
        return apply_patch(terrain, back)
    return apply_stamps(terrain, operation.stamps, anchor=operation.anchor, undo=True)
