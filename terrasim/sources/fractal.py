"""Fractal terrain: octaves of seeded gradient noise, on any number of posts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from terrasim.counts import COUNTS_PER_M, Counts
from terrasim.errors import InputError
from terrasim.grid import Block, Grid, Indices
from terrasim.sources.error_bound import in_counts, straddles_edge
from terrasim.sources.gradient_noise import Octave, add_octave, octave_error, octaves
from terrasim.sources.height_range import check_finite, check_reach, count_of
from terrasim.sources.source import BlockData, read_block

TILE = 256
"""Posts along the side of the squares in which heights are computed, whatever is asked for."""


@dataclass(frozen=True)
class Fractal:
    """Octaves of noise, each half as wide as the one before and ``roughness`` as high.

    A post's height depends on its indices and the seed alone, so the same place has the same
    height in a small terrain and in a large one.
    """

    grid: Grid
    """Placement of the posts."""
    amplitude: float
    """Largest distance from ``height`` [m] of all octaves together."""
    wavelength: int = 1024
    """Lattice spacing of the first octave [posts], a power of two from 2 on."""
    octaves: int = 8
    """Number of octaves."""
    roughness: float = 0.5
    """Height of an octave relative to the one before, above 0 and at most 1."""
    seed: int = 0
    """Which of the terrains, 0 to 2^63 - 1."""
    height: float = 0.0
    """World z of the mean [m], rounded to a count."""

    def __post_init__(self) -> None:
        """Refuse what has no octaves or leaves the range of heights."""
        wavelength, count = self.wavelength, self.octaves
        if wavelength < 2 or wavelength & (wavelength - 1) or wavelength > 1 << 30:
            raise InputError(
                f"wavelength must be a power of two from 2 to 2^30 posts, got {wavelength}"
            )
        if not 1 <= count <= wavelength.bit_length():
            raise InputError(
                f"octaves must lie between 1 and {wavelength.bit_length()} for a wavelength of "
                f"{wavelength} posts, the last one being 1 post, got {count}"
            )
        if not 0.0 < self.roughness <= 1.0:
            raise InputError(f"roughness must be above 0 and at most 1, got {self.roughness}")
        check_seed(self.seed)
        check_finite("amplitude", self.amplitude)
        check_reach(self.height, self.amplitude, self.grid)

    @property
    def synthetic(self) -> str:
        """All of it is invented."""
        return f"fractal noise (seed {self.seed})"

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        """Heights of the level's posts; see :meth:`terrasim.sources.source.Source.posts`."""
        row = self.grid.clamp_rows(np.asarray(rows, dtype=np.int64) << level)
        col = self.grid.clamp_cols(np.asarray(cols, dtype=np.int64) << level)
        base = count_of("height", self.height, self.grid)
        counts = np.empty((len(row), len(col)), dtype=np.int32)
        for part_rows, part_cols in tiles(len(row), len(col)):
            heights = np.zeros((len(row[part_rows]), len(col[part_cols])))
            for octave in self._octaves:
                add_octave(heights, octave, row[part_rows], col[part_cols])
            np.rint(heights, out=heights)
            heights += base
            counts[part_rows, part_cols] = heights
        return counts

    def bound(self, key: Block) -> int:
        """Error of a block's level [counts].

        The sum of what each octave can differ from its interpolant, :func:`octave_error`.
        """
        if key.level == 0:
            return 0
        smooth = not straddles_edge(self.grid, key)
        leg = 1 << key.level
        return in_counts(sum(octave_error(o, leg, smooth=smooth) for o in self._octaves))

    def block(self, key: Block) -> BlockData:
        """One block, ready for the pool."""
        return read_block(self, key, self.bound(key))

    @cached_property
    def _octaves(self) -> tuple[Octave, ...]:
        total = sum(self.roughness**i for i in range(self.octaves))
        return octaves(
            self.seed,
            self.wavelength.bit_length() - 1,
            self.octaves,
            amplitude=self.amplitude * COUNTS_PER_M / total,
            ratio=self.roughness,
            pinned=False,
        )


def tiles(rows: int, cols: int) -> Iterator[tuple[slice, slice]]:
    """Squares that cover an array, so that the memory for a large one stays small."""
    for row in range(0, rows, TILE):
        for col in range(0, cols, TILE):
            yield slice(row, row + TILE), slice(col, col + TILE)


def check_seed(seed: int) -> None:
    """Refuse a seed that is no integer from 0 to 2^63 - 1."""
    if not 0 <= seed < 1 << 63:
        raise InputError(f"seed must lie between 0 and 2^63 - 1, got {seed}")
