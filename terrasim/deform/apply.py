"""Applying stamps: they change the posts of level 0 or of the detail grid, one after another.

Each stamp's rise is rounded to counts by itself, so stamps that only add leave the same bits in any
order; the other modes take effect in the order given. How a call is cut into calls, which blocks
are resident and how many threads there are changes nothing. Taking back what was added is exact.
Only where a post meets the end of the range of heights does order matter and something stay, and
such posts are counted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby

import numpy as np

from terrasim.deform.anchored import Anchor
from terrasim.deform.batch import Batch
from terrasim.deform.binning import Touch, group, touch
from terrasim.deform.fitting import Fitting, Part
from terrasim.deform.ledger import Ledger, LedgerByStamp
from terrasim.deform.placing import Placed, place, surely_fit
from terrasim.deform.propagate import propagate
from terrasim.deform.stamps import Stamp
from terrasim.deform.tallies import ledger_of, note
from terrasim.deform.target import Target, target_of
from terrasim.deform.touched import Touched
from terrasim.errors import InputError, RunError
from terrasim.grid import Block
from terrasim.kernels.addressing import BLOCK
from terrasim.terrain import Terrain

GROUP = 1024
"""Most blocks changed in one launch: 22 MB of tallies."""
MAX_SHARES = 2**22
"""Rows of which each stamp's part is kept at once: 16 bytes each."""
MAX_OF_A_BLOCK = 2**17
"""Most stamps of one block if each has its own account."""


@dataclass(frozen=True)
class Run:
    """Stamps that follow one another and change the same lattice of posts."""

    target: Target
    """The posts."""
    placed: Placed
    """The stamps that touch them."""
    found: Touch
    """The blocks they touch."""
    busiest: int
    """Most stamps that touch one block."""


def apply_stamps(
    terrain: Terrain,
    stamps: Sequence[Stamp],
    *,
    anchor: Anchor = (0, 0),
    undo: bool = False,
    by_stamp: bool = False,
) -> Ledger:
    """Put stamps to the ground, one after another, and carry the change up through the levels.

    The blocks they touch are brought in first, as many at a time as the pool holds, and are written
    back when they leave it.

    Args:
        terrain: The terrain.
        stamps: Stamps, their places in metres from the anchor.
        anchor: Level-0 post (row, column) that the stamps' places start from; it need not lie on
            the terrain. With an anchor nearby, places are as precise far away as at the origin.
        undo: Take back exactly what these stamps, all of mode add, once added.
        by_stamp: Account for each stamp too: the ledger is a
            :class:`~terrasim.deform.ledger.LedgerByStamp`.

    Returns:
        What happened to the posts.

    Raises:
        InputError: As :func:`check_stamps`; nothing is changed then.
        RunError: If a block cannot be read or written. Nothing is changed if the pool holds all
            that the stamps touch; else the error says that the terrain must be opened again.
    """
    runs = _prepare(terrain, stamps, anchor, undo=undo, by_stamp=by_stamp)
    fitting = Fitting(terrain, [run.found for run in runs])
    parts = [fitting.parts(run.found, _most(run, by_stamp)) for run in runs]
    _bring_all(terrain, fitting)
    edit = _Edit(terrain, undo, by_stamp)
    edit.ledger = Ledger(outside=len(stamps) - sum(len(run.placed.numbers) for run in runs))
    try:
        for run, own in zip(runs, parts, strict=True):
            edit.make(run, own)
        propagate(terrain, edit.touched)
    except Exception as error:
        if not edit.begun:
            raise
        raise RunError(
            f"the ground is half-changed because a block failed ({error}); open the terrain again"
        ) from error
    return edit.by_stamp(len(stamps)) if by_stamp else edit.ledger


apply = apply_stamps


def check_stamps(
    terrain: Terrain, stamps: Sequence[Stamp], *, anchor: Anchor = (0, 0), undo: bool = False
) -> None:
    """Refuse stamps that cannot be made here, before anything is allocated or changed.

    Raises:
        InputError: If a stamp lies further from the anchor than posts can be numbered, is wider
            than twice the terrain's longest side, wants a detail grid that the terrain has not, or
            is to be taken back and did more than add; or if the stamps are too many and wide for
            one call.
    """
    _require_additive(stamps, undo)
    for detail, numbers in _in_order(stamps):
        target = target_of(terrain, detail=detail)
        if not surely_fit(stamps, numbers, target, anchor):
            place(stamps, numbers, target, anchor)


