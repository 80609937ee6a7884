"""A level sampled anew from the level below, and how far it lies from it.

A cell of a level has four posts, which the level below has too, and on its edges and its diagonal
lie three kinds of middle posts that only the level below has. The surface below is linear between
all of these, so the two surfaces are furthest apart at a middle post: half of
``2 * middle - (one end) - (other end)``.
"""

import warp as wp

from terrasim.kernels.addressing import offset_in_pool

QUADRANT = 128
"""Posts along the side of the part of a block that one block of the level below covers."""
FIELDS = 7
"""Numbers that a row of a piece gives: see ``carry_up``."""
UNKNOWN = 1 << 40
"""Distance where the level below has a hole in a triangle of the level: it cannot say."""

_HOLE = wp.constant(-(2**31))
_MAX = wp.constant(2**31 - 1)
_UNKNOWN = wp.constant(wp.int64(UNKNOWN))
_ZERO = wp.constant(wp.int64(0))
_NONE = wp.constant(wp.int64(-1))
_ONE = wp.constant(wp.int64(1))
_SHIFT = wp.constant(7)
_MASK = wp.constant(QUADRANT - 1)
_BLOCK = wp.constant(256)
_PITCH = wp.constant(256)
# Warp counts a negative index from the array's end; it leaves that test out where none can be.
_NO_SIGN = wp.constant(0x7FFFFFFF)
_EVEN = wp.constant(0x7FFFFFFE)


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
class Distance:
    """Largest distances over a row of cells [half counts]."""

    along: wp.int64
    """Of the middle posts of the edges along x."""
    rest: wp.int64
    """Of the others."""


@wp.func
def sample_row(
    pool: wp.array(dtype=int), source: int, step: int, target: int, count: int
) -> Extent:
    """Copy every second post of a row; the ranges leave holes out."""
    found = Extent()
    lowest = int(_MAX)
    highest = int(_HOLE)
    old_lowest = int(_MAX)
    old_highest = int(_HOLE)
    # Loops of this form become vector instructions; a range with a variable end does not.
    i = target & _NO_SIGN
    end = i + count
    p = source & _NO_SIGN
    while i < end:
        new = pool[p & _NO_SIGN]
        old = pool[i & _NO_SIGN]
        pool[i & _NO_SIGN] = new
        old_highest = wp.max(old_highest, old)
        old_lowest = wp.min(old_lowest, wp.where(old == _HOLE, _MAX, old))
        highest = wp.max(highest, new)
        lowest = wp.min(lowest, wp.where(new == _HOLE, _MAX, new))
        p += step
        i += 1
    found.lowest = lowest
    found.highest = highest
    found.old_lowest = old_lowest
    found.old_highest = old_highest
    return found


@wp.func
def edge_distance(one: int, middle: int, other: int) -> wp.int64:
    """Distance of a middle post from the line between two posts [half counts]."""
    if one == _HOLE or other == _HOLE:
        return _ZERO
    if middle == _HOLE:
        return _UNKNOWN
    return wp.abs((wp.int64(middle) << _ONE) - (wp.int64(one) + wp.int64(other)))


@wp.func
def plain_distances(
    pool: wp.array(dtype=int), low: int, middle: int, high: int, count: int
) -> Distance:
    """Distances of cells whose posts lie side by side; ``rest`` is -1 if one is a hole."""
    found = Distance()
    along = wp.int64(0)
    rest = wp.int64(0)
    lowest = int(0)
    p = low & _EVEN
    m = middle & _EVEN
    q = high & _EVEN
    end = p + (count << 1)
    a = wp.int64(pool[p])
    b = wp.int64(pool[q])
    lowest = wp.min(pool[p], pool[q])
    while p < end:
        bottom = pool[p + 1]
        side = pool[m]
        centre = pool[m + 1]
        p = (p + 2) & _EVEN
        m = (m + 2) & _EVEN
        q = (q + 2) & _EVEN
        right = pool[p]
        far = pool[q]
        lowest = wp.min(wp.min(lowest, bottom), wp.min(wp.min(side, centre), wp.min(right, far)))
        rest = wp.max(rest, wp.abs((wp.int64(side) << _ONE) - (a + b)))
        b = wp.int64(far)
        rest = wp.max(rest, wp.abs((wp.int64(centre) << _ONE) - (a + b)))
        near = a
        a = wp.int64(right)
        along = wp.max(along, wp.abs((wp.int64(bottom) << _ONE) - (near + a)))
    found.along = along
    found.rest = wp.where(lowest == _HOLE, _NONE, rest)
    return found


