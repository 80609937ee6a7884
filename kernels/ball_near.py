"""Which balls are near which.

A ball lists those near it, nearest surfaces first and, where they are as near, by number. It looks
at a limited number in each row of three bins and lists a limited number: a ball for which that was
too few is crowded.
"""

import warp as wp

from terrasim.kernels.ball_grid import Bin, Bins, Sphere, bucket_of, gap

# Else a sum of products could depend on which of two balls it is computed for.
wp.set_module_options({"fuse_fp": False})

_LONG_NONE = wp.constant(wp.int64(0))
_LONG_ONE = wp.constant(wp.int64(1))
_OWN_LINE = wp.constant(4)


@wp.func
def in_row(it: Bin, first: Bin, wide: int) -> bool:
    """Whether a bin is among so many along x from the first."""
    way = it.x - first.x
    return it.y == first.y and it.z == first.z and way >= _LONG_NONE and way < wp.int64(wide)


@wp.func
def line_beside(of: Bin, line: int) -> Bin:
    """The first bin of one of the nine rows of three around a bin; row 4 holds it."""
    layer = line / 3
    out = Bin()
    out.x = of.x - _LONG_ONE
    out.y = of.y + wp.int64(line - layer * 3) - _LONG_ONE
    out.z = of.z + wp.int64(layer) - _LONG_ONE
    return out


@wp.func
def is_before(
    sphere: wp.array(dtype=Sphere),
    me: Sphere,
    a: int,
    gap_a: wp.float64,
    b: int,
    spacing: wp.float64,
) -> bool:
    """Whether a ball stands before another in a list."""
    gap_b = gap(me, sphere[b], spacing)
    return gap_a < gap_b or (gap_a == gap_b and sphere[a].number < sphere[b].number)


@wp.func
def put(
    sphere: wp.array(dtype=Sphere),
    near: wp.array2d(dtype=int),
    row: int,
    listed: int,
    other: int,
    spacing: wp.float64,
) -> int:
    """Put a ball where it belongs in a sorted list; how many are listed then.

    The last one of a full list drops out.
    """
    me = sphere[row]
    away = gap(me, sphere[other], spacing)
    most = near.shape[1]
    if listed == most and not is_before(sphere, me, other, away, near[row, most - 1], spacing):
        return listed
    low = int(0)
    high = int(wp.min(listed, most - 1))
    end = high
    while low < high:
        middle = (low + high) / 2
        if is_before(sphere, me, other, away, near[row, middle], spacing):
            high = middle
        else:
            low = middle + 1
    for k in range(end - low):
        near[row, end - k] = near[row, end - k - 1]
    near[row, low] = other
    return end + 1


@wp.kernel(enable_backward=False)
def list_neighbours(
    # Bins:
    bins: Bins,
    start: wp.array(dtype=int),
    # In, of all, in order:
    sphere: wp.array(dtype=Sphere),
    where: wp.array(dtype=Bin),
    # Out, of all, in order:
    near_out: wp.array2d(dtype=int),
    listed_out: wp.array(dtype=int),
    crowded_out: wp.array(dtype=wp.uint8),
    # In:
    at: wp.array(dtype=int),
):
    """The balls near one, from its own bin and those around it."""
    self = at[wp.tid()]
    me = sphere[self]
    listed = int(0)
    crowded = int(0)
    for line in range(9):
        row = line_beside(where[self], line)
        bucket = bucket_of(row, bins.mask)
        # Three buckets side by side, unless they go on at the first.
        wide = wp.where(bucket + 2 <= bins.mask, 3, 1)
        for piece in range(4 - wide):
            first = start[(bucket + piece) & bins.mask]
            last = start[((bucket + piece) & bins.mask) + wide]
            if last - first > bins.visits:
                crowded = int(1)
                # In its own row those around it in the order, so that all have somebody to meet.
                if line == _OWN_LINE:
                    first = wp.clamp(self - bins.visits / 2, first, last - bins.visits)
                last = first + bins.visits
            for other in range(first, last):
                # Other bins may hash to the same buckets.
                if other != self and in_row(where[other], row, wide):
                    widest = (me.radius + sphere[other].radius) * bins.slack
                    if gap(me, sphere[other], bins.spacing) <= widest:
                        if listed == near_out.shape[1]:
                            crowded = int(1)
                        listed = put(sphere, near_out, self, listed, other, bins.spacing)
            row.x += _LONG_ONE
    listed_out[self] = listed
    crowded_out[self] = wp.uint8(crowded)


@wp.kernel(enable_backward=False)
def keep_mutual(
    # In, in order, of all:
    near: wp.array2d(dtype=int),
    listed: wp.array(dtype=int),
    crowded: wp.array(dtype=wp.uint8),
    # Out, of all, in order:
    near_out: wp.array2d(dtype=int),
    listed_out: wp.array(dtype=int),
    # In:
    at: wp.array(dtype=int),
):
    """Leave out of a list those that do not list the ball, so that every push has its answer."""
    self = at[wp.tid()]
    kept = int(0)
    for k in range(listed[self]):
        other = near[self, k]
        mutual = wp.where(crowded[other] == wp.uint8(0), 1, 0)
        if mutual == 0:
            for j in range(listed[other]):
                if near[other, j] == self:
                    mutual = int(1)
        if mutual == 1:
            near_out[self, kept] = other
            kept += 1
    listed_out[self] = kept
