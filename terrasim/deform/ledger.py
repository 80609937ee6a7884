"""What an edit did to the ground, in whole counts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

from terrasim.counts import COUNT_M


@dataclass(frozen=True)
class Ledger:
    """Counts summed over the posts of level 0 within the terrain, each taken where it changed.

    ``net`` equals the difference of the sums of all heights, exactly.
    """

    removed: int = 0
    """Sum of the falls [counts], at least 0."""
    added: int = 0
    """Sum of the rises [counts], at least 0."""
    posts: int = 0
    """Posts whose height changed."""
    clamped: int = 0
    """Posts that met the end of the range of heights and changed by less than they should."""
    holes: int = 0
    """Posts without ground that would have changed; they stay as they are."""
    outside: int = 0
    """Stamps that touch no post of the terrain."""

    @property
    def net(self) -> int:
        """What was added less what was removed [counts]."""
        return self.added - self.removed

    def __add__(self, other: Self) -> Ledger:
        """The ledger of one edit after another."""
        return Ledger(
            self.removed + other.removed,
            self.added + other.added,
            self.posts + other.posts,
            self.clamped + other.clamped,
            self.holes + other.holes,
            self.outside + other.outside,
        )

    def volume(self, spacing: float) -> float:
        """Net volume [m^3] on posts ``spacing`` metres apart: each stands for its square."""
        return self.net * COUNT_M * spacing * spacing
