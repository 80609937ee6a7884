"""Stamps, and the kernel that adds gaussians and craters to a row of posts.

Each stamp's rise is rounded by itself, so that the order of stamps that are only added does not
matter. It is split into a part of x, a part of y and what joins the two: a gaussian is a product of
exponentials, and a crater joins two squares.
"""

import warp as wp

from terrasim.kernels.addressing import offset_in_pool
from terrasim.kernels.edit_row import (
    Posts,
    RowTally,
    begin_row,
    close_row,
    met_end,
    moved,
    range_of_row,
    within,
)
from terrasim.kernels.shapes import GAUSSIAN, crater_at

ADD = 0
DIG = 1
FILL = 2
REPLACE = 3
BLEND = 4

_GAUSSIAN = wp.constant(GAUSSIAN)
_MASK = wp.constant(255)
_BLOCK = wp.constant(256)
_SHIFT = wp.constant(8)
# Warp counts a negative index from the array's end; it leaves that test out where none can be.
_NO_SIGN = wp.constant(0x7FFFFFFF)


@wp.struct
class Stamp:
    """One stamp, placed."""

    kind: int
    """Its formula in ``kernels/shapes.py``."""
    mode: int
    """``ADD`` to ``BLEND``."""
    cell_row: int
    """Row of the cell its place lies in."""
    cell_col: int
    """Column of that cell."""
    row0: int
    """First row of posts that it may change, within the terrain."""
    row1: int
    """Last such row."""
    col0: int
    """First such column."""
    col1: int
    """Last such column."""
    across: int
    """Where its columns begin in the array of parts of x."""
    first: int
    """Where its data begin."""
    count: int
    """How long they are."""
    x: wp.float64
    """Its place within its cell, along x [m]."""
    y: wp.float64
    """Its place within its cell, along y [m]."""
    a: wp.float64
    """The four numbers of its shape; ``terrasim.deform.shapes`` says which."""
    b: wp.float64
    c: wp.float64
    d: wp.float64
    base: wp.float64
    """World height that its heights start from [counts above the datum]."""


@wp.struct
class BlockStamps:
    """A block to change and where its stamps stand in the list."""

    layer: int
    row: int
    """Row of blocks."""
    col: int
    """Column of blocks."""
    begin: int
    end: int


@wp.func
def part(stamp: Stamp, distance: wp.float64) -> wp.float64:
    """An added gaussian's or crater's part of one coordinate, at a distance along it [m]."""
    if stamp.kind == _GAUSSIAN:
        return wp.exp(distance * distance * stamp.b)
    return distance * distance


@wp.kernel(enable_backward=False)
def parts_of_x(
    # Posts:
    posts: Posts,
    stamps: wp.array(dtype=Stamp),
    # In:
    place: wp.array(dtype=int),
    owner: wp.array(dtype=int),
    # Out:
    across_out: wp.array(dtype=wp.float64),
):
    """Every such stamp's part of x at each column of posts it may change."""
    i = wp.tid()
    stamp = stamps[owner[i]]
    col = stamp.col0 + (place[i] - stamp.across)
    # The difference of the indices is exact wherever the terrain lies.
    across_out[i] = part(stamp, wp.float64(col - stamp.cell_col) * posts.spacing - stamp.x)


@wp.func
def add_gaussian(
    scale: wp.float64,
    across: wp.array(dtype=wp.float64),
    start: int,
    begin: int,
    end: int,
    value: wp.array(dtype=wp.float64),
    met: wp.array(dtype=int),
) -> wp.vec2l:
    """Add a row of a gaussian to posts ``begin`` to ``end``; returns what rose and what fell."""
    added = wp.int64(0)
    removed = wp.int64(0)
    c = int(begin)
    while c <= end:
        rise = wp.rint(scale * across[(start + c) & _NO_SIGN])
        old = value[c & _MASK]
        wanted = old + rise
        new = within(wanted)
        value[c & _MASK] = new
        met[c & _MASK] = met[c & _MASK] | met_end(wanted, new, rise)
        added += wp.max(moved(old, new), wp.int64(0))
        removed += wp.max(moved(new, old), wp.int64(0))
        c += 1
    return wp.vec2l(added, removed)


