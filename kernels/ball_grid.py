"""A hash grid of balls: bins, each at least as wide as two of the largest.

A bin is known by whole numbers, counted from the cell of one ball, so that balls far from the
origin fall into bins as those at the origin do. Balls are sorted by the bucket that their bin
hashes to; from then on they are taken in that order, where neighbours lie side by side.
"""

import warp as wp

from terrasim.kernels.body import Material

# Else a sum of products could depend on which of two balls it is computed for.
wp.set_module_options({"fuse_fp": False})

_FAR = wp.constant(wp.float64(2.0**60))
_FAR_BIN = wp.constant(wp.int64(2**60))
_LEAST_MASS = wp.constant(wp.float64(1e-100))
_MOST_MASS = wp.constant(wp.float64(1e100))
_STIR_A = wp.constant(wp.uint64(0x9E3779B97F4A7C15))
_STIR_B = wp.constant(wp.uint64(0xC2B2AE3D27D4EB4F))
_SHIFT = wp.constant(wp.uint64(29))


@wp.struct
class Bins:
    """How places turn into bins."""

    row: int
    """Row of the cell that bins are counted from."""
    col: int
    """Its column."""
    spacing: wp.float64
    """Width of a cell [m]."""
    parts: wp.float64
    """Bins along a cell, a whole number at least 1."""
    cells: wp.float64
    """Cells along a bin, a whole number at least 1; it or ``parts`` is 1."""
    height: wp.float64
    """Height of a bin [m]."""
    mask: int
    """Number of buckets, a power of two, less 1."""
    slack: wp.float64
    """Balls are near if they are apart by at most this part of the sum of their radii."""
    visits: int
    """Balls that a ball looks at in a row of three bins."""


@wp.struct
class Bin:
    """A bin."""

    x: wp.int64
    """Its number along x."""
    y: wp.int64
    """Its number along y."""
    z: wp.int64
    """Its number along z."""


@wp.struct
class Sphere:
    """A ball as its neighbours see it."""

    row: int
    """Row of its cell."""
    col: int
    """Column of its cell."""
    x: wp.float64
    """Centre from the cell's (x-, y-) post [m]."""
    y: wp.float64
    """Likewise along y."""
    z: wp.float64
    """Centre above the datum [m]."""
    radius: wp.float64
    """Radius [m]."""
    mass: wp.float64
    """Mass [kg], or the cube of the radius: only ratios matter."""
    number: int
    """Its number among the balls."""


@wp.func
def whole(value: wp.float64) -> wp.int64:
    """The whole number below, within limits; NaN is put at the lower one."""
    if value >= _FAR:
        return _FAR_BIN
    if value > -_FAR:
        return wp.int64(wp.floor(value))
    return -_FAR_BIN


@wp.func
def along(cell: int, first: int, offset: wp.float64, bins: Bins) -> wp.int64:
    """Number of the bin of a cell and an offset in it, along x or y."""
    steps = wp.int64(cell) - wp.int64(first)
    part = wp.min(wp.floor(offset * bins.parts / bins.spacing), bins.parts - wp.float64(1.0))
    # Below 2^53, so both are exact.
    return whole(wp.float64(steps) / bins.cells) * wp.int64(bins.parts) + whole(part)


@wp.func
def bin_of(cell: wp.vec2i, offset: wp.vec2d, z: wp.float64, bins: Bins) -> Bin:
    """The bin of a place."""
    out = Bin()
    out.x = along(cell[1], bins.col, offset[0], bins)
    out.y = along(cell[0], bins.row, offset[1], bins)
    out.z = whole(z / bins.height)
    return out


@wp.func
def bucket_of(of: Bin, mask: int) -> int:
    """The bucket that a bin hashes to; bins one after another along x share cache lines."""
    mixed = wp.uint64(of.y) * _STIR_A + wp.uint64(of.z) * _STIR_B
    mixed = (mixed ^ (mixed >> _SHIFT)) * _STIR_B
    mixed = (mixed ^ (mixed >> _SHIFT)) + wp.uint64(of.x)
    return int(mixed & wp.uint64(mask))


@wp.func
def between(a: Sphere, b: Sphere, spacing: wp.float64) -> wp.vec3d:
    """The way from one centre to another [m]; back it is the same with the other sign."""
    x = wp.float64(wp.int64(b.col) - wp.int64(a.col)) * spacing + (b.x - a.x)
    y = wp.float64(wp.int64(b.row) - wp.int64(a.row)) * spacing + (b.y - a.y)
    return wp.vec3d(x, y, b.z - a.z)


@wp.func
def gap(a: Sphere, b: Sphere, spacing: wp.float64) -> wp.float64:
    """Distance between two surfaces [m], below 0 where they overlap."""
    return wp.length(between(a, b, spacing)) - (a.radius + b.radius)


@wp.kernel(enable_backward=False)
def bucket_balls(
    # Bins:
    bins: Bins,
    # In:
    cell: wp.array(dtype=wp.vec2i),
    offset: wp.array(dtype=wp.vec2d),
    z: wp.array(dtype=wp.float64),
    # Out:
    bucket_out: wp.array(dtype=int),
):
    """The bucket of a ball."""
    i = wp.tid()
    bucket_out[i] = bucket_of(bin_of(cell[i], offset[i], z[i], bins), bins.mask)


@wp.kernel(enable_backward=False)
def find_starts(
    # In:
    bucket: wp.array(dtype=int),
    count: int,
    mask: int,
    # Out:
    start_out: wp.array(dtype=int),
):
    """Where buckets start: one thread writes those after the bucket before, up to its own.

    There is a thread more than balls, for the buckets after the last ball.
    """
    at = wp.tid()
    first = int(0)
    if at > 0:
        first = bucket[at - 1] + 1
    last = mask + 1
    if at < count:
        last = bucket[at]
    for b in range(first, last + 1):
        start_out[b] = at


@wp.kernel(enable_backward=False)
def gather_balls(
    # Bins:
    bins: Bins,
    # In:
    cell: wp.array(dtype=wp.vec2i),
    offset: wp.array(dtype=wp.vec2d),
    z: wp.array(dtype=wp.float64),
    material: wp.array(dtype=Material),
    mass: wp.array(dtype=wp.float64),
    velocity: wp.array(dtype=wp.vec3d),
    # In, in order:
    order: wp.array(dtype=int),
    # Out, in order:
    sphere_out: wp.array(dtype=Sphere),
    bin_out: wp.array(dtype=Bin),
    velocity_out: wp.array(dtype=wp.vec3d),
):
    """A ball in its place of the order; without masses its radius tells its mass."""
    at = wp.tid()
    i = order[at]
    out = Sphere()
    out.row = cell[i][0]
    out.col = cell[i][1]
    out.x = offset[i][0]
    out.y = offset[i][1]
    out.z = z[i]
    out.radius = material[i].radius
    out.mass = out.radius * out.radius * out.radius
    if mass.shape[0] > 0:
        out.mass = mass[i]
    out.mass = wp.clamp(out.mass, _LEAST_MASS, _MOST_MASS)
    out.number = i
    sphere_out[at] = out
    bin_out[at] = bin_of(cell[i], offset[i], z[i], bins)
    velocity_out[at] = velocity[i]
