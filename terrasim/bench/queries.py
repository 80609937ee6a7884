"""A million heights: against a serial numba loop, NumPy and a copy of the bytes."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.bench.bench import Row, numba_missing
from terrasim.bench.timing import cpu_seconds, median_ratio, wall_seconds
from terrasim.grid import Grid
from terrasim.query import level_lattice, sample, sample_all
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

COUNT = 1_000_000
POSTS = 1024
"""Posts each way: 16 blocks, 4 MiB."""
WIDE = 4096
"""Posts each way of the terrain that no cache holds: 256 blocks, 64 MiB."""

Points = npt.NDArray[np.float64]


def measure(device: str) -> list[Row]:
    """Time ``sample`` on points in random and in sorted order."""
    rows: list[Row] = []
    for posts in (POSTS, WIDE):
        source = _source(posts)
        pool_bytes = 2 * posts * posts * 4 + (4 << 20)
        with Terrain(source, device=device, pool_bytes=pool_bytes) as terrain:
            for order in ("random", "sorted"):
                points = _points(posts, order)
                sample(terrain, points)
                name = f"1M heights, {posts}^2 posts, {order}"
                if terrain.device.is_cuda:
                    rows += _on_cuda(terrain, points, name)
                else:
                    rows += _on_cpu(terrain, source, points, name)
    return rows


def _source(posts: int) -> ArraySource:
    x = np.arange(posts) / posts * 40.0
    heights = 50.0 * np.sin(x)[:, None] * np.cos(1.3 * x)[None, :]
    return ArraySource.from_metres(heights, spacing=1.0)


def _points(posts: int, order: str) -> Points:
    points = np.random.default_rng(7).uniform(0.0, posts - 1.0, (COUNT, 2))
    if order == "random":
        return points
    tile = points.astype(np.int64) >> 4
    return points[np.argsort(tile[:, 1] * posts + tile[:, 0], kind="stable")]


def _on_cpu(terrain: Terrain, source: ArraySource, points: Points, name: str) -> list[Row]:
    heights = source.posts(0, np.arange(source.grid.rows), np.arange(source.grid.cols))
    touched = np.zeros(_bytes_touched() // 8)
    ours, full, plain, copy = cpu_seconds(
        [
            lambda: sample(terrain, points),
            lambda: sample_all(terrain, points),
            lambda: numpy_heights(heights, points),
            touched.copy,
        ],
        repeats=5,
    )
    best = min(ours) / COUNT * 1e9
    rows = [
        Row(name, best, "ns a point", "NumPy", median_ratio(ours, plain)),
        Row(
            f"{name}, with all answers",
            min(full) / COUNT * 1e9,
            "ns a point",
            name,
            median_ratio(full, ours),
        ),
        Row(
            f"{name}, against bytes",
            best,
            "ns a point",
            "a copy of the bytes touched",
            median_ratio(ours, copy),
        ),
    ]
    if not numba_missing():
        rows.append(_against_numba(terrain, points, name))
    return rows


def _bytes_touched() -> int:
    """Bytes a million queries must move: points in, heights and states out, two lines of posts."""
    return COUNT * (16 + 8 + 1 + 2 * 64)


def _against_numba(terrain: Terrain, points: Points, name: str) -> Row:
    from terrasim.bench.numba_loop import heights_loop

    loop = heights_loop()
    pool, table = terrain.pool.numpy(), terrain.resident.numpy()
    place = _placement(terrain.grid)

    def serial() -> object:
        height = np.empty(len(points))
        state = np.empty(len(points), np.uint8)
        loop(pool, table, place, points, height, state)
        return height

    if not np.array_equal(serial(), sample(terrain, points).height):  # type: ignore[arg-type]
        raise RuntimeError("the numba loop and sample disagree")
    ours, theirs = cpu_seconds([lambda: sample(terrain, points), serial], repeats=15)
    return Row(
        f"{name}, against numba",
        min(theirs) / COUNT * 1e9,
        "ns a point (numba)",
        "a serial numba loop (ours over its)",
        median_ratio(ours, theirs),
    )


def _placement(grid: Grid) -> Points:
    lattice: Any = level_lattice(grid, 0)
    return np.array(
        [
            lattice.x,
            lattice.y,
            lattice.z,
            lattice.spacing,
            lattice.west,
            lattice.east,
            lattice.south,
            lattice.north,
        ]
    )


def numpy_heights(heights: npt.NDArray[np.int32], points: Points) -> Points:
    """The same surface over a plain array, as a NumPy user would write it."""
    col = np.minimum(points[:, 0].astype(np.int64), heights.shape[1] - 2)
    row = np.minimum(points[:, 1].astype(np.int64), heights.shape[0] - 2)
    u, v = points[:, 0] - col, points[:, 1] - row
    near = heights[row, col].astype(np.float64)
    far = heights[row + 1, col + 1]
    mid = np.where(u >= v, heights[row, col + 1], heights[row + 1, col])
    total = near + ((mid - near) * np.maximum(u, v) + (far - mid) * np.minimum(u, v))
    answer: Points = total * 1e-5
    return answer


def _on_cuda(terrain: Terrain, points: Points, name: str) -> list[Row]:
    from terrasim.kernels.sample import sample_height

    asked: Any = wp.array(points, dtype=wp.vec2d, device=terrain.device)
    height = wp.empty(COUNT, dtype=wp.float64, device=terrain.device)
    state = wp.empty(COUNT, dtype=wp.uint8, device=terrain.device)
    inputs = [terrain.pool, terrain.resident, terrain.lattice, 0, terrain.used, asked]
    launches = 100

    def ours() -> None:
        for _ in range(launches):
            wp.launch(
                sample_height, COUNT, inputs=inputs, outputs=[height, state], device=terrain.device
            )
        wp.synchronize_device(terrain.device)

    left = wp.empty(_bytes_touched(), dtype=wp.uint8, device=terrain.device)
    right = wp.empty_like(left)

    def copy() -> None:
        for _ in range(launches):
            wp.copy(left, right)
        wp.synchronize_device(terrain.device)

    ours_s, copy_s = wall_seconds([ours, copy], repeats=5)
    rate = COUNT * launches / min(ours_s) / 1e9
    return [
        Row(
            name,
            rate,
            "G points/s",
            "a copy of the bytes touched (time over its)",
            median_ratio(ours_s, copy_s),
        )
    ]
