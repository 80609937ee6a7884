"""Finding the balls that are near each other, through a hash grid.

It is made anew each time: balls are sorted by the bucket of their bin, and each lists its
neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from terrasim.balls.balls import Balls
from terrasim.kernels.ball_grid import Bin, Bins, Sphere, bucket_balls, find_starts, gather_balls
from terrasim.kernels.ball_near import keep_mutual, list_neighbours
from terrasim.launch import launch
from terrasim.terrain import Terrain

NEIGHBOURS = 16
"""Balls that a ball can meet in a step: 12 equal ones fit around one."""
VISITS = 256
"""Balls that a ball looks at in each row of three bins: so many are in a dense pile of balls whose
radii differ by a factor of 3.5."""
SLACK = 0.1
"""Balls that are apart by this part of the sum of their radii may come to touch while others are
pushed apart."""
PAIR_BYTES: int = (
    sum(wp.types.type_size_in_bytes(dtype) for dtype in (Sphere, Bin, wp.vec3d))
    # Buckets twice, order twice, up to four buckets a ball, and its place.
    + 4 * (2 + 2 + 4 + 1)
    # Two lists with their lengths, the second of them only in a crowd.
    + 2 * 4 * (NEIGHBOURS + 1)
    + 1
)
"""Bytes a ball at most, while balls are let collide; nothing is kept after it."""
_MOST_PARTS = 2.0**20
_MOST_CELLS = 2.0**33


@dataclass
class Near:
    """Balls in the order of the grid and, for each, those near it."""

    at: Any
    """Places in that order of the balls that have neighbours, int32."""
    sphere: Any
    """``Sphere``, in the order of the grid."""
    velocity: Any
    """Velocities [m/s], vec3d, in that order."""
    near: Any
    """Places in that order of the neighbours, int32, shape ``(count, neighbours)``."""
    listed: Any
    """How many of them there are, int32."""
    crowded: Any
    """1 if there were more, uint8."""


def find_near(terrain: Terrain, balls: Balls, neighbours: int, visits: int) -> Near:
    """Sort balls by bucket and list the neighbours of each."""
    count, device = balls.count, terrain.device
    bins = _bins(terrain.grid.spacing, balls, visits)
    order, start = _sorted(terrain, balls, bins)
    mass = getattr(balls, "mass", None)
    if mass is None:
        mass = wp.empty(0, dtype=wp.float64, device=device)
    every: Any = wp.array(np.arange(count, dtype=np.int32), device=device)
    bin_of = wp.empty(count, dtype=Bin, device=device)
    found = Near(
        at=every,
        sphere=wp.empty(count, dtype=Sphere, device=device),
        velocity=wp.empty(count, dtype=wp.vec3d, device=device),
        near=wp.empty((count, neighbours), dtype=int, device=device),
        listed=wp.empty(count, dtype=int, device=device),
        crowded=wp.empty(count, dtype=wp.uint8, device=device),
    )
    state = [balls.cell, balls.offset, balls.z, balls.material, mass, balls.velocity]
    split(terrain, gather_balls, [bins, *state], [order, found.sphere, bin_of, found.velocity])
    lists = [found.near, found.listed, found.crowded]
    split(terrain, list_neighbours, [bins, start, found.sphere, bin_of, *lists], [every])
    if found.crowded.numpy().any():
        near, listed = wp.empty_like(found.near), wp.empty_like(found.listed)
        split(terrain, keep_mutual, [*lists, near, listed], [every])
        found.near, found.listed = near, listed
    some = np.flatnonzero(found.listed.numpy()).astype(np.int32)
    found.at = wp.array(some, dtype=int, device=device)
    return found


def near_pairs(
    terrain: Terrain, balls: Balls, *, neighbours: int = NEIGHBOURS, visits: int = VISITS
) -> Any:
    """Numbers of the balls that are near each other, lower one first, sorted, shape ``(pairs, 2)``.

    Near are those apart by at most ``SLACK`` of the sum of their radii.
    """
    if balls.count == 0:
        return np.zeros((0, 2), dtype=np.int64)
    found = find_near(terrain, balls, neighbours, visits)
    number = found.sphere.numpy()["number"].astype(np.int64)
    filled = np.arange(neighbours) < found.listed.numpy()[:, None]
    mine, place = np.nonzero(filled)
    pair = np.column_stack([number[mine], number[found.near.numpy()[mine, place]]])
    pair = pair[pair[:, 0] < pair[:, 1]]
    return pair[np.lexsort((pair[:, 1], pair[:, 0]))]


def _bins(spacing: float, balls: Balls, visits: int) -> Any:
    """Bins as wide as the largest balls need."""
    radius = balls.material.numpy()["radius"]
    # A little wider than needed, against rounding.
    wide = 2.0 * float(radius.max()) * (1.0 + SLACK) * (1.0 + 1e-6)
    bins: Any = Bins()
    bins.row, bins.col = balls.cell[:1].numpy()[0].tolist()
    bins.spacing, bins.slack, bins.visits = spacing, SLACK, visits
    bins.parts = float(math.floor(min(max(spacing / wide, 1.0), _MOST_PARTS)))
    bins.cells = float(math.ceil(min(max(wide / spacing, 1.0), _MOST_CELLS)))
    bins.height = max(wide, spacing * bins.cells / bins.parts)
    bins.mask = (1 << max(6, (2 * balls.count - 1).bit_length())) - 1
    return bins


def _sorted(terrain: Terrain, balls: Balls, bins: Any) -> tuple[Any, Any]:
    """Numbers of the balls sorted by bucket, then number; and where each bucket starts."""
    count, device = balls.count, terrain.device
    # Warp sorts within arrays of twice the length.
    bucket = wp.empty(2 * count, dtype=int, device=device)
    order: Any = wp.array(np.arange(2 * count, dtype=np.int32), device=device)
    places = [balls.cell, balls.offset, balls.z]
    split(terrain, bucket_balls, [bins], [*places, bucket[:count]])
    wp.utils.radix_sort_pairs(bucket, order, count)
    start = wp.empty(bins.mask + 2, dtype=int, device=device)
    wp.launch(
        find_starts, dim=count + 1, inputs=[bucket, count, bins.mask], outputs=[start],
        device=device,
    )  # fmt: skip
    return order[:count], start


def split(terrain: Terrain, kernel: Any, shared: list[Any], items: list[Any]) -> None:
    """Launch a kernel over its last parameters, split over the terrain's threads."""
    launch(
        kernel,
        len(items[0]),
        shared=shared,
        items=items,
        device=terrain.device,
        threads=terrain.threads,
    )
