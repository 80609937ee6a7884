"""What a stamp is at a place: its height and its weight there.

A formula knows the place by its distance from the stamp's own place alone, which is exact wherever
the terrain lies. ``terrasim.deform.shapes`` says what the four numbers of each kind are.
"""

import warp as wp

from terrasim.kernels.footprint import FOOTPRINT, footprint_at, turned
from terrasim.kernels.hash_noise import noise_at
from terrasim.kernels.swept import polyline_square

GAUSSIAN = 0
CRATER = 1
CONE = 2
PARABOLOID = 3
SPHERICAL_CAP = 4
HALF_COSINE = 5
SWEPT = 6
FLATTEN = 7
NOISE = 8
TEXTURE = 9
TEXTURE_HEAD = 6
"""Numbers before a texture's heights: half its sides [m], cosine and sine of its turn, its rows and
columns. Heights [m] follow row by row from the south, and as many weights where it has them."""
RIM_END = 3.0
"""A crater's rim ends at this many radii."""
RIM_REST = RIM_END**-3
"""What is left there of a rim that falls off as the cube of the distance."""

_GAUSSIAN = wp.constant(GAUSSIAN)
_CRATER = wp.constant(CRATER)
_CONE = wp.constant(CONE)
_PARABOLOID = wp.constant(PARABOLOID)
_SPHERICAL_CAP = wp.constant(SPHERICAL_CAP)
_SWEPT = wp.constant(SWEPT)
_FLATTEN = wp.constant(FLATTEN)
_NOISE = wp.constant(NOISE)
_FOOTPRINT = wp.constant(FOOTPRINT)
_TEXTURE_HEAD = wp.constant(TEXTURE_HEAD)
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
def swept_at(
    a: wp.float64,
    b: wp.float64,
    c: wp.float64,
    d: wp.float64,
    data: wp.array(dtype=wp.float64),
    first: int,
    dx: wp.float64,
    dy: wp.float64,
) -> wp.vec2d:
    """Height [m] and weight of a cross-section swept along a polyline."""
    end = b * b
    square = polyline_square(data, first, dx, dy, end, d != wp.float64(0.0))
    if square >= end:
        return wp.vec2d(wp.float64(0.0), wp.float64(0.0))
    weight = wp.float64(1.0)
    if c < wp.float64(0.0):
        scale = wp.float64(2.0) / (b * b + a * a)
        weight = cap_at(square, a * a * scale * scale, scale)
    else:
        left = b - wp.sqrt(square)
        if left < c:
            weight = left / c
    return wp.vec2d(a * weight, weight)


@wp.func
def noise_height(
    a: wp.float64,
    b: wp.float64,
    c: wp.float64,
    d: wp.float64,
    data: wp.array(dtype=wp.float64),
    first: int,
    dx: wp.float64,
    dy: wp.float64,
) -> wp.vec2d:
    """Height [m] and weight of noise in a footprint; ``d`` tells whether the weight is in both."""
    weight = footprint_at(data, first, dx, dy)
    if weight == wp.float64(0.0):
        return wp.vec2d(wp.float64(0.0), wp.float64(0.0))
    own = first + _FOOTPRINT
    seed = (wp.uint64(data[own + 2]) << wp.uint64(32)) | wp.uint64(data[own + 3])
    # From the anchor, so that neighbours of one seed are one noise.
    u = (data[own] + dx) * b
    v = (data[own + 1] + dy) * b
    height = a * noise_at(seed, int(data[own + 4]), c, u, v)
    if d != wp.float64(0.0):
        height = height * weight
    return wp.vec2d(height, weight)


@wp.func
def bilinear(
    data: wp.array(dtype=wp.float64), at: int, cols: int, u: wp.float64, v: wp.float64
) -> wp.float64:
    """Between four neighbours of an image, a row of ``cols``, at 0 to 1 along both."""
    low = data[at] + u * (data[at + 1] - data[at])
    high = data[at + cols] + u * (data[at + cols + 1] - data[at + cols])
    return low + v * (high - low)


@wp.func
def texture_at(
    a: wp.float64,
    b: wp.float64,
    c: wp.float64,
    d: wp.float64,
    data: wp.array(dtype=wp.float64),
    first: int,
    dx: wp.float64,
    dy: wp.float64,
) -> wp.vec2d:
    """Height [m] and weight of an image, ``a`` and ``b`` samples a metre along its x and y."""
    place = turned(dx, dy, data[first + 2], data[first + 3])
    if wp.abs(place[0]) > data[first] or wp.abs(place[1]) > data[first + 1]:
        return wp.vec2d(wp.float64(0.0), wp.float64(0.0))
    rows = int(data[first + 4])
    cols = int(data[first + 5])
    u = (place[0] + data[first]) * a
    v = (place[1] + data[first + 1]) * b
    col = wp.clamp(int(u), 0, cols - 2)
    row = wp.clamp(int(v), 0, rows - 2)
    u = u - wp.float64(col)
    v = v - wp.float64(row)
    at = first + _TEXTURE_HEAD + row * cols + col
    height = bilinear(data, at, cols, u, v)
    if d == wp.float64(0.0):
        return wp.vec2d(height, wp.float64(1.0))
    weight = wp.clamp(
        bilinear(data, at + rows * cols, cols, u, v), wp.float64(0.0), wp.float64(1.0)
    )
    if c != wp.float64(0.0):
        height = height * weight
    return wp.vec2d(height, weight)


@wp.func
def shape_at(
    kind: int,
    a: wp.float64,
    b: wp.float64,
    c: wp.float64,
    d: wp.float64,
    data: wp.array(dtype=wp.float64),
    first: int,
    count: int,  # noqa: ARG001 every kind knows its own length
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
    if kind < _SWEPT:
        return round_at(kind, dx * dx + dy * dy, a, b, c, d)
    if kind == _SWEPT:
        return swept_at(a, b, c, d, data, first, dx, dy)
    if kind == _FLATTEN:
        return wp.vec2d(a * dx + b * dy, footprint_at(data, first, dx, dy))
    if kind == _NOISE:
        return noise_height(a, b, c, d, data, first, dx, dy)
    return texture_at(a, b, c, d, data, first, dx, dy)
