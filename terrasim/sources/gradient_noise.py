"""One octave of seeded noise on a lattice of posts: the same to the bit wherever it is read.

At each lattice node stand a random value and a random gradient. Between the nodes their planes
are blended by the fade ``s(t) = 6 t^5 - 15 t^4 + 10 t^3``, along x and then along y, so the noise
is twice differentiable, with no seams at the lattice. The lattice spacing is a power of two
posts: posts of coarse levels are then nodes, which cost one hash.

A pinned octave has no values: it is 0 at every node.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from terrasim.grid import Indices
from terrasim.sources.error_bound import curvature_bound, slope_bound

Floats = npt.NDArray[np.float64]

_VALUE = 0.5
"""Largest node value, where a gradient's components are at most 1 a lattice spacing."""
_STRIP = 64
"""Rows blended at once, so that the temporaries stay in a core's cache."""


@dataclass(frozen=True)
class Octave:
    """Noise of one wavelength."""

    key: int
    """Seed of this octave, any integer from 0 to 2^64 - 1."""
    shift: int
    """The lattice spacing is ``2^shift`` posts."""
    amplitude: float
    """Largest magnitude of the noise [counts]."""
    pinned: bool
    """Whether the noise is 0 at the nodes."""


def octaves(
    seed: int, shift: int, count: int, *, amplitude: float, ratio: float, pinned: bool
) -> tuple[Octave, ...]:
    """Octaves that each halve the wavelength of the one before.

    Args:
        seed: Seed of the noise.
        shift: The first lattice spacing is ``2^shift`` posts.
        count: Number of octaves; those of a wavelength of less than two posts are left out where
            they are pinned, since every post is a node there.
        amplitude: Amplitude of the first [counts].
        ratio: Amplitude of each relative to the one before.
        pinned: Whether they are 0 at the nodes of their lattices.
    """
    keys = _mixed(np.arange(1, count + 1, dtype=np.uint64) * _GOLDEN + np.uint64(seed))
    return tuple(
        Octave(int(key), shift - i, amplitude * ratio**i, pinned) for i, key in enumerate(keys)
    )


def add_octave(heights: Floats, octave: Octave, rows: Indices, cols: Indices) -> None:
    """Add an octave to heights [counts] at the outer product of level-0 rows and columns."""
    mask = (1 << octave.shift) - 1
    row_rest, col_rest = rows & mask, cols & mask
    if not row_rest.any() and not col_rest.any():
        if not octave.pinned:
            nodes = _hashed(octave, rows >> octave.shift, cols >> octave.shift)
            heights += _value(nodes) * _scale(octave)
        return
    width = float(mask + 1)
    row_nodes, row_at = _lattice(rows >> octave.shift)
    col_nodes, col_at = _lattice(cols >> octave.shift)
    level, rise = _blend_along_x(octave, row_nodes, col_nodes, col_at, col_rest / width)
    _blend_along_y(heights, level, rise, row_at, row_rest / width)


def octave_error(octave: Octave, leg: int, *, smooth: bool) -> float:
    """Bound [counts] of an octave's distance from its interpolant over triangles of legs ``leg``.

    With values of at most ``V``, gradients of at most 1 and lattice spacing 1 the noise is at most
    ``V + 1``; its first derivatives are at most ``2 V max s' + max(...)`` and so on, each the
    largest sum of the magnitudes of what multiplies values and gradients::

        |n_x|  <= 3.75 V + 1.3472 + 1.875          |n_xx| <= 11.5471 V + 7.5 + 5.7736
        |n_xy| <= 14.0625 V + 2 * 5.0521

    The bound is the smallest of the range, :func:`slope_bound` and :func:`curvature_bound`.

    Args:
        octave: The octave.
        leg: Legs of the triangles [posts], a power of two; they stand on multiples of it.
        smooth: Whether no edge of the terrain runs through the inside of a triangle.
    """
    value = 0.0 if octave.pinned else _VALUE
    top = value + 1.0
    width = float(1 << octave.shift)
    slope = 3.75 * value + 3.2222
    distance = min(2.0 * top, slope_bound(leg / width, slope, slope))
    if smooth:
        bend, twist = 11.5471 * value + 13.2736, 14.0625 * value + 10.1042
        distance = min(distance, curvature_bound(leg / width, bend, twist, bend))
        if leg >= width:
            # The corners are nodes.
            distance = min(distance, value + top)
    return distance * octave.amplitude / top


