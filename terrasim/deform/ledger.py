"""What an edit did to the ground, in whole counts."""

from __future__ import annotations

import math
from dataclasses import dataclass

from terrasim.counts import COUNT_M


@dataclass(frozen=True)
class Ledger:
    """Counts summed over posts within the terrain, each taken where it changed.

    ``net`` equals the difference of the sums of all heights, exactly. Ledgers add up, also those of
    level 0 and of the detail grid, whose posts are closer and whose counts are finer.
    """

    removed: int = 0
    """Sum of the falls [counts / unit], at least 0."""
    added: int = 0
    """Sum of the rises [counts / unit], at least 0."""
    posts: int = 0
    """Posts whose height changed."""
    clamped: int = 0
    """Posts that met the end of the range of heights and changed by less than they should."""
    holes: int = 0
    """Posts without ground that would have changed; they stay as they are."""
    outside: int = 0
    """Stamps that touch no post of the terrain."""
    pending: int = 0
    """Stamps that are acknowledged but wait to be applied."""
    unit: int = 1
    """Parts of a count at a post of level 0 that ``removed`` and ``added`` are in. For the detail
    grid of factor G it is G^3: a count is G times finer there, and a post stands for G^2 times less
    ground."""

    @property
    def net(self) -> int:
        """What was added less what was removed [counts / unit]."""
        return self.added - self.removed

    def __add__(self, other: Ledger) -> Ledger:
        """The ledger of one edit after another, in the finer of their units."""
        unit = math.lcm(self.unit, other.unit)
        mine, others = unit // self.unit, unit // other.unit
        return Ledger(
            self.removed * mine + other.removed * others,
            self.added * mine + other.added * others,
            self.posts + other.posts,
            self.clamped + other.clamped,
            self.holes + other.holes,
            self.outside + other.outside,
            self.pending + other.pending,
            unit,
        )

    def volume(self, spacing: float) -> float:
        """Net volume [m^3] where level 0 has posts ``spacing`` metres apart.

        Each post stands for its square.
        """
        return self.net / self.unit * COUNT_M * spacing * spacing


@dataclass(frozen=True)
class LedgerByStamp(Ledger):
    """A ledger that also says what each stamp did."""

    stamps: tuple[tuple[int, int], ...] = ()
    """What each stamp removed and added [counts / unit], in their order.

    Each is measured against the ground as the stamps before it left it; what one adds and a later
    one removes stands in both, so that their sums can exceed the whole ledger's. The nets add up to
    its net exactly.
    """
