"""Slumping: ground steeper than its angle of repose moves downhill, post to post, until it is not.

Heights and flows are whole numbers of parts of a count, in floats that hold them exactly: sums do
not depend on their order. All else is a formula that turns with the grid: a cell's slope takes its
four edges alike, and terms that change places when the ground is turned or mirrored are added in
pairs. Then so are the bits; contraction to fused operations, which would break a pair, is off.

The slope of a cell is the root of the mean square over its surface's two triangles, which is the
same for either diagonal. With ``E`` half the square of a slope's excess over the angle of repose,
summed over all cells, a flow is a step down the gradient of ``E``: along an edge, in proportion to
the edge's drop and to the excess of the cells beside it. So it goes downhill, alike to all sides,
and stops where the excess does. Sweeps of one iteration gain pace, as in Nesterov's accelerated
descent, but no flow may exceed what the present excess would bring up to at a steady pace: momentum
that ran on would leave slopes too shallow, which nothing sets right again.
"""

import warp as wp

wp.set_module_options({"fuse_fp": False})

PLOT_SHIFT = wp.constant(5)
PLOT = 1 << PLOT_SHIFT
"""Posts along a side of a plot: the ground wakes and sleeps by plots."""
SWEEPS = 8
"""Sweeps of an iteration. What moves in it depends on what lies this many posts away."""
REACH = wp.constant(SWEEPS + 1)
"""Posts around awake plots between which an iteration may move something; less than half a plot,
so that what is not known beyond the next plots does not reach there within an iteration."""

_MASK = wp.constant(PLOT - 1)
_IN_PLOT = wp.constant(2 * PLOT_SHIFT)
_NO_SIGN = wp.constant(0x7FFFFFFF)
_HALF = wp.constant(wp.float64(0.5))
_ONE = wp.constant(wp.float64(1.0))
_NONE = wp.constant(wp.float64(0.0))
_MOST = wp.constant(wp.float64(0.25))
_NO_FLOW = wp.constant(wp.float32(0.0))
_AT_REST = wp.constant(wp.float32(-1.0))


@wp.struct
class Field:
    """Posts in rows, of which a launch works on some plots, run by run.

    Runs are numbered through their plot, plot after plot.
    """

    width: int
    """Posts in a row."""
    run: int
    """Posts of a run, side by side, that one thread works on; divides ``PLOT``."""
    parts: wp.float64
    """Parts of a count that flows are counted in."""
    repose: wp.float64
    """Difference of neighbouring posts down to which a cell slumps that has begun to [parts]."""
    start: wp.float64
    """Square of the difference over which a cell begins to slump [parts squared]."""


@wp.struct
class Pace:
    """How the flows of a sweep follow from the excess and the flows before."""

    keep: wp.float64
    """Part of the flow before that goes on."""
    gain: wp.float64
    """Part of drop and excess that is added."""
    limit: wp.float64
    """Part of drop and excess that a flow may be."""


@wp.struct
class Tally:
    """What happened to a run of posts in an iteration."""

    moved: wp.int64
    """Sum of what flowed along the posts' edges to the east and north [counts]."""
    removed: wp.int64
    """Sum of the falls [counts]."""
    added: wp.int64
    """Sum of the rises [counts]."""
    posts: int
    """Posts whose height changed."""
    awake: int
    """1 if anything flowed to or from a post."""


@wp.func
def place_of(field: Field, plot: wp.array(dtype=int), item: int) -> int:
    """The first post of a run."""
    post = item * field.run
    start = plot[(post >> _IN_PLOT) & _NO_SIGN]
    return start + ((post >> PLOT_SHIFT) & _MASK) * field.width + (post & _MASK)


@wp.func
def present(value: wp.float64) -> bool:
    """Whether a height, or a difference of two, is that of ground: holes are not numbers."""
    return value == value  # noqa: PLR0124


@wp.func
def mean_square(a: wp.float64, b: wp.float64) -> wp.float64:
    """Of the differences along two opposite edges, or of the one with ground at both its ends."""
    x = a * a
    y = b * b
    both = _HALF * (wp.where(present(x), x, y) + wp.where(present(y), y, x))
    return wp.where(present(both), both, _NONE)


