"""From a post's indices to its place in the pool, by floor, ``>>`` and ``&`` alone.

The table is one int32 array. It begins with a header of four integers a level, followed by every
level's directory (one entry a page: where that page begins in the table) and by the pages (one
entry a block: its layer in the pool, or -1). The first page stays all -1 and serves every part of
the terrain where nothing is resident, so that a lookup never branches::

    header[level] = directory start, directory columns, first page row, first page column
    page          = directory start + (block_row >> 6) * columns + (block_col >> 6)
    layer         = table[table[page] + ((block_row & 63) << 6) + (block_col & 63)]
"""

import warp as wp

BLOCK_SHIFT = 8
BLOCK = 1 << BLOCK_SHIFT
"""Posts along a block's side. 256 by measurement: see the README's numerics section."""
PAGE_SHIFT = 6
PAGE = 1 << PAGE_SHIFT
"""Blocks along a page's side."""
HEADER = 4
"""Header integers a level."""
ABSENT = -1
"""Table entry of a block that is not resident."""

_BLOCK_SHIFT = wp.constant(BLOCK_SHIFT)
_BLOCK_MASK = wp.constant(BLOCK - 1)
_LAYER_SHIFT = wp.constant(2 * BLOCK_SHIFT)
_PAGE_SHIFT = wp.constant(PAGE_SHIFT)
_PAGE_MASK = wp.constant(PAGE - 1)
_LEVEL_MASK = wp.constant(31)
# Warp counts a negative index from the array's end. Where the compiler can see that an index has no
# sign it leaves that test out: worth a sixth of a query's time on the CPU.
_NO_SIGN = wp.constant(0x7FFFFFFF)


@wp.func
def layer_of(table: wp.array(dtype=int), level: int, block_row: int, block_col: int) -> int:
    """Layer of a block, or -1. The block must be one of the level's."""
    head = (level & _LEVEL_MASK) << 2
    row = (block_row >> _PAGE_SHIFT) - table[head + 2]
    col = (block_col >> _PAGE_SHIFT) - table[head + 3]
    page = table[(table[head] + row * table[head + 1] + col) & _NO_SIGN]
    place = ((block_row & _PAGE_MASK) << _PAGE_SHIFT) + (block_col & _PAGE_MASK)
    return table[(page + place) & _NO_SIGN]


@wp.func
def offset_in_pool(layer: int, row: int, col: int) -> int:
    """Flat place in the pool of a post of a resident block; ``row`` and ``col`` of the level."""
    place = ((row & _BLOCK_MASK) << _BLOCK_SHIFT) + (col & _BLOCK_MASK)
    return ((layer << _LAYER_SHIFT) + place) & _NO_SIGN


@wp.func
def post_or_absent(
    pool: wp.array(dtype=int), table: wp.array(dtype=int), level: int, row: int, col: int
) -> wp.vec2i:
    """A post's count and the layer that holds it, -1 where it is not resident."""
    layer = layer_of(table, level, row >> _BLOCK_SHIFT, col >> _BLOCK_SHIFT)
    if layer < 0:
        return wp.vec2i(0, -1)
    return wp.vec2i(pool[offset_in_pool(layer, row, col)], layer)