def _scale(octave: Octave) -> float:
    """What makes the amplitude of noise with gradients of at most 1."""
    return octave.amplitude / (1.0 if octave.pinned else 1.0 + _VALUE)


def _lattice(cells: Indices) -> tuple[Indices, Indices]:
    """The nodes on both sides of some cells, ascending, and where each cell's lower one is."""
    nodes = np.unique(np.concatenate((cells, cells + 1)))
    return nodes, np.searchsorted(nodes, cells)


def _fade(t: Floats) -> Floats:
    return t * t * t * (t * (t * 6.0 - 15.0) + 10.0)


def _blend_along_x(
    octave: Octave, row_nodes: Indices, col_nodes: Indices, at: Indices, t: Floats
) -> tuple[Floats, Floats]:
    """Height and rise along y on the lattice rows, at every column; shape (nodes, columns)."""
    nodes = _hashed(octave, row_nodes, col_nodes)
    scale = _scale(octave)
    gradient_x = _field(nodes, 22) * scale
    gradient_y = _field(nodes, 1) * scale
    s = _fade(t)
    left = gradient_x[:, at] * t
    right = gradient_x[:, at + 1] * (t - 1.0)
    if not octave.pinned:
        value = _value(nodes) * scale
        left += value[:, at]
        right += value[:, at + 1]
    right -= left
    right *= s
    left += right
    rise = gradient_y[:, at]
    rise += s * (gradient_y[:, at + 1] - rise)
    return left, rise


def _blend_along_y(heights: Floats, level: Floats, rise: Floats, at: Indices, t: Floats) -> None:
    s = _fade(t)[:, None]
    up, down = t[:, None], t[:, None] - 1.0
    for start in range(0, len(at), _STRIP):
        part = slice(start, start + _STRIP)
        low = at[part]
        below = rise[low]
        below *= up[part]
        below += level[low]
        above = rise[low + 1]
        above *= down[part]
        above += level[low + 1]
        above -= below
        above *= s[part]
        below += above
        heights[part] += below


_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_STRIDE = np.uint64(0xD6E8FEB86659FD93)


def _hashed(octave: Octave, rows: Indices, cols: Indices) -> npt.NDArray[np.uint64]:
    """64 random bits for every node of a lattice."""
    keys = _mixed(rows.astype(np.uint64) * _GOLDEN + np.uint64(octave.key))
    return _mixed(keys[:, None] + (cols.astype(np.uint64) * _STRIDE)[None, :])


def _mixed(bits: npt.NDArray[np.uint64]) -> npt.NDArray[np.uint64]:
    """The finaliser of splitmix64 (Steele, Lea and Flood 2014)."""
    bits = bits ^ (bits >> np.uint64(30))
    bits *= np.uint64(0xBF58476D1CE4E5B9)
    bits ^= bits >> np.uint64(27)
    bits *= np.uint64(0x94D049BB133111EB)
    bits ^= bits >> np.uint64(31)
    return bits


def _field(bits: npt.NDArray[np.uint64], start: int) -> Floats:
    """21 of the bits as a number from -1 to 1, without 0."""
    field = (bits >> np.uint64(start)) & np.uint64((1 << 21) - 1)
    return field.view(np.int64).astype(np.float64) * 2.0**-20 - (1.0 - 2.0**-21)


def _value(bits: npt.NDArray[np.uint64]) -> Floats:
    return _field(bits, 43) * _VALUE