@wp.kernel(enable_backward=False)
def begin(
    # Ground:
    field: Field,
    plot: wp.array(dtype=int),
    from_width: int,
    from_plot: wp.array(dtype=int),
    count: wp.array(dtype=wp.float64),
    # Out:
    height_out: wp.array(dtype=wp.float64),
    east_out: wp.array(dtype=wp.float32),
    north_out: wp.array(dtype=wp.float32),
    east_sum_out: wp.array(dtype=wp.float32),
    north_sum_out: wp.array(dtype=wp.float32),
    excess_out: wp.array(dtype=wp.float32),
    # In:
    item: wp.array(dtype=int),
):
    """Begin an iteration: heights in parts of a count, nothing flows, all cells are at rest."""
    number = item[wp.tid()]
    first = place_of(field, plot, number)
    post = number * field.run
    row = (post >> PLOT_SHIFT) & _MASK
    source = from_plot[(post >> _IN_PLOT) & _NO_SIGN] + row * from_width + (post & _MASK)
    parts = field.parts + _NONE
    run = field.run + 0
    i = int(0)
    while i < run:
        p = (first + i) & _NO_SIGN
        height_out[p] = count[(source + i) & _NO_SIGN] * parts
        east_out[p] = _NO_FLOW
        north_out[p] = _NO_FLOW
        east_sum_out[p] = _NO_FLOW
        north_sum_out[p] = _NO_FLOW
        excess_out[p] = _AT_REST
        i += 1


@wp.kernel(enable_backward=False)
def find_excess(
    # Ground:
    field: Field,
    plot: wp.array(dtype=int),
    height: wp.array(dtype=wp.float64),
    # In and out:
    excess: wp.array(dtype=wp.float32),
    # In:
    item: wp.array(dtype=int),
):
    """Which part of each cell's slope is too much; -1 while the cell has not begun to slump.

    A cell's excess stands at its post in the south-west.
    """
    first = place_of(field, plot, item[wp.tid()])
    # Copies and masks let the compiler do several posts at a time, here and below.
    width = field.width + 0
    run = field.run + 0
    repose = field.repose + _NONE
    start = field.start + _NONE
    i = int(0)
    while i < run:
        p = (first + i) & _NO_SIGN
        near = height[p]
        east = height[(first + i + 1) & _NO_SIGN]
        north = height[(first + i + width) & _NO_SIGN]
        far = height[(first + i + width + 1) & _NO_SIGN]
        square = mean_square(east - near, far - north) + mean_square(north - near, far - east)
        part = wp.float32(_ONE - repose / wp.sqrt(square))
        over = wp.where(square > repose * repose, part, _NO_FLOW)
        limit = wp.where(excess[p] < _NO_FLOW, start, -_ONE)
        excess[p] = wp.where(square > limit, over, _AT_REST)
        i += 1


@wp.func
def flow(
    before: wp.float32, drop: wp.float64, left: wp.float32, right: wp.float32, pace: Pace
) -> wp.float32:
    """What flows down an edge, from what flowed before and the excess of the cells beside it.

    At most a quarter of the drop: four neighbours cannot take more than there is.
    """
    a = wp.where(left > _NO_FLOW, left, _NO_FLOW)
    b = wp.where(right > _NO_FLOW, right, _NO_FLOW)
    over = wp.float64(a + b)
    share = pace.limit * over
    most = drop * wp.where(share < _MOST, share, _MOST)
    wanted = pace.keep * wp.float64(before) + pace.gain * (drop * over)
    low = wp.where(most < _NONE, most, _NONE)
    high = wp.where(most > _NONE, most, _NONE)
    bounded = wp.where(wanted < low, low, wp.where(wanted > high, high, wanted))
    return wp.float32(wp.rint(wp.where(present(drop), bounded, _NONE)))


@wp.kernel(enable_backward=False)
def find_flows(
    # Ground:
    field: Field,
    plot: wp.array(dtype=int),
    height: wp.array(dtype=wp.float64),
    excess: wp.array(dtype=wp.float32),
    pace: Pace,
    # In and out:
    east: wp.array(dtype=wp.float32),
    north: wp.array(dtype=wp.float32),
    east_sum: wp.array(dtype=wp.float32),
    north_sum: wp.array(dtype=wp.float32),
    # In:
    item: wp.array(dtype=int),
):
    """What flows from each post to the east and to the north, and has in this iteration."""
    first = place_of(field, plot, item[wp.tid()])
    width = field.width + 0
    run = field.run + 0
    i = int(0)
    while i < run:
        p = (first + i) & _NO_SIGN
        drop = height[p] - height[(first + i + 1) & _NO_SIGN]
        to_east = flow(east[p], drop, excess[(first + i - width) & _NO_SIGN], excess[p], pace)
        east[p] = to_east
        east_sum[p] = east_sum[p] + to_east
        i += 1
    i = int(0)
    while i < run:
        p = (first + i) & _NO_SIGN
        drop = height[p] - height[(first + i + width) & _NO_SIGN]
        to_north = flow(north[p], drop, excess[(first + i - 1) & _NO_SIGN], excess[p], pace)
        north[p] = to_north
        north_sum[p] = north_sum[p] + to_north
        i += 1


