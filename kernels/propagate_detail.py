"""Level 1 where the ground has detail: sampled from base and detail, compared with the base.

These kernels read posts one by one. They need only one block of level 0 at a time, so that its
detail is all that must find room: what lies beyond it is read from level 1, once that is sampled.
"""

import warp as wp

from terrasim.kernels.addressing import layer_of, offset_in_pool
from terrasim.kernels.detail import detail_at
from terrasim.kernels.lattice import Lattice
from terrasim.kernels.level_distance import edge_distance
from terrasim.kernels.propagate import (
    QUADRANT,
    Distances,
    Extent,
    Piece,
    target_of,
    tell,
)

_HOLE = wp.constant(-(2**31))
_MAX = wp.constant(2**31 - 1)
_MOST = wp.constant(wp.int64(2**31 - 1))
_NONE = wp.constant(wp.int64(-1))
_QUADRANT = wp.constant(QUADRANT)
_SHIFT = wp.constant(7)
_MASK = wp.constant(QUADRANT - 1)
_BLOCK_SHIFT = wp.constant(8)
_LAST = wp.constant(255)
_NO_SIGN = wp.constant(0x7FFFFFFF)


@wp.func
def rounded(detail: int, factor: int) -> wp.int64:
    """A difference of the detail as whole counts, halves to even.

    Exact: a quotient that is no half is too far from one for float64 to take it for one.
    """
    return wp.int64(wp.rint(wp.float64(detail) / wp.float64(factor)))


@wp.func
def below_at(pool: wp.array(dtype=int), piece: Piece, row: int, col: int, up: int, on: int) -> int:
    """A post of the block below: ``up`` and ``on`` are 1 for one halfway to the next of a level."""
    from_row = piece.from_row + piece.row_step * row + (piece.row_step >> 1) * up
    from_col = piece.from_col + piece.col_step * col + (piece.col_step >> 1) * on
    return pool[offset_in_pool(piece.own, from_row, from_col)]


@wp.func
def sampled(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    piece: Piece,
    row: int,
    col: int,
) -> int:
    """A post of level 1 in a piece's quadrant, from base and detail."""
    base = below_at(pool, piece, row, col, 0, 0)
    if base == _HOLE:
        return base
    # The base repeats its edge beyond the terrain, the detail does not.
    base_row = (piece.own_row << _BLOCK_SHIFT) + piece.from_row + piece.row_step * row
    base_col = (piece.own_col << _BLOCK_SHIFT) + piece.from_col + piece.col_step * col
    base_row = wp.clamp(base_row, lattice.row, lattice.last_row + 1)
    base_col = wp.clamp(base_col, lattice.col, lattice.last_col + 1)
    detail_row = (base_row - lattice.row0) * lattice.factor
    detail_col = (base_col - lattice.col0) * lattice.factor
    detail = detail_at(pool, table, lattice, detail_row, detail_col)
    return int(wp.clamp(wp.int64(base) + rounded(detail, lattice.factor), -_MOST, _MOST))


@wp.func
def corner_at(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    piece: Piece,
    row: int,
    col: int,
) -> int:
    """A post of level 1 in a piece's quadrant or next to it."""
    if row < _QUADRANT and col < _QUADRANT:
        return sampled(pool, table, lattice, piece, row, col)
    # Beyond the level's last block its posts repeat the last one.
    level_row = wp.min(piece.first_row + row, piece.last_row)
    level_col = wp.min(piece.first_col + col, piece.last_col)
    layer = layer_of(table, 1, level_row >> _BLOCK_SHIFT, level_col >> _BLOCK_SHIFT)
    return pool[offset_in_pool(layer, level_row, level_col)]


@wp.kernel(enable_backward=False)
def sample_with_detail(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    # Pieces and out: as those of ``carry_up``.
    pieces: wp.array(dtype=Piece),
    place: wp.array(dtype=int),
    tally_out: wp.array2d(dtype=wp.int64),
):
    """Sample one row of a piece of level 1 from base and detail together."""
    i = wp.tid() & _NO_SIGN
    piece = pieces[place[i] >> _SHIFT]
    row = piece.row + (place[i] & _MASK)
    extent = Extent(_MAX, _HOLE, _MAX, _HOLE)
    if row < piece.row + piece.rows:
        target = target_of(piece, row)
        for k in range(piece.cols):
            new = sampled(pool, table, lattice, piece, row, piece.col + k)
            old = pool[(target + k) & _NO_SIGN]
            pool[(target + k) & _NO_SIGN] = new
            extent.highest = wp.max(extent.highest, new)
            extent.lowest = wp.min(extent.lowest, wp.where(new == _HOLE, _MAX, new))
            extent.old_highest = wp.max(extent.old_highest, old)
            extent.old_lowest = wp.min(extent.old_lowest, wp.where(old == _HOLE, _MAX, old))
    tell(extent, Distances(_NONE, _NONE, _NONE), i, tally_out)


@wp.kernel(enable_backward=False)
def measure_with_detail(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    # Pieces and out: as those of ``carry_up``.
    pieces: wp.array(dtype=Piece),
    place: wp.array(dtype=int),
    tally_out: wp.array2d(dtype=wp.int64),
):
    """Compare one row of cells of level 1, detail in them, with the middle posts of the base."""
    i = wp.tid() & _NO_SIGN
    piece = pieces[place[i] >> _SHIFT]
    row = piece.row + (place[i] & _MASK)
    found = Distances(_NONE, _NONE, _NONE)
    if row < piece.row + piece.rows:
        for col in range(piece.col, piece.col + piece.cols):
            near = corner_at(pool, table, lattice, piece, row, col)
            right = corner_at(pool, table, lattice, piece, row, col + 1)
            above = corner_at(pool, table, lattice, piece, row + 1, col)
            far = corner_at(pool, table, lattice, piece, row + 1, col + 1)
            bottom = edge_distance(near, below_at(pool, piece, row, col, 0, 1), right)
            side = edge_distance(near, below_at(pool, piece, row, col, 1, 0), above)
            centre = edge_distance(near, below_at(pool, piece, row, col, 1, 1), far)
            found.cells = wp.max(wp.max(found.cells, bottom), wp.max(side, centre))
            if ((piece.first_row + row) & _LAST) == 0:
                found.south = wp.max(found.south, bottom)
            if ((piece.first_col + col) & _LAST) == 0:
                found.west = wp.max(found.west, side)
    tell(Extent(_MAX, _HOLE, _MAX, _HOLE), found, i, tally_out)
