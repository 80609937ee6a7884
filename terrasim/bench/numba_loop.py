"""The work of a height query as a serial numba loop: what a good CPU programmer would write.

It reads the same pool through the same tables, with the same rules at block borders, holes, absent
blocks and the terrain's edge, and gives the same heights and states.
"""

from __future__ import annotations

from typing import Any


def post_reader() -> tuple[Any, Any]:
    """Compile the look-ups of a block's layer and of a post."""
    from numba import njit

    @njit
    def layer_of(table, block_row, block_col):  # type: ignore[no-untyped-def]
        row = (block_row >> 6) - table[2]
        col = (block_col >> 6) - table[3]
        page = table[table[0] + row * table[1] + col]
        return table[page + ((block_row & 63) << 6) + (block_col & 63)]

    @njit
    def post(pool, table, row, col):  # type: ignore[no-untyped-def]
        layer = layer_of(table, row >> 8, col >> 8)
        if layer < 0:
            return 0, -1
        return pool[(layer << 16) + ((row & 255) << 8) + (col & 255)], layer

    return layer_of, post


def heights_loop() -> Any:
    """Compile the loop.

    Returns:
        ``loop(pool, table, place, points, height_out, state_out)``.
    """
    from numba import njit

    layer_of, post = post_reader()

    @njit
    def loop(pool, table, place, points, height_out, state_out):  # type: ignore[no-untyped-def]
        x0, y0, z0, spacing, west, east, south, north = place
        for i in range(points.shape[0]):
            x = (points[i, 0] - x0) / spacing
            y = (points[i, 1] - y0) / spacing
            u = min(max(x, west), east)
            v = min(max(y, south), north)
            state = 1 if x != u or y != v else 0
            col = min(int(u // 1.0), int(east) - 1)
            row = min(int(v // 1.0), int(north) - 1)
            u -= col
            v -= row
            right = 1 if u >= v else 0
            layer = layer_of(table, row >> 8, col >> 8)
            if layer < 0 or (row & 255) == 255 or (col & 255) == 255:
                near, a = post(pool, table, row, col)
                mid, b = post(pool, table, row + 1 - right, col + right)
                far, c = post(pool, table, row + 1, col + 1)
                if a < 0 or b < 0 or c < 0:
                    state_out[i] = 4
                    continue
            else:
                place_in_pool = (layer << 16) + ((row & 255) << 8) + (col & 255)
                near = pool[place_in_pool]
                mid = pool[place_in_pool + (1 if right else 256)]
                far = pool[place_in_pool + 257]
            if near == -2147483648 or mid == -2147483648 or far == -2147483648:
                state_out[i] = 2 + state
                continue
            first = float(mid - near)
            second = float(far - mid)
            total = near + (first * max(u, v) + second * min(u, v))
            height_out[i] = z0 + total * 1e-5
            state_out[i] = state

    return loop