@wp.kernel(enable_backward=False)
def move(
    # Ground:
    field: Field,
    plot: wp.array(dtype=int),
    east: wp.array(dtype=wp.float32),
    north: wp.array(dtype=wp.float32),
    # In and out:
    height: wp.array(dtype=wp.float64),
    # In:
    item: wp.array(dtype=int),
):
    """Raise each post by what flows to it, lower it by what flows from it."""
    first = place_of(field, plot, item[wp.tid()])
    width = field.width + 0
    run = field.run + 0
    i = int(0)
    while i < run:
        p = (first + i) & _NO_SIGN
        west = wp.float64(east[(first + i - 1) & _NO_SIGN])
        south = wp.float64(north[(first + i - width) & _NO_SIGN])
        height[p] = height[p] + ((west - wp.float64(east[p])) + (south - wp.float64(north[p])))
        i += 1


@wp.func
def is_near(awake: wp.array2d(dtype=int), amid: int, row: int, col: int) -> bool:
    """Whether a post lies within the reach of an awake plot; rows and columns from the map's."""
    if amid == 1:
        return True
    row0 = (row - REACH) >> PLOT_SHIFT
    row1 = (row + REACH) >> PLOT_SHIFT
    col0 = (col - REACH) >> PLOT_SHIFT
    col1 = (col + REACH) >> PLOT_SHIFT
    return (awake[row0, col0] | awake[row0, col1] | awake[row1, col0] | awake[row1, col1]) != 0


@wp.func
def whole(total: wp.float32, part: wp.float64, counts: bool) -> wp.float64:
    """What flowed along an edge, in whole counts; nothing where it does not count."""
    return wp.where(counts, wp.rint(wp.float64(total) * part), _NONE)


@wp.kernel(enable_backward=False)
def finish(
    # Ground:
    field: Field,
    plot: wp.array(dtype=int),
    east_sum: wp.array(dtype=wp.float32),
    north_sum: wp.array(dtype=wp.float32),
    awake: wp.array2d(dtype=int),
    at: wp.array(dtype=wp.vec2i),
    to_width: int,
    to_plot: wp.array(dtype=int),
    # Out:
    gain_out: wp.array(dtype=wp.float64),
    # In:
    item: wp.array(dtype=int),
    # Out, a run each:
    tally_out: wp.array(dtype=Tally),
):
    """End an iteration: what flowed becomes whole counts along each edge, and posts change by it.

    ``at`` is the first post of each plot in the map of awake plots.
    """
    i = wp.tid()
    first = place_of(field, plot, item[i])
    post = item[i] * field.run
    number = (post >> _IN_PLOT) & _NO_SIGN
    row = at[number][0] + ((post >> PLOT_SHIFT) & _MASK)
    col = at[number][1] + (post & _MASK)
    target = to_plot[number] + ((post >> PLOT_SHIFT) & _MASK) * to_width + (post & _MASK)
    # Every post of an awake plot is near it, and so is the next one.
    amid = awake[row >> PLOT_SHIFT, col >> PLOT_SHIFT]
    part = _ONE / field.parts
    tally = Tally()
    for k in range(field.run):
        p = first + k
        here = is_near(awake, amid, row, col + k)
        east = whole(east_sum[p], part, here and is_near(awake, amid, row, col + k + 1))
        west = whole(east_sum[p - 1], part, here and is_near(awake, amid, row, col + k - 1))
        north = whole(north_sum[p], part, here and is_near(awake, amid, row + 1, col + k))
        below = p - field.width
        south = whole(north_sum[below], part, here and is_near(awake, amid, row - 1, col + k))
        gain = wp.int64((west - east) + (south - north))
        gain_out[target + k] = wp.float64(gain)
        tally.moved += wp.int64(wp.abs(east) + wp.abs(north))
        tally.added += wp.max(gain, wp.int64(0))
        tally.removed += wp.max(-gain, wp.int64(0))
        tally.posts += wp.where(gain != wp.int64(0), 1, 0)
        any_flow = wp.abs(east) + wp.abs(west) + wp.abs(north) + wp.abs(south)
        tally.awake = wp.where(any_flow > _NONE, 1, tally.awake)
    tally_out[i] = tally


@wp.kernel(enable_backward=False)
def settle(
    # Ground:
    field: Field,
    plot: wp.array(dtype=int),
    gain: wp.array(dtype=wp.float64),
    # In and out:
    count: wp.array(dtype=wp.float64),
    # In:
    item: wp.array(dtype=int),
):
    """Change posts by what an iteration moved; holes stay holes."""
    first = place_of(field, plot, item[wp.tid()])
    run = field.run + 0
    i = int(0)
    while i < run:
        p = (first + i) & _NO_SIGN
        count[p] = count[p] + gain[p]
        i += 1
