"""Where a stamp stands: a disc or a turned rectangle, fading out around it."""

import warp as wp

FOOTPRINT = 6
"""Numbers of a footprint: half its sides along its own x and y [m], the radius its corners are
rounded by beyond them, the width over which it fades, and cosine and sine of its turn."""


@wp.func
def turned(dx: wp.float64, dy: wp.float64, cosine: wp.float64, sine: wp.float64) -> wp.vec2d:
    """A distance along the axes of what is turned counter-clockwise."""
    return wp.vec2d(cosine * dx + sine * dy, cosine * dy - sine * dx)


@wp.func
def footprint_at(
    data: wp.array(dtype=wp.float64), first: int, dx: wp.float64, dy: wp.float64
) -> wp.float64:
    """1 within a footprint, falling smoothly to 0 over the width of its fade."""
    zero = wp.float64(0.0)
    place = turned(dx, dy, data[first + 4], data[first + 5])
    beyond_x = wp.max(zero, wp.abs(place[0]) - data[first])
    beyond_y = wp.max(zero, wp.abs(place[1]) - data[first + 1])
    beyond = wp.sqrt(beyond_x * beyond_x + beyond_y * beyond_y) - data[first + 2]
    if beyond <= zero:
        return wp.float64(1.0)
    fade = data[first + 3]
    if beyond >= fade:
        return zero
    t = wp.float64(1.0) - beyond / fade
    return t * t * (wp.float64(3.0) - wp.float64(2.0) * t)
