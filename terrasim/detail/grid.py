"""Where the detail's posts are, and how they are numbered."""

from __future__ import annotations

from dataclasses import dataclass

from terrasim.errors import InputError
from terrasim.grid import MAX_INDEX, Block, Grid, Span
from terrasim.kernels.addressing import BLOCK, BLOCK_SHIFT

DETAIL_LEVEL = -1
"""The ``level`` of a detail block's key."""
MAX_FACTOR = 4096
"""The finest detail: 4,096 of its cells along the side of a cell of the terrain."""


@dataclass(frozen=True)
class DetailGrid:
    """The detail of a grid: ``factor`` by ``factor`` cells in each cell of level 0.

    Detail post ``(0, 0)`` is the first post of the terrain's first block, so that terrains alike in
    all but their place number their detail alike. A height of the detail is a count divided by the
    factor, added to the level-0 triangles. Blocks of it, ``Block(-1, row, col)``, hold as many
    posts as any; a level-0 block has ``factor`` by ``factor`` of them.
    """

    grid: Grid
    """Placement of the level-0 posts."""
    factor: int
    """Detail cells along a cell's side; 1 is no detail."""

    def __post_init__(self) -> None:
        """Refuse a factor that is none, or that numbers posts beyond what can be addressed."""
        # What comes from a file may be anything.
        factor: object = self.factor
        whole = isinstance(factor, int) and not isinstance(factor, bool)
        if not whole or not 1 <= self.factor <= MAX_FACTOR:
            raise InputError(
                f"detail_factor must be a whole number from 1 to {MAX_FACTOR}, got {self.factor!r}"
            )
        blocks = self.grid.blocks(0)
        side = max(blocks.row1 - blocks.row0, blocks.col1 - blocks.col0) * BLOCK
        if self.factor > 1 and side * self.factor >= MAX_INDEX:
            raise InputError(
                f"detail_factor = {self.factor} makes {side * self.factor} detail posts along a "
                f"side, which must be below {MAX_INDEX}; take at most "
                f"{(MAX_INDEX - 1) // side} here, or fewer posts"
            )

    @property
    def row0(self) -> int:
        """Row of level-0 posts that detail row 0 lies on."""
        return self.grid.blocks(0).row0 * BLOCK

    @property
    def col0(self) -> int:
        """Column of level-0 posts that detail column 0 lies on."""
        return self.grid.blocks(0).col0 * BLOCK

    @property
    def spacing(self) -> float:
        """Distance between neighbouring detail posts [m]."""
        return self.grid.spacing / self.factor

    @property
    def posts(self) -> Span:
        """Indices of the detail posts on the terrain."""
        grid = self.grid
        row, col = (grid.row - self.row0) * self.factor, (grid.col - self.col0) * self.factor
        return Span(
            row,
            row + (grid.rows - 1) * self.factor + 1,
            col,
            col + (grid.cols - 1) * self.factor + 1,
        )

    @property
    def blocks(self) -> Span:
        """Indices of the detail blocks that hold them."""
        span = self.posts
        return Span(
            span.row0 >> BLOCK_SHIFT,
            ((span.row1 - 1) >> BLOCK_SHIFT) + 1,
            span.col0 >> BLOCK_SHIFT,
            ((span.col1 - 1) >> BLOCK_SHIFT) + 1,
        )

    def base_of(self, key: Block) -> Block:
        """The level-0 block that a detail block lies in."""
        blocks = self.grid.blocks(0)
        return Block(0, blocks.row0 + key.row // self.factor, blocks.col0 + key.col // self.factor)

    def blocks_in(self, base: Block) -> Span:
        """Indices of the detail blocks that lie in a level-0 block."""
        blocks = self.grid.blocks(0)
        row, col = (base.row - blocks.row0) * self.factor, (base.col - blocks.col0) * self.factor
        return Span(row, row + self.factor, col, col + self.factor)