@wp.func
def add_crater(
    stamp: Stamp,
    unit: wp.float64,
    along: wp.float64,
    across: wp.array(dtype=wp.float64),
    start: int,
    begin: int,
    end: int,
    value: wp.array(dtype=wp.float64),
    met: wp.array(dtype=int),
) -> wp.vec2l:
    """Add a row of a crater to posts ``begin`` to ``end``; returns what rose and what fell."""
    added = wp.int64(0)
    removed = wp.int64(0)
    c = int(begin)
    while c <= end:
        square = across[(start + c) & _NO_SIGN] + along
        height = crater_at(square, stamp.a, stamp.b, stamp.c, stamp.d)[0]
        rise = wp.rint(height * unit)
        old = value[c & _MASK]
        wanted = old + rise
        new = within(wanted)
        value[c & _MASK] = new
        met[c & _MASK] = met[c & _MASK] | met_end(wanted, new, rise)
        added += wp.max(moved(old, new), wp.int64(0))
        removed += wp.max(moved(new, old), wp.int64(0))
        c += 1
    return wp.vec2l(added, removed)


@wp.func
def add_parts(
    posts: Posts,
    stamp: Stamp,
    across: wp.array(dtype=wp.float64),
    post_row: int,
    first_col: int,
    value: wp.array(dtype=wp.float64),
    met: wp.array(dtype=int),
) -> wp.vec2l:
    """Add a gaussian or a crater to a row of posts, whose first column is ``first_col``."""
    along = part(stamp, wp.float64(post_row - stamp.cell_row) * posts.spacing - stamp.y)
    begin = wp.max(0, stamp.col0 - first_col)
    end = wp.min(_MASK, stamp.col1 - first_col)
    start = stamp.across + (first_col - stamp.col0)
    if stamp.kind == _GAUSSIAN:
        scale = stamp.a * posts.unit * along
        return add_gaussian(scale, across, start, begin, end, value, met)
    return add_crater(stamp, posts.unit, along, across, start, begin, end, value, met)


@wp.func
def next_stamp(listed: wp.array(dtype=wp.vec4i), begin: int, end: int, row: int) -> int:
    """The next place in the list with a stamp that may change a row of posts, or ``end``."""
    k = int(begin)
    while k < end and (listed[k][1] > row or listed[k][2] < row):
        k += 1
    return k


@wp.func
def add_to_row(
    pool: wp.array(dtype=int),
    posts: Posts,
    stamps: wp.array(dtype=Stamp),
    across: wp.array(dtype=wp.float64),
    listed: wp.array(dtype=wp.vec4i),
    work: BlockStamps,
    row: int,
    post_row: int,
    begin: int,
) -> RowTally:
    """Add the stamps from place ``begin`` of the list on to a row of posts."""
    value = wp.zeros(shape=(_BLOCK,), dtype=wp.float64)
    met = wp.zeros(shape=(_BLOCK,), dtype=int)
    begin_row(pool, offset_in_pool(work.layer, row, 0), value)
    k = int(begin)
    while k < work.end:
        stamp = stamps[listed[k][0]]
        add_parts(posts, stamp, across, post_row, work.col << _SHIFT, value, met)
        k = next_stamp(listed, k + 1, work.end, post_row)
    return close_row(pool, posts, work.layer, work.row, work.col, row, value, met)


@wp.kernel(enable_backward=False)
def add_stamps(
    # Terrain:
    pool: wp.array(dtype=int),
    posts: Posts,
    # Stamps:
    stamps: wp.array(dtype=Stamp),
    across: wp.array(dtype=wp.float64),
    blocks: wp.array(dtype=BlockStamps),
    listed: wp.array(dtype=wp.vec4i),
    # In and out: a row of a block each, blocks one after another.
    place: wp.array(dtype=int),
    tally_out: wp.array(dtype=RowTally),
):
    """Add gaussians and craters to one row of posts of one block."""
    i = wp.tid() & _NO_SIGN
    work = blocks[place[i] >> _SHIFT]
    row = place[i] & _MASK
    # Posts beyond the terrain's edge repeat it.
    post_row = wp.clamp((work.row << _SHIFT) + row, posts.row, posts.last_row)
    begin = next_stamp(listed, work.begin, work.end, post_row)
    if begin == work.end:
        tally_out[i] = range_of_row(pool, offset_in_pool(work.layer, row, 0))
    else:
        tally_out[i] = add_to_row(pool, posts, stamps, across, listed, work, row, post_row, begin)
