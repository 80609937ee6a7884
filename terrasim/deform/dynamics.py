"""Deformations that change over time, and the ground that follows them.

A dynamic has a total at each time; the ground gets the whole counts by which the rounded total
changed. At its end the total stays (``freeze``) or all of it is taken back (``vanish``): ground
that was only added to meanwhile is then what it was before, to the bit.

Where a post meets the end of the range of heights it takes less than it is offered. That is counted
as clamped, and the dynamic notes what the ground took: it offers the rest again and never takes
back what was never added. A post without ground takes nothing and gives nothing back.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, Protocol

import numpy as np
import numpy.typing as npt

from terrasim.counts import MAX_COUNT
from terrasim.deform.given import Given
from terrasim.deform.ledger import Ledger
from terrasim.deform.patch import Patch, apply_patch, blocks_of, check_patch
from terrasim.deform.target import Target
from terrasim.deform.window import NO_GROUND, read_window
from terrasim.detail.grid import DETAIL_LEVEL
from terrasim.errors import InputError
from terrasim.grid import Block
from terrasim.terrain import Terrain

Field = npt.NDArray[np.float64]
State = Mapping[str, npt.NDArray[Any]]
End = Literal["freeze", "vanish"]
Put = Callable[[Terrain, Patch], Ledger]
"""What adds a patch to a terrain."""


class Dynamic(Protocol):
    """Something that changes a rectangle of posts over time."""

    @property
    def given(self) -> Given:
        """Where it is and what the ground holds of it."""

    @property
    def done(self) -> bool:
        """Whether its time is over."""

    @property
    def speed(self) -> Field:
        """Vertical speed of the ground under it now [m/s], shape of its rectangle."""

    def advance(self, dt_s: float) -> Patch | None:
        """Let time go on [s], at most to its end; 0 brings what it begins with.

        Returns:
            The change of its rounded total since last time; None if there is none.
        """

    def end(self, how: End) -> Patch | None:
        """End it: leave its total as it is, or take all of it back."""

    def state(self) -> dict[str, npt.NDArray[Any]]:
        """All that it goes on from, as arrays; it goes on from them to the bit."""

    def summary(self) -> dict[str, Any]:
        """What became of it, ready for JSON."""


def advance_dynamics(
    terrain: Terrain, dynamics: Sequence[Dynamic], dt_s: float, *, put: Put = apply_patch
) -> Ledger:
    """Let dynamics go on, one after another, and the ground with them.

    Args:
        terrain: The terrain.
        dynamics: The dynamics; those that are done change nothing.
        dt_s: By how much time goes on [s]; 0 brings what they begin with.
        put: What adds a patch to the terrain.

    Returns:
        What happened to the posts.

    Raises:
        InputError: If the time is negative or too long for a dynamic's step.
        RunError: If a height leaves the range of heights, or a block cannot be read or written.
    """
    ledger = Ledger()
    for one in dynamics:
        ledger += give(terrain, one, one.advance(dt_s), put)
    return ledger


def end_dynamics(
    terrain: Terrain, dynamics: Sequence[Dynamic], how: End, *, put: Put = apply_patch
) -> Ledger:
    """End dynamics, one after another: ``freeze`` or ``vanish``.

    Raises:
        InputError: If ``how`` is neither.
        RunError: If a block cannot be read or written.
    """
    ledger = Ledger()
    for one in dynamics:
        ledger += give(terrain, one, one.end(how), put)
    return ledger


def give(terrain: Terrain, dynamic: Dynamic, patch: Patch | None, put: Put) -> Ledger:
    """Give the ground a patch of a dynamic, which learns what the ground took of it."""
    if patch is None:
        return Ledger()
    if _fits(terrain, patch):
        return put(terrain, patch)
    window = (patch.row, patch.col, *patch.counts.shape, patch.detail)
    before = read_window(terrain, *window)
    ledger = put(terrain, patch)
    ground = before != NO_GROUND
    taken = patch.counts.copy()
    taken[ground] = (read_window(terrain, *window) - before)[ground]
    dynamic.given.correct(patch, taken)
    return ledger


def check_end(name: str, how: str) -> None:
    """Refuse an end that is none.

    Raises:
        InputError: With name, rule and value.
    """
    if how not in {"freeze", "vanish"}:
        raise InputError(f"{name}: end must be 'freeze' or 'vanish', got {how!r}")


def check_detail(name: str, detail: bool, target: Target) -> None:
    """Refuse posts of another lattice than are to change.

    Raises:
        InputError: With name, field and value.
    """
    if detail != (target.level < 0):
        raise InputError(f"{name}: detail = {str(detail).lower()} does not go with these posts")


def array_of(
    state: State, field: str, kind: Any, shape: tuple[int, ...], name: str
) -> npt.NDArray[Any]:
    """An array of a state, held against its type and shape.

    Raises:
        InputError: If it is missing or another one.
    """
    array = state.get(field)
    if array is None:
        raise InputError(f"{name}: {field} is missing from its state")
    if array.dtype != kind or array.shape != shape:
        raise InputError(
            f"{name}: {field} must be {np.dtype(kind)} of shape {shape} in its state, "
            f"got {array.dtype} {array.shape}"
        )
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        raise InputError(f"{name}: {field} must be finite in its state")
    return array


def _fits(terrain: Terrain, patch: Patch) -> bool:
    """Whether surely no post meets the end of the range; needs no post to be read."""
    check_patch(terrain, patch)
    most = MAX_COUNT - int(np.abs(patch.counts.astype(np.int64)).max())
    return _detail_within(terrain, patch, most) if patch.detail else _within(terrain, most)


def _within(terrain: Terrain, most: int) -> bool:
    """Whether all heights of a terrain stay within a number of counts."""
    grid = terrain.grid
    span = grid.blocks(grid.top)
    for row in range(span.row0, span.row1):
        for col in range(span.col0, span.col1):
            lowest, highest, error = terrain.cache.describe(Block(grid.top, row, col))
            # A block without any ground says the smallest int32 for both.
            if highest + error > most or (highest >= lowest > NO_GROUND and lowest - error < -most):
                return False
    return True


def _detail_within(terrain: Terrain, patch: Patch, most: int) -> bool:
    """Whether all differences in the detail blocks of a patch do."""
    cache = terrain.cache
    for key in blocks_of(patch, DETAIL_LEVEL):
        cache.hold([terrain.detail.base_of(key)])
        # A block that is not there with the one it lies on is all zero.
        if cache.is_resident(key):
            lowest, highest, _ = cache.describe(key)
            if highest > most or lowest < -most:
                return False
    return True
