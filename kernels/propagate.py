"""A level sampled anew from the level below, and how far it lies from it.

A thread takes one row of a piece: a rectangle of a block over one block of the level below.
"""

import warp as wp

from terrasim.kernels.addressing import offset_in_pool
from terrasim.kernels.level_distance import edge_distance, largest_distance, lower_edges
from terrasim.kernels.rows import posts_from

QUADRANT = 128
"""Posts along the side of the part of a block that one block of the level below covers."""
FIELDS = 7
"""Numbers that a row of a piece gives: see ``carry_up``."""

_HOLE = wp.constant(-(2**31))
_MAX = wp.constant(2**31 - 1)
_NONE = wp.constant(wp.int64(-1))
_SHIFT = wp.constant(7)
_MASK = wp.constant(QUADRANT - 1)
_BLOCK = wp.constant(256)
_PITCH = wp.constant(256)
# Warp counts a negative index from the array's end; it leaves that test out where none can be.
_NO_SIGN = wp.constant(0x7FFFFFFF)


@wp.struct
class Piece:
    """A rectangle of posts and cells of a block, all over one block of the level below."""

    layer: int
    """The block's layer, or -1 to measure only."""
    own: int
    """Layer of the block below."""
    east: int
    """Layer of the next block below along x."""
    north: int
    """Layer of the next along y."""
    corner: int
    """Layer of the next along both."""
    row: int
    """First row of posts of the piece, in its quadrant."""
    rows: int
    """Number of rows."""
    col: int
    """First column likewise."""
    cols: int
    """Number of columns."""
    place: int
    """The quadrant's first post in its block."""
    row_step: int
    """Rows below from one row of posts to the next: 2, or 0 beyond the terrain."""
    col_step: int
    """Columns likewise."""
    from_row: int
    """Row below of the quadrant's first row."""
    from_col: int
    """Column likewise."""
    north_row: int
    """Row below, in ``north``, of the row after the quadrant's last."""
    east_col: int
    """Column likewise, in ``east``."""
    own_row: int
    """Row of blocks of the block below."""
    own_col: int
    """Column of blocks."""
    first_row: int
    """Row of the level's posts of the quadrant's first."""
    first_col: int
    """Column of it."""
    last_row: int
    """Last row of posts of the level's blocks."""
    last_col: int
    """Last column."""
    measure: int
    """Whether to compare it with the level below."""


@wp.struct
class Extent:
    """Ranges of a row of posts before and after."""

    lowest: int
    highest: int
    old_lowest: int
    old_highest: int


@wp.struct
class Distances:
    """How far a row of cells lies from the level below [half counts]; -1 if it was not measured."""

    cells: wp.int64
    """Largest distance, but for the cells' upper and right edges."""
    south: wp.int64
    """Largest over the lower edges, if they are the block's side; else -1."""
    west: wp.int64
    """Distance of the first left edge, if it is the block's side; else -1."""


@wp.func
def sample_row(pool: wp.array(dtype=int), source: int, target: int, count: int) -> Extent:
    """Copy every second post of a row; the ranges leave holes out."""
    lowest = int(_MAX)
    highest = int(_HOLE)
    old_lowest = int(_MAX)
    old_highest = int(_HOLE)
    below = posts_from(pool, source)
    posts = posts_from(pool, target)
    i = int(0)
    while i < count:
        new = below[i + i]
        old = posts[i]
        posts[i] = new
        old_highest = wp.max(old_highest, old)
        old_lowest = wp.min(old_lowest, wp.where(old == _HOLE, _MAX, old))
        highest = wp.max(highest, new)
        lowest = wp.min(lowest, wp.where(new == _HOLE, _MAX, new))
        i += 1
    return Extent(lowest, highest, old_lowest, old_highest)


@wp.func
def repeat_post(pool: wp.array(dtype=int), source: int, target: int, count: int) -> Extent:
    """Copy one post to a row of posts: beyond the terrain."""
    new = pool[source & _NO_SIGN]
    old_lowest = int(_MAX)
    old_highest = int(_HOLE)
    posts = posts_from(pool, target)
    i = int(0)
    while i < count:
        old = posts[i]
        posts[i] = new
        old_highest = wp.max(old_highest, old)
        old_lowest = wp.min(old_lowest, wp.where(old == _HOLE, _MAX, old))
        i += 1
    return Extent(wp.where(new == _HOLE, _MAX, new), new, old_lowest, old_highest)


