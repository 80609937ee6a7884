"""Adding a rectangle of whole numbers to the differences of detail blocks."""

import warp as wp

from terrasim.kernels.addressing import offset_in_pool
from terrasim.kernels.detail import NO_GROUND, total_at
from terrasim.kernels.lattice import Lattice
from terrasim.kernels.patch import PatchBlock, added_at
from terrasim.kernels.stamps import RowTally

_MAX = wp.constant(2**31 - 1)
_MOST = wp.constant(wp.int64(2**31 - 1))
_MASK = wp.constant(255)
_BLOCK = wp.constant(256)
_SHIFT = wp.constant(8)
_ZERO = wp.constant(wp.int64(0))
_NO_SIGN = wp.constant(0x7FFFFFFF)
_NO_GROUND = wp.constant(wp.int64(NO_GROUND))


@wp.func
def has_ground(
    pool: wp.array(dtype=int), table: wp.array(dtype=int), lattice: Lattice, row: int, col: int
) -> int:
    """1 if there is ground at a detail post of the terrain, else 0."""
    cell_row = row / lattice.factor
    cell_col = col / lattice.factor
    i = row - cell_row * lattice.factor
    j = col - cell_col * lattice.factor
    total = total_at(pool, table, lattice, lattice.row0 + cell_row, lattice.col0 + cell_col, i, j)
    return wp.where(total == _NO_GROUND, 0, 1)


@wp.kernel(enable_backward=False)
def add_detail_patch(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    # Patch:
    first_row: int,
    first_col: int,
    counts: wp.array2d(dtype=int),
    blocks: wp.array(dtype=PatchBlock),
    # In and out: a row of a block each, blocks one after another.
    place: wp.array(dtype=int),
    tally_out: wp.array(dtype=RowTally),
):
    """Add a patch to one row of one detail block."""
    i = wp.tid() & _NO_SIGN
    block = blocks[place[i] >> _SHIFT]
    row = (block.row << _SHIFT) + (place[i] & _MASK)
    start = offset_in_pool(block.layer, place[i] & _MASK, 0)
    last_col = first_col + counts.shape[1] - 1
    tally = RowTally()
    tally.first = _BLOCK
    tally.last = -1
    tally.lowest = _MAX
    tally.highest = -_MAX
    for c in range(_BLOCK):
        col = (block.col << _SHIFT) + c
        rise = added_at(counts, row - first_row, first_col, last_col, col)
        old = pool[(start + c) & _NO_SIGN]
        new = old
        if rise != _ZERO:
            if has_ground(pool, table, lattice, row, col) == 0:
                tally.holes += 1
            else:
                wanted = wp.int64(old) + rise
                new = int(wp.clamp(wanted, -_MOST, _MOST))
                tally.clamped += wp.where(wanted == wp.int64(new), 0, 1)
                pool[(start + c) & _NO_SIGN] = new
        step = wp.int64(new) - wp.int64(old)
        if step != _ZERO:
            tally.first = wp.min(tally.first, c)
            tally.last = c
            tally.changed += 1
            tally.added += wp.max(step, _ZERO)
            tally.removed += wp.max(-step, _ZERO)
            tally.rose = wp.max(tally.rose, step)
            tally.fell = wp.max(tally.fell, -step)
        tally.lowest = wp.min(tally.lowest, new)
        tally.highest = wp.max(tally.highest, new)
    tally_out[i] = tally
