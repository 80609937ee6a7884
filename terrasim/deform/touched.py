"""What an edit reports of the blocks that it changed."""

from __future__ import annotations

from dataclasses import dataclass

from terrasim.grid import Block


@dataclass(frozen=True)
class Touched:
    """One block in which posts changed."""

    key: Block
    """A block of level 0, or of the detail grid."""
    row0: int
    """First row of level-0 posts in which something changed, within the terrain. For a detail block
    the rectangle of level-0 posts around what changed."""
    row1: int
    """Last such row, inclusive."""
    col0: int
    """First such column."""
    col1: int
    """Last such column, inclusive."""
    rise: int
    """At least what any post rose by [counts, rounded up], not negative."""
    fall: int
    """At least what any post fell by [counts, rounded up], not negative."""
