"""What a stamp is at a place: its height and its weight there.

A formula knows the place by its distance from the stamp's own place alone, which is exact wherever
the terrain lies. ``terrasim.deform.shapes`` says what the four numbers of each kind are.
"""

import warp as wp

GAUSSIAN = 0
CRATER = 1
CONE = 2
PARABOLOID = 3
SPHERICAL_CAP = 4
HALF_COSINE = 5
RIM_END = 3.0
"""A crater's rim ends at this many radii."""
RIM_REST = RIM_END**-3
"""What is left there of a rim that falls off as the cube of the distance."""

_GAUSSIAN = wp.constant(GAUSSIAN)
_CRATER = wp.constant(CRATER)
_CONE = wp.constant(CONE)
_PARABOLOID = wp.constant(PARABOLOID)
_SPHERICAL_CAP = wp.constant(SPHERICAL_CAP)
_RIM_END2 = wp.constant(wp.float64(RIM_END * RIM_END))
_RIM_REST = wp.constant(wp.float64(RIM_REST))
_PI = wp.constant(wp.float64(3.141592653589793))


@wp.func
def crater_at(
    square: wp.float64, a: wp.float64, b: wp.float64, c: wp.float64, d: wp.float64
) -> wp.vec2d:
    """Height [m] and weight of a crater at a squared distance."""
    if square <= a:
        return wp.vec2d(b * square - c, wp.float64(1.0))
    # Without a rim the bowl's edge is the end.
    if d == wp.float64(0.0) or square >= _RIM_END2 * a:
        return wp.vec2d(wp.float64(0.0), wp.float64(0.0))
    near = a / square
    fall = near * wp.sqrt(near) - _RIM_REST
    return wp.vec2d(d * fall, fall / (wp.float64(1.0) - _RIM_REST))


@wp.func
def cap_at(square: wp.float64, bend: wp.float64, scale: wp.float64) -> wp.float64:
    """Height of a circle's arc over its chord, 1 in the middle, at a squared distance from there.

    With ``bend`` the squared curvature and ``scale = 2 / (half^2 + height^2)``: no difference of
    large numbers, however flat the arc is.
    """
    rest = wp.max(wp.float64(0.0), wp.float64(1.0) - bend * square)
    return wp.float64(1.0) - scale * square / (wp.float64(1.0) + wp.sqrt(rest))


@wp.func
def round_at(
    kind: int, square: wp.float64, a: wp.float64, b: wp.float64, c: wp.float64, d: wp.float64
) -> wp.vec2d:
    """Height [m] and weight of a stamp that is the same in all directions."""
    if kind == _CRATER:
        return crater_at(square, a, b, c, d)
    if square >= c:
        return wp.vec2d(wp.float64(0.0), wp.float64(0.0))
    weight = wp.float64(0.0)
    if kind == _GAUSSIAN:
        weight = wp.exp(b * square)
    elif kind == _CONE:
        weight = wp.float64(1.0) - wp.sqrt(square) * b
    elif kind == _PARABOLOID:
        weight = wp.float64(1.0) - square * b
    elif kind == _SPHERICAL_CAP:
        weight = cap_at(square, b, d)
    else:
        weight = wp.float64(0.5) + wp.float64(0.5) * wp.cos(_PI * wp.sqrt(square) * b)
    return wp.vec2d(a * weight, weight)


@wp.func
def shape_at(
    kind: int,
    a: wp.float64,
    b: wp.float64,
    c: wp.float64,
    d: wp.float64,
    data: wp.array(dtype=wp.float64),
    first: int,
    count: int,
    dx: wp.float64,
    dy: wp.float64,
) -> wp.vec2d:
    """Height [m] of a stamp, and its weight from 0 to 1; 0 is outside its footprint.

    Args:
        kind: Which formula.
        a: The four numbers of the shape.
        b: The second.
        c: The third.
        d: The fourth.
        data: What else the stamps consist of, one after another.
        first: Where this stamp's own begins.
        count: How long it is.
        dx: Distance east of the stamp's place [m].
        dy: Distance north of it [m].
    """
    return round_at(kind, dx * dx + dy * dy, a, b, c, d)
