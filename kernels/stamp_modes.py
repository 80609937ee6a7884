"""Stamps of any shape and mode: the kernel that puts them to a row of posts in their order.

Gaussians and craters that are added take the same path as in ``kernels/stamps.py``, to the bit.
"""

import warp as wp

from terrasim.kernels.addressing import offset_in_pool, post_or_absent
from terrasim.kernels.detail import NO_GROUND, total_between
from terrasim.kernels.edit_row import (
    Posts,
    RowTally,
    begin_row,
    close_row,
    is_hole,
    met_end,
    moved,
    range_of_row,
    within,
)
from terrasim.kernels.lattice import Lattice
from terrasim.kernels.shapes import CRATER, shape_at
from terrasim.kernels.stamps import (
    ADD,
    DIG,
    FILL,
    REPLACE,
    BlockStamps,
    Stamp,
    add_parts,
    next_stamp,
)

_CRATER = wp.constant(CRATER)
_ADD = wp.constant(ADD)
_DIG = wp.constant(DIG)
_FILL = wp.constant(FILL)
_REPLACE = wp.constant(REPLACE)
_BLOCK = wp.constant(256)
_MASK = wp.constant(255)
_SHIFT = wp.constant(8)
_NO_SIGN = wp.constant(0x7FFFFFFF)
_NOT_A_NUMBER = wp.constant(wp.float64(float("nan")))
_NO_GROUND = wp.constant(wp.int64(NO_GROUND))


@wp.func
def wanted_height(
    mode: int, height: wp.float64, weight: wp.float64, rise: wp.float64, surface: wp.float64
) -> wp.float64:
    """What a stamp makes of a post of a height, all in whole counts; a hole stays one."""
    if mode == _ADD:
        return height + rise
    if mode == _DIG:
        return wp.where(surface < height, surface, height)
    if mode == _FILL:
        return wp.where(surface > height, surface, height)
    if mode == _REPLACE:
        return wp.where(is_hole(height), height, surface)
    return height + wp.rint(weight * (surface - height))


@wp.func
def begin_detail_row(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    work: BlockStamps,
    row: int,
    last: int,
    value: wp.array(dtype=wp.float64),
    ground: wp.array(dtype=wp.float64),
):
    """Take up posts 0 to ``last`` of a row of detail, and the base's surface at each."""
    start = offset_in_pool(work.layer, row, 0)
    first_col = work.col << _SHIFT
    detail_row = (work.row << _SHIFT) + row
    cell_row = detail_row / lattice.factor
    i = detail_row - cell_row * lattice.factor
    low = lattice.row0 + cell_row
    # Beyond the terrain's last posts there may be no block; what is read instead weighs nothing.
    high = wp.min(low + 1, lattice.last_row + 1)
    c = int(0)
    while c <= last:
        cell_col = (first_col + c) / lattice.factor
        j = first_col + c - cell_col * lattice.factor
        left = lattice.col0 + cell_col
        right = wp.min(left + 1, lattice.last_col + 1)
        near = post_or_absent(pool, table, 0, low, left)[0]
        east = post_or_absent(pool, table, 0, low, right)[0]
        north = post_or_absent(pool, table, 0, high, left)[0]
        far = post_or_absent(pool, table, 0, high, right)[0]
        end = wp.min(last, c + lattice.factor - 1 - j)
        while c <= end:
            mid = wp.where(j >= i, east, north)
            total = total_between(lattice.factor, near, mid, far, wp.max(i, j), wp.min(i, j))
            old = wp.float64(pool[(start + c) & _NO_SIGN])
            value[c & _MASK] = wp.where(total == _NO_GROUND, _NOT_A_NUMBER, old)
            ground[c & _MASK] = wp.where(total == _NO_GROUND, wp.float64(0.0), wp.float64(total))
            j += 1
            c += 1


