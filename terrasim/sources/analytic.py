"""Terrains of one formula: flat, plane, sine, cone.

Offsets are whole numbers of posts from a given post before they become metres, so a terrain far
from the origin is the same to the bit as one at it.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from terrasim.counts import COUNTS_PER_M, MAX_COUNT, Counts
from terrasim.errors import InputError
from terrasim.grid import Block, Grid, Indices
from terrasim.kernels.addressing import BLOCK
from terrasim.sources.error_bound import curvature_bound, in_counts, slope_bound, straddles_edge
from terrasim.sources.height_range import check_finite, check_reach, count_of
from terrasim.sources.source import BlockData, read_block

_FRACTION_BITS = 32
"""A plane's slope is a whole number of 2^-32 counts a post: 1/8 count over 2^30 posts."""


@dataclass(frozen=True)
class Flat:
    """Level ground."""

    grid: Grid
    """Placement of the posts."""
    height: float = 0.0
    """World z of the ground [m], rounded to a count."""

    def __post_init__(self) -> None:
        """Refuse a height that cannot be counted."""
        count_of("height", self.height, self.grid)

    @property
    def synthetic(self) -> str:
        """All of it is invented."""
        return "flat ground"

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        """Heights of the level's posts; see :meth:`terrasim.sources.source.Source.posts`."""
        del level
        count = count_of("height", self.height, self.grid)
        return np.full((len(rows), len(cols)), count, dtype=np.int32)

    def bound(self, key: Block) -> int:
        """Error of every level [counts]: none."""
        del key
        return 0

    def block(self, key: Block) -> BlockData:
        """One block, ready for the pool."""
        return read_block(self, key, self.bound(key))


@dataclass(frozen=True)
class Plane:
    """An inclined plane through a post, computed in whole numbers."""

    grid: Grid
    """Placement of the posts."""
    height: float = 0.0
    """World z [m] at post ``(row, col)``, rounded to a count."""
    slope_x: float = 0.0
    """Rise per metre along x (east)."""
    slope_y: float = 0.0
    """Rise per metre along y (north)."""
    row: int = 0
    """Row of the post where the height is given."""
    col: int = 0
    """Column of the post where the height is given."""

    def __post_init__(self) -> None:
        """Refuse a plane that leaves the range of heights inside the terrain."""
        for name in ("slope_x", "slope_y"):
            check_finite(name, getattr(self, name))
        base = count_of("height", self.height, self.grid)
        rise_x, rise_y = self._rises()
        grid = self.grid
        for row in (grid.row, grid.row + grid.rows - 1):
            for col in (grid.col, grid.col + grid.cols - 1):
                rise = (row - self.row) * rise_y + (col - self.col) * rise_x
                corner = base + (rise >> _FRACTION_BITS)
                if max(abs(corner), (abs(rise_x) | abs(rise_y)) >> _FRACTION_BITS) >= MAX_COUNT:
                    raise InputError(
                        f"the plane reaches {corner / COUNTS_PER_M:g} m above the datum at post "
                        f"({row}, {col}): heights lie within 21474 m of it; use gentler slopes "
                        "or fewer posts"
                    )

    @property
    def synthetic(self) -> str:
        """All of it is invented."""
        return "a plane"

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        """Heights of the level's posts; see :meth:`terrasim.sources.source.Source.posts`."""
        rise_x, rise_y = self._rises()
        base = count_of("height", self.height, self.grid) << _FRACTION_BITS
        half = 1 << (_FRACTION_BITS - 1)
        # Products may wrap around 64 bits; their sum is in range (checked) and so comes back right.
        north = rise_y * (_clamped_rows(self.grid, level, rows) - self.row) + (base + half)
        east = rise_x * (_clamped_cols(self.grid, level, cols) - self.col)
        return ((north[:, None] + east[None, :]) >> _FRACTION_BITS).astype(np.int32)

    def bound(self, key: Block) -> int:
        """Error of a block's level [counts].

        The plane itself has none. A post is within half a count of it, so a level is within one
        count of level 0, and within none if the rise from post to post is whole counts. Where the
        terrain's edge runs through a cell, :func:`slope_bound` is added.
        """
        if key.level == 0:
            return 0
        rise_x, rise_y = self._rises()
        if straddles_edge(self.grid, key):
            one = float(1 << _FRACTION_BITS)
            return in_counts(slope_bound(1 << key.level, abs(rise_x) / one, abs(rise_y) / one))
        return 1 if (rise_x | rise_y) & ((1 << _FRACTION_BITS) - 1) else 0

    def block(self, key: Block) -> BlockData:
        """One block, ready for the pool."""
        return read_block(self, key, self.bound(key))

    def _rises(self) -> tuple[int, int]:
        """Rise from post to post along x and y in 2^-32 counts."""
        scale = self.grid.spacing * COUNTS_PER_M
        return (_fixed_point(self.slope_x * scale), _fixed_point(self.slope_y * scale))