@wp.func
def distances(
    pool: wp.array(dtype=int),
    low: int,
    middle: int,
    high: int,
    step: int,
    count: int,
    east_low: int,
    east_high: int,
) -> Distance:
    """Distances of a row of cells from its lower, middle and upper row of posts below."""
    found = Distance()
    begin = int(0)
    if step == 2:
        found = plain_distances(pool, low, middle, high, count - 1)
        begin = count - 1
        if found.rest < _ZERO:
            found = Distance()
            begin = 0
    half = step >> 1
    for c in range(begin, count):
        at = step * c
        near = pool[(low + at) & _NO_SIGN]
        above = pool[(high + at) & _NO_SIGN]
        right = pool[wp.where(c == count - 1, east_low, low + at + step) & _NO_SIGN]
        far = pool[wp.where(c == count - 1, east_high, high + at + step) & _NO_SIGN]
        bottom = pool[(low + at + half) & _NO_SIGN]
        side = pool[(middle + at) & _NO_SIGN]
        centre = pool[(middle + at + half) & _NO_SIGN]
        found.along = wp.max(found.along, edge_distance(near, bottom, right))
        found.rest = wp.max(found.rest, edge_distance(near, side, above))
        found.rest = wp.max(found.rest, edge_distance(near, centre, far))
    return found


@wp.func
def measure_row(pool: wp.array(dtype=int), piece: Piece, row: int) -> Distance:
    """Distances of one row of a piece's cells."""
    from_row = piece.from_row + piece.row_step * row
    from_col = piece.from_col + piece.col_step * piece.col
    low = offset_in_pool(piece.own, from_row, from_col)
    middle = low + (piece.row_step >> 1) * _PITCH
    high = low + piece.row_step * _PITCH
    end = piece.col + piece.cols
    east_low = low + piece.col_step * piece.cols
    east_high = high + piece.col_step * piece.cols
    if end > _MASK:
        east_low = offset_in_pool(piece.east, from_row, piece.east_col)
        east_high = offset_in_pool(piece.east, from_row + piece.row_step, piece.east_col)
    if row == _MASK:
        high = offset_in_pool(piece.north, piece.north_row, from_col)
        east_high = high + piece.col_step * piece.cols
        if end > _MASK:
            east_high = offset_in_pool(piece.corner, piece.north_row, piece.east_col)
    return distances(pool, low, middle, high, piece.col_step, piece.cols, east_low, east_high)


@wp.func
def first_edge(pool: wp.array(dtype=int), piece: Piece, row: int) -> wp.int64:
    """Distance of the middle post of a row's first edge along y."""
    from_row = piece.from_row + piece.row_step * row
    from_col = piece.from_col + piece.col_step * piece.col
    low = offset_in_pool(piece.own, from_row, from_col)
    high = offset_in_pool(piece.own, from_row + piece.row_step, from_col)
    if row == _MASK:
        high = offset_in_pool(piece.north, piece.north_row, from_col)
    middle = (low + (piece.row_step >> 1) * _PITCH) & _NO_SIGN
    return edge_distance(pool[low], pool[middle], pool[high])


@wp.kernel(enable_backward=False)
def carry_up(
    # Terrain:
    pool: wp.array(dtype=int),
    # Pieces, QUADRANT rows each:
    pieces: wp.array(dtype=Piece),
    place: wp.array(dtype=int),
    # Out: -lowest, highest, -lowest before, highest before [counts], then distances [half counts]:
    # of the row's cells, of its edges on the block's southern side, of that on its western side.
    # The largest of all rows is the piece's; nothing is the least that can be.
    tally_out: wp.array2d(dtype=wp.int64),
):
    """Sample one row of a piece and measure its cells."""
    i = wp.tid() & _NO_SIGN
    piece = pieces[place[i] >> _SHIFT]
    k = place[i] & _MASK
    row = piece.row + k
    extent = Extent()
    extent.lowest = _MAX
    extent.highest = _HOLE
    extent.old_lowest = _MAX
    extent.old_highest = _HOLE
    error = wp.int64(-1)
    south = wp.int64(-1)
    west = wp.int64(-1)
    if k < piece.rows:
        if piece.layer >= 0:
            from_row = piece.from_row + piece.row_step * row
            from_col = piece.from_col + piece.col_step * piece.col
            source = offset_in_pool(piece.own, from_row, from_col)
            target = offset_in_pool(piece.layer, 0, 0) + piece.place + row * _PITCH + piece.col
            extent = sample_row(pool, source, piece.col_step, target, piece.cols)
        if piece.measure == 1:
            found = measure_row(pool, piece, row)
            error = wp.max(found.along, found.rest)
            if row == 0 and piece.place < _PITCH:
                south = found.along
            if piece.col == 0 and (piece.place & (_PITCH - 1)) == 0:
                west = first_edge(pool, piece, row)
    tally_out[i, 0] = -wp.int64(extent.lowest)
    tally_out[i, 1] = wp.int64(extent.highest)
    tally_out[i, 2] = -wp.int64(extent.old_lowest)
    tally_out[i, 3] = wp.int64(extent.old_highest)
    tally_out[i, 4] = error
    tally_out[i, 5] = south
    tally_out[i, 6] = west


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
    p = offset_in_pool(layers[place[i] >> 8], row, 0)
    end = p + _BLOCK
    lowest = int(_MAX)
    highest = int(_HOLE)
    while p < end:
        count = pool[p & _NO_SIGN]
        highest = wp.max(highest, count)
        lowest = wp.min(lowest, wp.where(count == _HOLE, _MAX, count))
        p += 1
    range_out[i, 0] = -wp.int64(lowest)
    range_out[i, 1] = wp.int64(highest)
