"""Where a terrain's posts lie, as kernels take it."""

import warp as wp


@wp.struct
class Lattice:
    """Placement of a terrain's posts, and of its detail."""

    x: wp.float64
    """World x of column 0 [m]."""
    y: wp.float64
    """World y of row 0 [m]."""
    z: wp.float64
    """World z of count 0 [m]."""
    spacing: wp.float64
    """Distance between level-0 posts [m]."""
    row: int
    """First row of cells."""
    col: int
    """First column of cells."""
    last_row: int
    """Last row of cells."""
    last_col: int
    """Last column of cells."""
    levels: int
    """Number of levels."""
    factor: int
    """Detail cells along the side of a level-0 cell; below 2 the terrain has no detail."""
    row0: int
    """Row of level-0 posts that row 0 of the detail lies on."""
    col0: int
    """Column of level-0 posts that column 0 of the detail lies on."""
    detail: int
    """Where the detail's section of a pointer table begins."""
    layers: int
    """Layers of the pool for blocks of levels: so many flags begin that section."""
    mask: int
    """Slots of the section's hash, a power of two, less 1."""
