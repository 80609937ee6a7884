"""Small writes into device arrays on the stream of the step."""

import warp as wp


@wp.kernel(enable_backward=False)
def scatter(
    # In:
    index: wp.array(dtype=int),
    value: wp.array(dtype=int),
    # Out:
    table_out: wp.array(dtype=int),
):
    i = wp.tid()
    table_out[index[i]] = value[i]
