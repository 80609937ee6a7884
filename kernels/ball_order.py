"""Balls in an order of their own: by block, and along Morton's curve within one."""

import warp as wp

_SHIFT = wp.constant(8)
_LAST = wp.constant(255)


@wp.func
def spread(bits: int) -> int:
    """The bits of a number up to 255, each with a zero before it."""
    out = (bits | (bits << 4)) & 0x0F0F
    out = (out | (out << 2)) & 0x3333
    return (out | (out << 1)) & 0x5555


@wp.kernel(enable_backward=False)
def ball_keys(
    # In:
    cell: wp.array(dtype=wp.vec2i),
    number: wp.array(dtype=int),
    # Out:
    key: wp.array(dtype=wp.int64),
):
    """What a ball is sorted by: its block's row and column, then its cell's place in the block."""
    i = wp.tid()
    at = cell[number[i]]
    within = (spread(at[0] & _LAST) << 1) | spread(at[1] & _LAST)
    # Blocks have numbers of 24 bits. The column's begin at 0, so that it leaves the row's alone.
    row = wp.int64(at[0] >> _SHIFT)
    col = wp.int64((at[1] >> _SHIFT) + 0x800000)
    key[i] = (row << wp.int64(40)) | (col << wp.int64(16)) | wp.int64(within)


@wp.kernel(enable_backward=False)
def take_words(
    # In:
    whole: wp.array2d(dtype=int),
    number: wp.array(dtype=int),
    # Out:
    part: wp.array2d(dtype=int),
):
    """Copy some balls' words out of an array of all."""
    i = wp.tid()
    source = number[i]
    for j in range(whole.shape[1]):
        part[i, j] = whole[source, j]


@wp.kernel(enable_backward=False)
def put_words(
    # Out:
    whole: wp.array2d(dtype=int),
    # In:
    number: wp.array(dtype=int),
    part: wp.array2d(dtype=int),
):
    """Copy them back. No two have one number."""
    i = wp.tid()
    target = number[i]
    for j in range(whole.shape[1]):
        whole[target, j] = part[i, j]