@wp.func
def stamp_row(
    posts: Posts,
    stamp: Stamp,
    data: wp.array(dtype=wp.float64),
    post_row: int,
    first_col: int,
    ground: wp.array(dtype=wp.float64),
    value: wp.array(dtype=wp.float64),
    met: wp.array(dtype=int),
) -> wp.vec2l:
    """Put a stamp to a row of posts from column ``first_col`` on; returns what rose and fell."""
    added = wp.int64(0)
    removed = wp.int64(0)
    dy = wp.float64(post_row - stamp.cell_row) * posts.spacing - stamp.y
    c = wp.max(0, stamp.col0 - first_col)
    end = wp.min(_MASK, stamp.col1 - first_col)
    while c <= end:
        dx = wp.float64(first_col + c - stamp.cell_col) * posts.spacing - stamp.x
        found = shape_at(
            stamp.kind, stamp.a, stamp.b, stamp.c, stamp.d, data, stamp.first, stamp.count, dx, dy
        )
        if found[1] > wp.float64(0.0):
            rise = wp.rint(found[0] * posts.unit)
            # Detail is kept as the difference to the base's surface, and so is the stamp's own.
            surface = wp.rint(stamp.base + found[0] * posts.unit) - ground[c & _MASK]
            old = value[c & _MASK]
            wanted = wanted_height(stamp.mode, old, found[1], rise, surface)
            new = within(wanted)
            value[c & _MASK] = new
            adds = wp.where(stamp.mode == _ADD, rise, wp.float64(1.0))
            met[c & _MASK] = met[c & _MASK] | met_end(wanted, new, adds)
            added += wp.max(moved(old, new), wp.int64(0))
            removed += wp.max(moved(new, old), wp.int64(0))
        c += 1
    return wp.vec2l(added, removed)


@wp.func
def stamp_in_order(
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    posts: Posts,
    stamps: wp.array(dtype=Stamp),
    across: wp.array(dtype=wp.float64),
    data: wp.array(dtype=wp.float64),
    listed: wp.array(dtype=wp.vec4i),
    work: BlockStamps,
    row: int,
    begin: int,
    share_out: wp.array(dtype=wp.vec2l),
) -> RowTally:
    """Put the stamps from place ``begin`` of the list on to a row of posts."""
    value = wp.zeros(shape=(_BLOCK,), dtype=wp.float64)
    met = wp.zeros(shape=(_BLOCK,), dtype=int)
    first_col = work.col << _SHIFT
    post_row = wp.clamp((work.row << _SHIFT) + row, posts.row, posts.last_row)
    ground = wp.zeros(shape=(_BLOCK,), dtype=wp.float64)
    if posts.detail == 1:
        last = wp.min(_MASK, posts.last_col - first_col)
        begin_detail_row(pool, table, lattice, work, row, last, value, ground)
    else:
        begin_row(pool, offset_in_pool(work.layer, row, 0), value)
    # Rows beyond the terrain's edge repeat it and are not counted.
    shared = share_out.shape[0] > 0 and post_row == (work.row << _SHIFT) + row
    k = int(begin)
    while k < work.end:
        one = listed[k]
        stamp = stamps[one[0]]
        share = wp.vec2l(wp.int64(0), wp.int64(0))
        if stamp.mode == _ADD and stamp.kind <= _CRATER:
            share = add_parts(posts, stamp, across, post_row, first_col, value, met)
        else:
            share = stamp_row(posts, stamp, data, post_row, first_col, ground, value, met)
        if shared:
            share_out[one[3] + (post_row - one[1])] = share
        k = next_stamp(listed, k + 1, work.end, post_row)
    return close_row(pool, posts, work.layer, work.row, work.col, row, value, met)


@wp.kernel(enable_backward=False)
def apply_stamps(
    # Terrain:
    pool: wp.array(dtype=int),
    table: wp.array(dtype=int),
    lattice: Lattice,
    posts: Posts,
    # Stamps:
    stamps: wp.array(dtype=Stamp),
    across: wp.array(dtype=wp.float64),
    data: wp.array(dtype=wp.float64),
    blocks: wp.array(dtype=BlockStamps),
    listed: wp.array(dtype=wp.vec4i),
    # Out, if it has any length: what each stamp added to and took from each row.
    share_out: wp.array(dtype=wp.vec2l),
    # In and out: a row of a block each, blocks one after another.
    place: wp.array(dtype=int),
    tally_out: wp.array(dtype=RowTally),
):
    """Put stamps to one row of posts of one block, one after another."""
    i = wp.tid() & _NO_SIGN
    work = blocks[place[i] >> _SHIFT]
    row = place[i] & _MASK
    post_row = wp.clamp((work.row << _SHIFT) + row, posts.row, posts.last_row)
    begin = next_stamp(listed, work.begin, work.end, post_row)
    if posts.detail == 1 and post_row != (work.row << _SHIFT) + row:
        # There is no detail beyond the terrain.
        begin = work.end
    if begin == work.end:
        tally_out[i] = range_of_row(pool, offset_in_pool(work.layer, row, 0))
    else:
        tally_out[i] = stamp_in_order(
            pool,
            table,
            lattice,
            posts,
            stamps,
            across,
            data,
            listed,
            work,
            row,
            begin,
            share_out,
        )