@wp.func
def measure_row(pool: wp.array(dtype=int), piece: Piece, row: int) -> Distances:
    """Compare one row of a piece's cells with the level below."""
    found = Distances()
    from_row = piece.from_row + piece.row_step * row
    from_col = piece.from_col + piece.col_step * piece.col
    # Beyond the terrain all cells of a row are alike.
    cols = wp.where(piece.col_step == 0, 1, piece.cols)
    wide = piece.col_step * cols
    low = offset_in_pool(piece.own, from_row, from_col)
    middle = low + (piece.row_step >> 1) * _PITCH
    high = low + piece.row_step * _PITCH
    if row == _MASK:
        high = offset_in_pool(piece.north, piece.north_row, from_col)
    east_low = low + wide
    east_high = high + wide
    if piece.col + piece.cols > _MASK:
        east_low = offset_in_pool(piece.east, from_row, piece.east_col)
        east_high = offset_in_pool(piece.east, from_row + piece.row_step, piece.east_col)
        if row == _MASK:
            east_high = offset_in_pool(piece.corner, piece.north_row, piece.east_col)
    found.cells = largest_distance(
        pool, low, middle, high, piece.col_step, cols, east_low, east_high
    )
    found.south = _NONE
    found.west = _NONE
    if row == 0 and piece.place < _PITCH:
        found.south = lower_edges(pool, low, piece.col_step, cols, east_low)
    if piece.col == 0 and (piece.place & (_PITCH - 1)) == 0:
        found.west = edge_distance(pool[low], pool[middle & _NO_SIGN], pool[high & _NO_SIGN])
    return found


@wp.func
def target_of(piece: Piece, row: int) -> int:
    """Place in the pool of a row of a piece's posts."""
    return offset_in_pool(piece.layer, 0, 0) + piece.place + row * _PITCH + piece.col


@wp.func
def sample_piece_row(pool: wp.array(dtype=int), piece: Piece, row: int) -> Extent:
    """Sample one row of a piece."""
    from_row = piece.from_row + piece.row_step * row
    from_col = piece.from_col + piece.col_step * piece.col
    source = offset_in_pool(piece.own, from_row, from_col)
    if piece.col_step == 0:
        return repeat_post(pool, source, target_of(piece, row), piece.cols)
    return sample_row(pool, source, target_of(piece, row), piece.cols)


@wp.func
def tell(extent: Extent, distances: Distances, i: int, tally_out: wp.array2d(dtype=wp.int64)):
    """Write what was found out of row ``i``."""
    tally_out[i, 0] = -wp.int64(extent.lowest)
    tally_out[i, 1] = wp.int64(extent.highest)
    tally_out[i, 2] = -wp.int64(extent.old_lowest)
    tally_out[i, 3] = wp.int64(extent.old_highest)
    tally_out[i, 4] = distances.cells
    tally_out[i, 5] = distances.south
    tally_out[i, 6] = distances.west


@wp.kernel(enable_backward=False)
def carry_up(
    # Terrain:
    pool: wp.array(dtype=int),
    # Pieces, QUADRANT rows each:
    pieces: wp.array(dtype=Piece),
    place: wp.array(dtype=int),
    # Out: FIELDS numbers a row, of which the largest of all rows is the piece's: -lowest, highest,
    # -lowest before, highest before [counts], and the three of ``Distances``.
    tally_out: wp.array2d(dtype=wp.int64),
):
    """Sample one row of a piece and measure its cells."""
    i = wp.tid() & _NO_SIGN
    piece = pieces[place[i] >> _SHIFT]
    row = piece.row + (place[i] & _MASK)
    extent = Extent(_MAX, _HOLE, _MAX, _HOLE)
    distances = Distances(_NONE, _NONE, _NONE)
    if row < piece.row + piece.rows:
        if piece.layer >= 0:
            extent = sample_piece_row(pool, piece, row)
        # So are all rows beyond it.
        if piece.measure == 1 and (piece.row_step > 0 or row == piece.row):
            distances = measure_row(pool, piece, row)
    tell(extent, distances, i, tally_out)


@wp.kernel(enable_backward=False)
def range_of_rows(
    # Terrain:
    pool: wp.array(dtype=int),
    # Layers, 256 rows each:
    layers: wp.array(dtype=int),
    place: wp.array(dtype=int),
    # Out: -lowest and highest count of the row's ground
    range_out: wp.array2d(dtype=wp.int64),
):
    i = wp.tid() & _NO_SIGN
    row = place[i] & (_BLOCK - 1)
    posts = posts_from(pool, offset_in_pool(layers[place[i] >> 8], row, 0))
    lowest = int(_MAX)
    highest = int(_HOLE)
    k = int(0)
    while k < _BLOCK:
        count = posts[k]
        highest = wp.max(highest, count)
        lowest = wp.min(lowest, wp.where(count == _HOLE, _MAX, count))
        k += 1
    range_out[i, 0] = -wp.int64(lowest)
    range_out[i, 1] = wp.int64(highest)