@dataclass(frozen=True)
class Sine:
    """Waves: ``height + amplitude * sin(2 pi x / wavelength) [* sin(2 pi y / wavelength_y)]``.

    ``x`` and ``y`` are metres from post ``(row, col)``. A wavelength of a whole number of posts
    repeats to the bit.
    """

    grid: Grid
    """Placement of the posts."""
    amplitude: float
    """Largest distance from ``height`` [m]."""
    wavelength: float
    """Wavelength along x [m]."""
    wavelength_y: float = math.inf
    """Wavelength along y [m]; infinite for waves along x alone, without the second factor."""
    height: float = 0.0
    """World z of the mean [m], rounded to a count."""
    row: int = 0
    """Row of the post from which y is measured."""
    col: int = 0
    """Column of the post from which x is measured."""

    def __post_init__(self) -> None:
        """Refuse what has no finite waves."""
        check_finite("amplitude", self.amplitude)
        for name in ("wavelength", "wavelength_y"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"{name} must be positive [m], got {getattr(self, name)}")
        if not math.isfinite(self.wavelength):
            raise InputError(f"wavelength must be finite [m], got {self.wavelength}")
        check_reach(self.height, self.amplitude, self.grid)

    @property
    def synthetic(self) -> str:
        """All of it is invented."""
        return "sine waves"

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        """Heights of the level's posts; see :meth:`terrasim.sources.source.Source.posts`."""
        grid = self.grid
        east = _wave(_clamped_cols(grid, level, cols) - self.col, self.wavelength / grid.spacing)
        scale = self.amplitude * COUNTS_PER_M
        if math.isinf(self.wavelength_y):
            rise = np.broadcast_to(scale * east, (len(rows), len(cols)))
        else:
            north = _clamped_rows(grid, level, rows) - self.row
            waves = _wave(north, self.wavelength_y / grid.spacing)
            rise = (scale * waves)[:, None] * east[None, :]
        return _rounded(rise, count_of("height", self.height, grid))

    def bound(self, key: Block) -> int:
        """Error of a block's level [counts].

        With ``k = 2 pi / wavelength``, ``|fx| <= A kx``, ``|fxx| <= A kx^2``, ``|fxy| <= A kx ky``
        and likewise in y: the smaller of :func:`curvature_bound`, :func:`slope_bound` and the
        range ``2 A``.
        """
        if key.level == 0:
            return 0
        leg = self.grid.spacing * (1 << key.level)
        size = abs(self.amplitude) * COUNTS_PER_M
        kx, ky = 2.0 * math.pi / self.wavelength, 2.0 * math.pi / self.wavelength_y
        distance = min(2.0 * size, slope_bound(leg, size * kx, size * ky))
        if not straddles_edge(self.grid, key):
            curved = curvature_bound(leg, size * kx * kx, size * kx * ky, size * ky * ky)
            distance = min(distance, curved)
        return in_counts(distance)

    def block(self, key: Block) -> BlockData:
        """One block, ready for the pool."""
        return read_block(self, key, self.bound(key))


