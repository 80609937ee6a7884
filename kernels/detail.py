"""The detail: differences to the base's surface on a grid ``factor`` times finer.

Detail posts are numbered from the terrain's first block, and their differences are counts divided
by the factor, so that base plus detail is a whole number at every one of them. Within a detail cell
the surface is its own two triangles, split as all cells are; they lie in one triangle of the base.

Blocks of detail lie in the same pool, behind the blocks of levels. A block of level 0 is never
there without its detail. At the end of a pointer table stand a flag for each layer of a level's
block, 1 if it has detail, and a hash of the detail blocks: slots of row, column and layer of a
block, -1 for the layer of an empty one, with linear probing. A block that is not in it is all zero.
"""

import warp as wp

from terrasim.kernels.addressing import layer_of, offset_in_pool, post_or_absent
from terrasim.kernels.lattice import Lattice

SLOT = 3
"""Integers of a slot of the hash."""
ROW_FACTOR = 0x9E3779B1
"""What a detail block's row is multiplied by to find its slot."""
COL_FACTOR = 0x85EBCA77
"""What its column is multiplied by."""
HASH_SHIFT = 15
"""How far the product's upper bits are brought down."""
NO_GROUND = -(2**63 - 1)
"""Total of a detail post without ground."""

_BLOCK_SHIFT = wp.constant(8)
_LAST = wp.constant(255)
_PITCH = wp.constant(256)
_SLOT = wp.constant(SLOT)
_ROW_FACTOR = wp.constant(wp.uint32(ROW_FACTOR))
_COL_FACTOR = wp.constant(wp.uint32(COL_FACTOR))
_HASH_SHIFT = wp.constant(wp.uint32(HASH_SHIFT))
_NO_SIGN = wp.constant(0x7FFFFFFF)
_HOLE = wp.constant(-(2**31))
_NO_GROUND = wp.constant(wp.int64(NO_GROUND))
_ZERO = wp.constant(wp.int64(0))


@wp.func
def has_detail(table: wp.array(dtype=int), lattice: Lattice, layer: int) -> bool:
    """Whether a resident block of level 0 has detail; ``layer`` is the block's."""
    if lattice.factor > 1:
        return table[lattice.detail + layer] == 1
    return False


@wp.func
def detail_layer(
    table: wp.array(dtype=int), lattice: Lattice, block_row: int, block_col: int
) -> int:
    """Layer of a detail block, -1 if it is all zero."""
    mixed = wp.uint32(block_row) * _ROW_FACTOR + wp.uint32(block_col) * _COL_FACTOR
    slot = int(mixed ^ (mixed >> _HASH_SHIFT)) & lattice.mask
    first = lattice.detail + lattice.layers
    place = int(first + slot * _SLOT)
    while table[place + 2] >= 0 and (table[place] != block_row or table[place + 1] != block_col):
        slot = (slot + 1) & lattice.mask
        place = first + slot * _SLOT
    return table[place + 2]


@wp.func
def detail_at(
    pool: wp.array(dtype=int), table: wp.array(dtype=int), lattice: Lattice, row: int, col: int
) -> int:
    """The difference at a detail post; the level-0 blocks round it must be resident."""
    layer = detail_layer(table, lattice, row >> _BLOCK_SHIFT, col >> _BLOCK_SHIFT)
    if layer < 0:
        return 0
    return pool[offset_in_pool(layer, row, col)]


@wp.func
def detail_triangle(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    row: int,
    col: int,
    right: int,
) -> wp.vec3i:
    """The differences at a triangle's near, middle and far post; ``row`` and ``col`` of the near.

    ``right`` is 1 for the triangle of (x+, y-).
    """
    if (row & _LAST) != _LAST and (col & _LAST) != _LAST:
        layer = detail_layer(table, lattice, row >> _BLOCK_SHIFT, col >> _BLOCK_SHIFT)
        if layer < 0:
            return wp.vec3i(0, 0, 0)
        near = offset_in_pool(layer, row, col)
        mid = (near + wp.where(right == 1, 1, _PITCH)) & _NO_SIGN
        return wp.vec3i(pool[near], pool[mid], pool[(near + _PITCH + 1) & _NO_SIGN])
    return wp.vec3i(
        detail_at(pool, table, lattice, row, col),
        detail_at(pool, table, lattice, row + 1 - right, col + right),
        detail_at(pool, table, lattice, row + 1, col + 1),
    )


