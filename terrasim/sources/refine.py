"""Seeded fractal detail below a source's own spacing, with the source's posts left as they are."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import numpy.typing as npt

from terrasim.counts import COUNTS_PER_M, HOLE, MAX_COUNT, Counts
from terrasim.errors import InputError
from terrasim.grid import Block, Grid, Indices
from terrasim.kernels.addressing import BLOCK
from terrasim.sources.cubic import Bends, bends, deviation, heights, interpolation_error, line
from terrasim.sources.error_bound import bound_of, in_counts
from terrasim.sources.fractal import check_seed, tiles
from terrasim.sources.gradient_noise import Octave, add_octave, octave_error, octaves
from terrasim.sources.source import BlockData, Source, read_block

_LIMIT = 0.5
"""Second differences beyond this part of the source's spacing are clipped; see ``cubic``."""


@dataclass(frozen=True)
class Refined:
    """A source at ``factor`` times as many posts along each side.

    Every ``factor``-th post is the source's post to the bit. Between them stands a bicubic through
    the source's posts, and octaves of noise that are 0 at the source's posts. Level
    ``log2(factor)`` and coarser levels are the source's own levels. Holes stay what they were.
    """

    source: Source
    """The terrain that is refined."""
    factor: int
    """New posts to one of the source, a power of two from 2 on."""
    relief: float = 0.02
    """Amplitude of the first octave, as wide as the source's spacing, in parts of that spacing."""
    roughness: float = 0.5
    """Height of an octave relative to the one before, above 0 and at most 1."""
    seed: int = 0
    """Which of the possible details, 0 to 2^63 - 1."""

    def __post_init__(self) -> None:
        """Refuse what cannot be refined."""
        if self.factor < 2 or self.factor & (self.factor - 1):
            raise InputError(
                f"factor of refinement must be a power of two from 2 on, got {self.factor}"
            )
        if not 0.0 <= self.relief <= 1.0:
            raise InputError(
                f"relief must lie between 0 and 1 of the source's spacing, got {self.relief}"
            )
        if not 0.0 < self.roughness <= 1.0:
            raise InputError(f"roughness must be above 0 and at most 1, got {self.roughness}")
        check_seed(self.seed)
        _ = self.grid

    @cached_property
    def grid(self) -> Grid:
        """Placement of the level-0 posts."""
        grid = self.source.grid
        return dataclasses.replace(
            grid,
            rows=(grid.rows - 1) * self.factor + 1,
            cols=(grid.cols - 1) * self.factor + 1,
            row=grid.row * self.factor,
            col=grid.col * self.factor,
            spacing=grid.spacing / self.factor,
        )

    @property
    def synthetic(self) -> str:
        """The source's own inventions and the detail."""
        own = f"fractal detail below {self.source.grid.spacing:g} m (seed {self.seed})"
        return "; ".join(filter(None, (self.source.synthetic, own)))

    def posts(self, level: int, rows: Indices, cols: Indices) -> Counts:
        """Heights of the level's posts; see :meth:`terrasim.sources.source.Source.posts`."""
        if level >= self._shift:
            return self.source.posts(level - self._shift, rows, cols)
        row = self.grid.clamp_rows(np.asarray(rows, dtype=np.int64) << level)
        col = self.grid.clamp_cols(np.asarray(cols, dtype=np.int64) << level)
        counts = np.empty((len(row), len(col)), dtype=np.int32)
        for part_rows, part_cols in tiles(len(row), len(col)):
            counts[part_rows, part_cols] = self._fine(row[part_rows], col[part_cols])
        return counts

    def bound(self, key: Block) -> int:
        """Error of a block's level [counts].

        Finer than the source: what the bicubic and each octave can differ from their interpolants.
        The source's levels: the source's own error, the bicubic's distance from the source's
        surface, and the amplitudes of the octaves.
        """
        if key.level == 0:
            return 0
        noise = sum(octave_error(o, 1 << key.level, smooth=True) for o in self._octaves)
        if key.level >= self._shift:
            own = Block(key.level - self._shift, key.row, key.col)
            return bound_of(self.source, own) + self._coarse_error(own, noise)
        leg = 2.0 ** (key.level - self._shift)
        bent = self._bends(key)
        return in_counts(noise + interpolation_error(bent, self._limit, leg))

    def block(self, key: Block) -> BlockData:
        """One block, ready for the pool."""
        if key.level < self._shift:
            return read_block(self, key, self.bound(key))
        own = Block(key.level - self._shift, key.row, key.col)
        data = self.source.block(own)
        noise = sum(octave.amplitude for octave in self._octaves)
        return dataclasses.replace(data, error=data.error + self._coarse_error(own, noise))

    @cached_property
    def _shift(self) -> int:
        return self.factor.bit_length() - 1

    @cached_property
    def _limit(self) -> float:
        return _LIMIT * self.source.grid.spacing * COUNTS_PER_M

    @cached_property
    def _octaves(self) -> tuple[Octave, ...]:
        if self.relief == 0.0:
            return ()
        amplitude = self.relief * self.source.grid.spacing * COUNTS_PER_M
        return octaves(
            self.seed,
            self._shift,
            self._shift,
            amplitude=amplitude,
            ratio=self.roughness,
            pinned=True,
        )

    def _fine(self, rows: Indices, cols: Indices) -> Counts:
        """Heights at level-0 posts inside the terrain."""
        grid = self.source.grid
        whole, added, hole = heights(
            self.source,
            line(rows, self._shift, grid.row, grid.row + grid.rows - 1),
            line(cols, self._shift, grid.col, grid.col + grid.cols - 1),
            self._limit,
        )
        for octave in self._octaves:
            add_octave(added, octave, rows, cols)
        np.rint(added, out=added)
        whole += added.astype(np.int64)
        np.clip(whole, -MAX_COUNT, MAX_COUNT, out=whole)
        whole[hole] = HOLE
        return whole.astype(np.int32)

    def _bends(self, key: Block) -> Bends:
        """Bends of the source's posts under a block."""
        grid = self.source.grid
        first_row, last_row = grid.row, grid.row + grid.rows - 1
        first_col, last_col = grid.col, grid.col + grid.cols - 1
        return bends(
            self.source,
            self._under(key.row, key.level, first_row, last_row),
            self._under(key.col, key.level, first_col, last_col),
        )

    def _under(self, index: int, level: int, first: int, last: int) -> Indices:
        """The source's rows under a row of blocks, and two more on each side."""
        low = ((index * BLOCK) << level) >> self._shift
        high = -((-((index + 1) * BLOCK) << level) >> self._shift)
        low, high = min(max(low, first), last), min(max(high, first), last)
        return np.arange(low - 2, high + 3)

    def _coarse_error(self, own: Block, noise: float) -> int:
        """Bound [counts] of the distance of the heights from the source's surface under a block.

        Above the source's level 0 its posts are not read. They are within the level's error ``E``
        of the level's surface, so their second and cross differences are within ``4 E`` of that
        surface's, which are its changes of slope at the edges of its triangles.
        """
        if own.level == 0:
            bent = self._bends(Block(self._shift, own.row, own.col))
            return in_counts(noise + deviation(bent, self._limit))
        most = in_counts(noise + 0.5 * self._limit)
        error = max(bound_of(self.source, key) for key in self._neighbours(own))
        spread = Bends(4.0 * error, 4.0 * error, 4.0 * error, holes=False)
        if in_counts(noise + deviation(spread, self._limit)) >= most:
            return most
        span = np.arange(-1, BLOCK + 2)
        posts = self.source.posts(own.level, own.row * BLOCK + span, own.col * BLOCK + span)
        if (posts == HOLE).any():
            return most
        kinks = _kinks(posts.astype(np.int64)) / (1 << own.level) + 4.0 * error
        bent = Bends(kinks[0], kinks[1], kinks[2], holes=False)
        return in_counts(noise + deviation(bent, self._limit))

    def _neighbours(self, own: Block) -> list[Block]:
        """A block of the source and those around it, as far as there are any."""
        span = self.source.grid.blocks(own.level)
        return [
            Block(own.level, row, col)
            for row in range(own.row - 1, own.row + 2)
            for col in range(own.col - 1, own.col + 2)
            if span.row0 <= row < span.row1 and span.col0 <= col < span.col1
        ]


def _kinks(posts: Indices) -> npt.NDArray[np.float64]:
    """Largest changes of slope of triangulated posts, in counts a post, along x, y and diagonals.

    A line along x meets vertical edges, from the triangle below one diagonal to the one above the
    next, diagonals, where the slope changes by the cell's cross difference, and posts.
    """
    dx, dy = np.diff(posts, axis=1), np.diff(posts, axis=0)
    cross = np.abs(np.diff(dx, axis=0)).max()
    along_x = max(np.abs(dx[1:, 1:] - dx[:-1, :-1]).max(), np.abs(np.diff(dx, axis=1)).max())
    along_y = max(np.abs(dy[1:, 1:] - dy[:-1, :-1]).max(), np.abs(np.diff(dy, axis=0)).max())
    return np.array([max(along_x, cross), max(along_y, cross), cross], dtype=np.float64)