@dataclass(frozen=True)
class Cone:
    """A cone on flat ground: ``ground + height * max(0, 1 - r / radius)``.

    ``r`` is the distance [m] from a point near post ``(row, col)``.
    """

    grid: Grid
    """Placement of the posts."""
    height: float
    """Height of the apex above the ground [m]; negative for a pit."""
    radius: float
    """Radius of the foot [m]."""
    ground: float = 0.0
    """World z of the ground around it [m], rounded to a count."""
    row: int = 0
    """Row of the post from which the apex is measured."""
    col: int = 0
    """Column of the post from which the apex is measured."""
    dx: float = 0.0
    """Distance of the apex east of that post [m]."""
    dy: float = 0.0
    """Distance of the apex north of that post [m]."""

    def __post_init__(self) -> None:
        """Refuse what is no cone."""
        for name in ("height", "radius", "dx", "dy"):
            check_finite(name, getattr(self, name))
        if self.radius <= 0.0:
            raise InputError(f"radius must be positive [m], got {self.radius}")
        check_reach(self.ground, self.height, self.grid)

    @property
    def synthetic(self) -> str:
        """All of it is invented."""
        return "a cone"

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        """Heights of the level's posts; see :meth:`terrasim.sources.source.Source.posts`."""
        y = (_clamped_rows(self.grid, level, rows) - self.row) * self.grid.spacing - self.dy
        x = (_clamped_cols(self.grid, level, cols) - self.col) * self.grid.spacing - self.dx
        distance = np.sqrt((y * y)[:, None] + (x * x)[None, :])
        rise = np.maximum(0.0, 1.0 - distance / self.radius) * (self.height * COUNTS_PER_M)
        return _rounded(rise, count_of("ground", self.ground, self.grid))

    def bound(self, key: Block) -> int:
        """Error of a block's level [counts].

        The slope is ``s = |height| / radius``, and the corners of a triangle with legs ``H`` are
        ``sum w_i |d_i| <= sqrt(sum w_i d_i^2) <= H / sqrt(2)`` from a point of it, which bounds the
        error by ``s H / sqrt(2)``. A block wholly on the slope, no nearer than ``d`` to the apex,
        has second derivatives of at most ``s / d`` in any direction: ``s / d * H^2 / 4``. A block
        wholly on the ground has no error.
        """
        if key.level == 0:
            return 0
        leg = self.grid.spacing * (1 << key.level)
        slope = abs(self.height) / self.radius * COUNTS_PER_M
        near, far = self._distances(key)
        if near >= self.radius:
            return 0
        distance = slope * leg / math.sqrt(2.0)
        if near > 0.0 and far <= self.radius and not straddles_edge(self.grid, key):
            distance = min(distance, slope / near * leg * leg / 4.0)
        return in_counts(min(distance, abs(self.height) * COUNTS_PER_M))

    def block(self, key: Block) -> BlockData:
        """One block, ready for the pool."""
        return read_block(self, key, self.bound(key))

    def _distances(self, key: Block) -> tuple[float, float]:
        """Smallest and largest distance [m] of the apex from the block's part of the terrain."""
        ends = np.array([0, BLOCK], dtype=np.int64)
        y = _clamped_rows(self.grid, key.level, key.row * BLOCK + ends) - self.row
        x = _clamped_cols(self.grid, key.level, key.col * BLOCK + ends) - self.col
        y0, y1 = (float(v) * self.grid.spacing - self.dy for v in y)
        x0, x1 = (float(v) * self.grid.spacing - self.dx for v in x)
        # A little is taken off and added for the rounding of these numbers themselves.
        near = math.hypot(max(0.0, y0, -y1), max(0.0, x0, -x1)) * (1.0 - 1e-12)
        far = math.hypot(max(-y0, y1), max(-x0, x1)) * (1.0 + 1e-12)
        return near, far


def _clamped_rows(grid: Grid, level: int, rows: Indices) -> Indices:
    return grid.clamp_rows(np.asarray(rows, dtype=np.int64) << level)


def _clamped_cols(grid: Grid, level: int, cols: Indices) -> Indices:
    return grid.clamp_cols(np.asarray(cols, dtype=np.int64) << level)


def _wave(offset: Indices, period: float) -> npt.NDArray[np.float64]:
    """``sin(2 pi offset / period)``; both in posts.

    One value at a time, because NumPy's vector sine may answer differently by its neighbours.
    """
    whole = round(period)
    if whole > 0 and abs(period - whole) <= 1e-9 * period:
        turns = (offset % whole) / float(whole)
    else:
        turns = np.modf(offset / period)[0]
    angles = (2.0 * math.pi * turns).tolist()
    return np.fromiter(map(math.sin, angles), dtype=np.float64, count=len(angles))


def _rounded(rise: npt.NDArray[np.float64], base: int) -> Counts:
    """Counts of a rise in counts above a base."""
    return (np.rint(rise).astype(np.int64) + base).astype(np.int32)


def _fixed_point(counts: float) -> int:
    return round(counts * (1 << _FRACTION_BITS))
