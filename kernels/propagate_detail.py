"""Level 1 sampled anew from base and detail together."""

import warp as wp

from terrasim.kernels.addressing import offset_in_pool
from terrasim.kernels.detail import detail_at, has_detail
from terrasim.kernels.lattice import Lattice
from terrasim.kernels.propagate import (
    QUADRANT,
    Distances,
    Extent,
    Piece,
    measure_row,
    sample_piece_row,
    target_of,
    tell,
)

_HOLE = wp.constant(-(2**31))
_MAX = wp.constant(2**31 - 1)
_MOST = wp.constant(wp.int64(2**31 - 1))
_NONE = wp.constant(wp.int64(-1))
_SHIFT = wp.constant(7)
_MASK = wp.constant(QUADRANT - 1)
_BLOCK_SHIFT = wp.constant(8)
_NO_SIGN = wp.constant(0x7FFFFFFF)


@wp.func
def rounded(detail: int, factor: int) -> wp.int64:
    """A difference of the detail as whole counts, halves to even.

    Exact: a quotient that is no half is too far from one for float64 to take it for one.
    """
    return wp.int64(wp.rint(wp.float64(detail) / wp.float64(factor)))


@wp.func
def sample_detail_row(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    piece: Piece,
    row: int,
) -> Extent:
    """Sample one row of a piece of level 1 from base and detail together."""
    extent = Extent(_MAX, _HOLE, _MAX, _HOLE)
    target = target_of(piece, row)
    from_row = piece.from_row + piece.row_step * row
    base_row = (piece.own_row << _BLOCK_SHIFT) + from_row
    # The base repeats its edge beyond the terrain, the detail does not.
    base_row = wp.clamp(base_row, lattice.row, lattice.last_row + 1)
    for i in range(piece.cols):
        from_col = piece.from_col + piece.col_step * (piece.col + i)
        base_col = (piece.own_col << _BLOCK_SHIFT) + from_col
        base_col = wp.clamp(base_col, lattice.col, lattice.last_col + 1)
        new = pool[offset_in_pool(piece.own, from_row, from_col)]
        if new != _HOLE:
            detail_row = (base_row - lattice.row0) * lattice.factor
            detail_col = (base_col - lattice.col0) * lattice.factor
            detail = detail_at(pool, table, lattice, detail_row, detail_col)
            total = wp.int64(new) + rounded(detail, lattice.factor)
            new = int(wp.clamp(total, -_MOST, _MOST))
            extent.lowest = wp.min(extent.lowest, new)
        extent.highest = wp.max(extent.highest, new)
        old = pool[(target + i) & _NO_SIGN]
        pool[(target + i) & _NO_SIGN] = new
        extent.old_highest = wp.max(extent.old_highest, old)
        extent.old_lowest = wp.min(extent.old_lowest, wp.where(old == _HOLE, _MAX, old))
    return extent


@wp.kernel(enable_backward=False)
def carry_detail_up(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    # Pieces and out: as those of ``carry_up``.
    pieces: wp.array(dtype=Piece),
    place: wp.array(dtype=int),
    tally_out: wp.array2d(dtype=wp.int64),
):
    """Sample one row of a piece of level 1 and measure its cells, these against the base alone."""
    i = wp.tid() & _NO_SIGN
    piece = pieces[place[i] >> _SHIFT]
    row = piece.row + (place[i] & _MASK)
    extent = Extent(_MAX, _HOLE, _MAX, _HOLE)
    distances = Distances(_NONE, _NONE, _NONE)
    if row < piece.row + piece.rows:
        if piece.layer >= 0:
            if has_detail(table, lattice, piece.own):
                extent = sample_detail_row(pool, table, lattice, piece, row)
            else:
                extent = sample_piece_row(pool, piece, row)
        if piece.measure == 1:
            distances = measure_row(pool, piece, row)
    tell(extent, distances, i, tally_out)