def _require_additive(stamps: Sequence[Stamp], undo: bool) -> None:
    if undo and (other := next((one for one in stamps if one.mode != "add"), None)):
        raise InputError(
            f"only stamps of mode add can be taken back exactly, got a {other.name} of mode "
            f"{other.mode}; reset to a snapshot instead"
        )


def _place_all(
    terrain: Terrain, stamps: Sequence[Stamp], anchor: Anchor, *, undo: bool
) -> list[tuple[Target, Placed]]:
    """Stamps on their posts, those that follow one another on the same lattice together."""
    _require_additive(stamps, undo)
    placed = []
    for detail, numbers in _in_order(stamps):
        target = target_of(terrain, detail=detail)
        placed.append((target, place(stamps, numbers, target, anchor)))
    return placed


def _prepare(
    terrain: Terrain,
    stamps: Sequence[Stamp],
    anchor: Anchor,
    *,
    undo: bool,
    by_stamp: bool,
) -> list[Run]:
    """Find the posts and blocks that stamps touch."""
    runs = []
    for target, placed in _place_all(terrain, stamps, anchor, undo=undo):
        found = touch(placed.records, target.level, target.blocks, target.factor)
        busiest = int(np.diff(found.begin).max(initial=0))
        if by_stamp and busiest > MAX_OF_A_BLOCK:
            raise InputError(
                f"{busiest} stamps touch one block, at most {MAX_OF_A_BLOCK} can each have their "
                "own account; apply fewer stamps at a time"
            )
        runs.append(Run(target, placed, found, busiest))
    return runs


def _in_order(stamps: Sequence[Stamp]) -> list[tuple[bool, list[int]]]:
    """Numbers of stamps that can be made together: whether to the detail, and which.

    What is added to level 0 does not touch what is added to the detail.
    """
    order = list(range(len(stamps)))
    if all(stamp.mode == "add" for stamp in stamps):
        order.sort(key=lambda i: stamps[i].detail)
    runs = groupby(order, key=lambda i: stamps[i].detail)
    return [(detail, list(numbers)) for detail, numbers in runs]


def _most(run: Run, by_stamp: bool) -> int:
    """Blocks to change in one launch."""
    return max(1, min(GROUP, MAX_SHARES // (BLOCK * max(run.busiest, 1)) if by_stamp else GROUP))


def _bring_all(terrain: Terrain, fitting: Fitting) -> None:
    """Bring in all blocks that will change if the pool holds them: then no read can fail later."""
    needed = fitting.all_at_once()
    if needed is None:
        return
    # The coarsest level is always there.
    above = {
        Block(level, key.row >> level, key.col >> level)
        for key in needed
        for level in range(1, terrain.grid.top)
    }
    if terrain.grid.top > 0 and len(needed) + len(above) <= terrain.cache.capacity:
        terrain.cache.hold(sorted(needed | above))


class _Edit:
    """Stamps being put to the ground."""

    def __init__(self, terrain: Terrain, undo: bool, by_stamp: bool) -> None:
        self.ledger = Ledger()
        self.touched: list[Touched] = []
        self.begun = False
        self._terrain = terrain
        self._undo = undo
        self._by_stamp = by_stamp
        self._shares: dict[int, tuple[int, int, int]] = {}

    def make(self, run: Run, parts: list[Part]) -> None:
        """Change all blocks of a run."""
        terrain = self._terrain
        batch = Batch(terrain, run.placed, run.target, undo=self._undo, by_stamp=self._by_stamp)
        for part in parts:
            blocks = group(run.found, run.placed.records, part.first, part.last)
            if run.target.level < 0:
                layers = terrain.cache.hold_details(blocks.keys, part.beside)
            else:
                layers = terrain.cache.hold(blocks.keys)
            self.begun = True
            rows = batch.run(blocks, layers)
            self.ledger += ledger_of(rows, run.target.unit)
            self.touched += note(terrain, blocks.keys, rows, run.target)
        if batch.shares is not None:
            for number, share in zip(
                run.placed.numbers.tolist(), batch.shares.tolist(), strict=True
            ):
                self._shares[number] = (*share, run.target.unit)

    def by_stamp(self, count: int) -> LedgerByStamp:
        """The ledger with what each of ``count`` stamps did."""
        unit = self.ledger.unit
        shares = []
        for number in range(count):
            removed, added, own = self._shares.get(number, (0, 0, unit))
            shares.append((removed * (unit // own), added * (unit // own)))
        return LedgerByStamp(**vars(self.ledger), stamps=tuple(shares))
