"""Somebody who wants to know where the ground changed."""

from __future__ import annotations

from dataclasses import dataclass, field

from terrasim.grid import Block


@dataclass(eq=False)
class Watch:
    """What changed since it was last cleared."""

    blocks: set[Block] = field(default_factory=set)
    """Blocks that were edited, of levels and of detail."""
    everything: bool = False
    """Whether all of the ground may be another."""

    def clear(self) -> None:
        """Begin again."""
        self.blocks.clear()
        self.everything = False