@wp.func
def fine_at(table: wp.array(dtype=int), lattice: Lattice, row: int, col: int) -> int:
    """1 if a post in a level-0 cell, or on its edges, may have detail, else 0.

    The cell's level-0 blocks must be resident. Without a detail block over the cell its surface is
    the base's own.
    """
    if lattice.factor < 2:
        return 0
    layer = layer_of(table, 0, row >> _BLOCK_SHIFT, col >> _BLOCK_SHIFT)
    if layer >= 0 and (row & _LAST) != _LAST and (col & _LAST) != _LAST:
        if not has_detail(table, lattice, layer):
            return 0
    first_row = (row - lattice.row0) * lattice.factor
    first_col = (col - lattice.col0) * lattice.factor
    last_row = (first_row + lattice.factor) >> _BLOCK_SHIFT
    last_col = (first_col + lattice.factor) >> _BLOCK_SHIFT
    for r in range(first_row >> _BLOCK_SHIFT, last_row + 1):
        for c in range(first_col >> _BLOCK_SHIFT, last_col + 1):
            if detail_layer(table, lattice, r, c) >= 0:
                return 1
    return 0


@wp.func
def total_of(count: int) -> wp.int64:
    """A post's count as a whole number that can hold totals; ``NO_GROUND`` for a hole."""
    return wp.where(count == _HOLE, _NO_GROUND, wp.int64(count))


@wp.func
def weighed(
    factor: int, near: wp.int64, mid: wp.int64, far: wp.int64, larger: int, smaller: int
) -> wp.int64:
    """:func:`total_between` of posts that are whole numbers already."""
    first = wp.int64(factor - larger)
    second = wp.int64(larger - smaller)
    third = wp.int64(smaller)
    if (
        (first > _ZERO and near == _NO_GROUND)
        or (second > _ZERO and mid == _NO_GROUND)
        or (third > _ZERO and far == _NO_GROUND)
    ):
        return _NO_GROUND
    return first * near + second * mid + third * far


@wp.func
def total_between(
    factor: int, near: int, mid: int, far: int, larger: int, smaller: int
) -> wp.int64:
    """The base at a detail post of one of its triangles [counts / factor], exact.

    The post lies ``larger`` detail cells along the triangle's first leg and ``smaller`` along the
    second. ``NO_GROUND`` if a hole counts in it.
    """
    return weighed(factor, total_of(near), total_of(mid), total_of(far), larger, smaller)


@wp.func
def total_at(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    row: int,
    col: int,
    i: int,
    j: int,
) -> wp.int64:
    """Base plus detail at a detail post [counts / factor], exact; ``NO_GROUND`` in a hole.

    The post is row ``i`` and column ``j``, 0 to ``factor``, of those in level-0 cell
    ``(row, col)``, whose blocks must be resident.
    """
    lower = wp.where(j >= i, 1, 0)
    near = post_or_absent(pool, table, 0, row, col)
    mid = wp.vec2i(0, 0)
    far = wp.vec2i(0, 0)
    # Beyond the terrain's last posts there may be no block; their weight is 0.
    if i != j:
        mid = post_or_absent(pool, table, 0, row + 1 - lower, col + lower)
    if i > 0 and j > 0:
        far = post_or_absent(pool, table, 0, row + 1, col + 1)
    total = total_between(lattice.factor, near[0], mid[0], far[0], wp.max(i, j), wp.min(i, j))
    if total == _NO_GROUND:
        return total
    detail_row = (row - lattice.row0) * lattice.factor + i
    detail_col = (col - lattice.col0) * lattice.factor + j
    return total + wp.int64(detail_at(pool, table, lattice, detail_row, detail_col))
