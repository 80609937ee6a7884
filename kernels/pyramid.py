"""How far a coarse level's surface lies from the posts of level 0, in whole numbers.

Heights are scaled by 2^level, which makes the coarse surface whole at every level-0 post.
"""

import warp as wp

_HOLE = wp.constant(-(2**31))


@wp.func
def run_error(
    fine: wp.array2d(dtype=int),
    row: int,
    col: int,
    count: int,
    level: int,
    start: wp.int64,
    slope: wp.int64,
) -> wp.int64:
    """Largest scaled distance of ``count`` posts of a row from a line; holes are passed over."""
    line = start
    worst = wp.int64(0)
    for i in range(count):
        height = fine[row, col + i]
        if height != _HOLE:
            worst = wp.max(worst, wp.abs((wp.int64(height) << wp.int64(level)) - line))
        line += slope
    return worst


@wp.func
def below_error(
    fine: wp.array2d(dtype=int),
    bottom: int,
    left: int,
    first: int,
    last: int,
    level: int,
    p00: int,
    p10: int,
    p11: int,
) -> wp.int64:
    """Largest scaled distance in the triangle below the diagonal, over its rows first to last."""
    worst = wp.int64(0)
    if p00 != _HOLE and p10 != _HOLE and p11 != _HOLE:
        base = wp.int64(p00) << wp.int64(level)
        rise = wp.int64(p11) - wp.int64(p00)
        slope = wp.int64(p10) - wp.int64(p00)
        for v in range(first, last + 1):
            count = (1 << level) + 1 - v
            line = base + wp.int64(v) * rise
            error = run_error(fine, bottom + v, left + v, count, level, line, slope)
            worst = wp.max(worst, error)
    return worst


@wp.func
def above_error(
    fine: wp.array2d(dtype=int),
    bottom: int,
    left: int,
    first: int,
    last: int,
    level: int,
    p00: int,
    p01: int,
    p11: int,
) -> wp.int64:
    """Largest scaled distance in the triangle above the diagonal, over its rows first to last."""
    worst = wp.int64(0)
    if p00 != _HOLE and p01 != _HOLE and p11 != _HOLE:
        base = wp.int64(p00) << wp.int64(level)
        rise = wp.int64(p01) - wp.int64(p00)
        slope = wp.int64(p11) - wp.int64(p01)
        for v in range(first, last + 1):
            line = base + wp.int64(v) * rise
            error = run_error(fine, bottom + v, left, v + 1, level, line, slope)
            worst = wp.max(worst, error)
    return worst


@wp.kernel(enable_backward=False)
def cell_error(
    # Level-0 posts; the first is post (fine_row, fine_col):
    fine: wp.array2d(dtype=int),
    fine_row: int,
    fine_col: int,
    # The level's posts; the first is post (coarse_row, coarse_col):
    coarse: wp.array2d(dtype=int),
    coarse_row: int,
    coarse_col: int,
    level: int,
    # Out: largest distance of a cell's level-0 posts [counts], rounded up
    error_out: wp.array2d(dtype=wp.int64),
):
    r, c = wp.tid()
    # The cell's lower left post, as row and column of `fine`, which may hold only some of its rows.
    bottom = ((coarse_row + r) << level) - fine_row
    left = ((coarse_col + c) << level) - fine_col
    size = 1 << level
    first = wp.max(0, -bottom)
    last = wp.min(size, fine.shape[0] - 1 - bottom)
    p00 = coarse[r, c]
    p11 = coarse[r + 1, c + 1]
    below = below_error(fine, bottom, left, first, last, level, p00, coarse[r, c + 1], p11)
    above = above_error(fine, bottom, left, first, last, level, p00, coarse[r + 1, c], p11)
    error_out[r, c] = (wp.max(below, above) + wp.int64(size - 1)) >> wp.int64(level)
