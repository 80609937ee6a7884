"""Adding a rectangle of whole numbers to the posts of blocks."""

import warp as wp

from terrasim.kernels.addressing import offset_in_pool
from terrasim.kernels.stamps import Posts, RowTally

_HOLE = wp.constant(-(2**31))
_MAX = wp.constant(2**31 - 1)
_MASK = wp.constant(255)
_BLOCK = wp.constant(256)
_SHIFT = wp.constant(8)
_NO_SIGN = wp.constant(0x7FFFFFFF)


@wp.struct
class PatchBlock:
    """A block to change."""

    layer: int
    row: int
    """Row of blocks."""
    col: int
    """Column of blocks."""


@wp.func
def added_at(
    counts: wp.array2d(dtype=int), row: int, first_col: int, last_col: int, col: int
) -> wp.int64:
    """What is added to a column's post; ``row`` and ``first_col`` are the patch's."""
    if row < 0 or row >= counts.shape[0] or col < first_col or col > last_col:
        return wp.int64(0)
    return wp.int64(counts[row & _NO_SIGN, (col - first_col) & _NO_SIGN])


@wp.func
def add_row(
    pool: wp.array(dtype=int),
    start: int,
    posts: Posts,
    counts: wp.array2d(dtype=int),
    row: int,
    first_col: int,
    block_col: int,
) -> RowTally:
    """Add a row of a patch to a row of posts; only those within the terrain are counted."""
    tally = RowTally()
    tally.first = _BLOCK
    tally.last = -1
    tally.lowest = _MAX
    tally.highest = _HOLE
    last_col = first_col + counts.shape[1] - 1
    for c in range(_BLOCK):
        post_col = (block_col << _SHIFT) + c
        col = wp.clamp(post_col, posts.col, posts.last_col)
        rise = added_at(counts, row, first_col, last_col, col)
        old = pool[(start + c) & _NO_SIGN]
        wanted = wp.int64(old) + rise
        new = old
        if old != _HOLE:
            new = int(wp.clamp(wanted, wp.int64(-_MAX), wp.int64(_MAX)))
            pool[(start + c) & _NO_SIGN] = new
            tally.lowest = wp.min(tally.lowest, new)
        tally.highest = wp.max(tally.highest, new)
        step = wp.int64(new) - wp.int64(old)
        tally.rose = wp.max(tally.rose, step)
        tally.fell = wp.max(tally.fell, -step)
        if step != wp.int64(0):
            tally.first = wp.min(tally.first, c)
            tally.last = c
        if col == post_col and rise != wp.int64(0):
            tally.added += wp.max(step, wp.int64(0))
            tally.removed += wp.max(-step, wp.int64(0))
            tally.changed += wp.where(step != wp.int64(0), 1, 0)
            tally.holes += wp.where(old == _HOLE, 1, 0)
            tally.clamped += wp.where(wanted != wp.int64(new) and old != _HOLE, 1, 0)
    return tally


@wp.kernel(enable_backward=False)
def add_patch(
    # Terrain:
    pool: wp.array(dtype=int),
    posts: Posts,
    # Patch:
    first_row: int,
    first_col: int,
    counts: wp.array2d(dtype=int),
    blocks: wp.array(dtype=PatchBlock),
    # In and out: a row of a block each, blocks one after another.
    place: wp.array(dtype=int),
    tally_out: wp.array(dtype=RowTally),
):
    """Add a patch to one row of posts of one block; those beyond the terrain repeat its edge."""
    i = wp.tid() & _NO_SIGN
    block = blocks[place[i] >> _SHIFT]
    post_row = (block.row << _SHIFT) + (place[i] & _MASK)
    inside = wp.clamp(post_row, posts.row, posts.last_row)
    start = offset_in_pool(block.layer, place[i] & _MASK, 0)
    tally = add_row(pool, start, posts, counts, inside - first_row, first_col, block.col)
    if inside != post_row:
        tally.added = wp.int64(0)
        tally.removed = wp.int64(0)
        tally.changed = 0
        tally.holes = 0
        tally.clamped = 0
    tally_out[i] = tally
