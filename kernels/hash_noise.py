"""Seeded gradient noise: random planes at the nodes of a lattice, blended between them.

No table: a node's plane is a hash of its place. With gradients of at most 1 along each axis and the
fade ``6 t^5 - 15 t^4 + 10 t^3`` it lies within -1 and 1, and is twice differentiable.
"""

import warp as wp

_GOLDEN = wp.constant(wp.uint64(0x9E3779B97F4A7C15))
_MIX_A = wp.constant(wp.uint64(0xBF58476D1CE4E5B9))
_MIX_B = wp.constant(wp.uint64(0x94D049BB133111EB))
_LOW = wp.constant(wp.uint64(0xFFFFFFFF))
_HALF = wp.constant(wp.float64(2147483648.0))


@wp.func
def mixed(value: wp.uint64) -> wp.uint64:
    """The finisher of SplitMix64: every bit of the value sways every bit of the result."""
    value = (value ^ (value >> wp.uint64(30))) * _MIX_A
    value = (value ^ (value >> wp.uint64(27))) * _MIX_B
    return value ^ (value >> wp.uint64(31))


@wp.func
def plane_at(
    key: wp.uint64, node_x: wp.int64, node_y: wp.int64, dx: wp.float64, dy: wp.float64
) -> wp.float64:
    """The plane of a lattice node, 0 at the node, at a distance from it."""
    bits = mixed(mixed(key + wp.uint64(node_x) * _GOLDEN) + wp.uint64(node_y) * _GOLDEN)
    slope_x = wp.float64(bits >> wp.uint64(32)) / _HALF - wp.float64(1.0)
    slope_y = wp.float64(bits & _LOW) / _HALF - wp.float64(1.0)
    return slope_x * dx + slope_y * dy


@wp.func
def fade(t: wp.float64) -> wp.float64:
    """From 0 to 1 with first and second derivatives of 0 at both."""
    return t * t * t * (t * (t * wp.float64(6.0) - wp.float64(15.0)) + wp.float64(10.0))


@wp.func
def octave_at(key: wp.uint64, u: wp.float64, v: wp.float64) -> wp.float64:
    """One octave at a place in lattice spacings."""
    one = wp.float64(1.0)
    x, y = wp.floor(u), wp.floor(v)
    dx, dy = u - x, v - y
    i, j = wp.int64(x), wp.int64(y)
    right, up = i + wp.int64(1), j + wp.int64(1)
    t = fade(dx)
    low = (one - t) * plane_at(key, i, j, dx, dy) + t * plane_at(key, right, j, dx - one, dy)
    dy_up = dy - one
    high = (one - t) * plane_at(key, i, up, dx, dy_up) + t * plane_at(
        key, right, up, dx - one, dy_up
    )
    s = fade(dy)
    return (one - s) * low + s * high


@wp.func
def noise_at(
    seed: wp.uint64, octaves: int, gain: wp.float64, u: wp.float64, v: wp.float64
) -> wp.float64:
    """Octaves of half the wavelength and ``gain`` times the height each, -1 to 1 in all."""
    total = wp.float64(0.0)
    most = wp.float64(0.0)
    height = wp.float64(1.0)
    for k in range(octaves):
        key = mixed(seed + wp.uint64(k + 1) * _GOLDEN)
        total += height * octave_at(key, u, v)
        most += height
        height *= gain
        u *= wp.float64(2.0)
        v *= wp.float64(2.0)
    return total / most
