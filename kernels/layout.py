"""Height queries over other block sizes and layouts, to measure what the pool should be.

Only ``terrasim bench layout`` runs these. Each variant is a module of its own.
"""

import warp as wp


def layout_kernel(shift: int, tiled: bool):
    """A query over blocks of ``1 << shift`` posts a side, row-major or in 8 x 8 micro-tiles."""
    mask = (1 << shift) - 1

    @wp.func
    def place(layer: int, row: int, col: int) -> int:
        r = row & wp.static(mask)
        c = col & wp.static(mask)
        if wp.static(tiled):
            tile = ((r >> 3) << wp.static(shift - 3)) + (c >> 3)
            inside = (tile << 6) + ((r & 7) << 3) + (c & 7)
            return ((layer << wp.static(2 * shift)) + inside) & 0x7FFFFFFF
        return ((layer << wp.static(2 * shift)) + (r << wp.static(shift)) + c) & 0x7FFFFFFF

    @wp.kernel(enable_backward=False, module="unique")
    def query(
        # Terrain:
        pool: wp.array(dtype=int),
        table: wp.array(dtype=int),
        blocks: int,
        # In:
        points: wp.array(dtype=wp.vec2d),
        # Out:
        height_out: wp.array(dtype=wp.float64),
    ):
        i = wp.tid() & 0x7FFFFFFF
        col = int(wp.floor(points[i][0]))
        row = int(wp.floor(points[i][1]))
        u = points[i][0] - wp.float64(col)
        v = points[i][1] - wp.float64(row)
        right = wp.where(u >= v, 1, 0)
        near = table[((row >> wp.static(shift)) * blocks + (col >> wp.static(shift))) & 0x7FFFFFFF]
        mid = near
        far = near
        mid_row = row + 1 - right
        mid_col = col + right
        # A cell at the block's edge reaches into up to three others.
        if (row & wp.static(mask)) == wp.static(mask) or (col & wp.static(mask)) == wp.static(mask):
            mid = table[(mid_row >> wp.static(shift)) * blocks + (mid_col >> wp.static(shift))]
            far = table[((row + 1) >> wp.static(shift)) * blocks + ((col + 1) >> wp.static(shift))]
        h0 = pool[place(near, row, col)]
        h1 = pool[place(mid, mid_row, mid_col)]
        h2 = pool[place(far, row + 1, col + 1)]
        first = wp.float64(wp.int64(h1) - wp.int64(h0))
        second = wp.float64(wp.int64(h2) - wp.int64(h1))
        larger = wp.where(u >= v, u, v)
        smaller = wp.where(u >= v, v, u)
        height_out[i] = (wp.float64(h0) + (first * larger + second * smaller)) * wp.float64(1.0e-5)

    return query


VARIANTS = {
    (shift, tiled): layout_kernel(shift, tiled) for shift in (7, 8, 10) for tiled in (False, True)
}
"""Kernel of each block size (as a shift) and layout."""
