"""Block size and layout inside a block: what a query costs over each.

The same million points over the same 4096^2 posts, in blocks of 128, 256 and 1,024 posts a side,
row-major or in micro-tiles of 8 x 8 posts; and what a block of each size takes to decode.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import warp as wp

from terrasim.bench.bench import Row
from terrasim.bench.timing import cpu_seconds, median_ratio, wall_seconds
from terrasim.store.codec import pack, unpack
from terrasim.terrain import open_device

POSTS = 4096
COUNT = 1_000_000
CHOSEN = (8, False)
"""The pool's block size, as a shift, and whether it is micro-tiled."""


def measure(device: str) -> list[Row]:
    """Time every variant against the chosen one."""
    opened = open_device(device)
    axis = np.arange(POSTS)
    wave = 2e5 * np.sin(axis / 97.0)
    heights = np.rint(wave[:, None] + 0.7 * wave[None, :]).astype(np.int32)
    rows: list[Row] = []
    for order in ("random", "sorted"):
        points = np.random.default_rng(3).uniform(0.0, POSTS - 1.0, (COUNT, 2))
        if order == "sorted":
            tile = points.astype(np.int64) >> 4
            points = points[np.argsort(tile[:, 1] * POSTS + tile[:, 0], kind="stable")]
        rows += _queries(opened, heights, points, order)
    return rows + _decoding(heights)


def _queries(
    device: Any, heights: npt.NDArray[np.int32], points: npt.NDArray[np.float64], order: str
) -> list[Row]:
    from terrasim.kernels.layout import VARIANTS

    asked: Any = wp.array(points, dtype=wp.vec2d, device=device)
    answers: list[Any] = [wp.empty(COUNT, dtype=wp.float64, device=device) for _ in VARIANTS]
    works = []
    for (key, kernel), answer in zip(VARIANTS.items(), answers, strict=True):
        pool, table = _laid_out(heights, *key)
        blocks = POSTS >> key[0]
        inputs = [wp.array(pool, device=device), wp.array(table, device=device), blocks, asked]

        def work(kernel: Any = kernel, inputs: Any = inputs, answer: Any = answer) -> None:
            wp.launch(kernel, COUNT, inputs=inputs, outputs=[answer], device=device)
            wp.synchronize_device(device)

        works.append(work)
    clock = wall_seconds if device.is_cuda else cpu_seconds
    times = dict(zip(VARIANTS, clock(works, repeats=9), strict=True))
    expected = answers[0].numpy()
    for answer in answers:
        np.testing.assert_array_equal(answer.numpy(), expected)
    return [
        Row(
            f"query, {_name(*key)}, {order}",
            float(np.median(taken)) / COUNT * 1e9,
            "ns a point",
            _name(*CHOSEN),
            median_ratio(taken, times[CHOSEN]),
        )
        for key, taken in times.items()
    ]


def _decoding(heights: npt.NDArray[np.int32]) -> list[Row]:
    """Decoding one block of each size, a post."""
    sizes = (128, 256, 1024)
    blobs = [pack(np.ascontiguousarray(heights[:size, :size])) for size in sizes]
    works = [lambda blob=blob: unpack(blob) for blob in blobs]
    times = dict(zip(sizes, cpu_seconds(works, repeats=25), strict=True))
    chosen = 1 << CHOSEN[0]
    return [
        Row(
            f"decode, block of {size}",
            float(np.median(taken)) / size**2 * 1e9,
            "ns a post",
            f"block of {chosen}",
            median_ratio(taken, times[chosen]) * chosen**2 / size**2,
        )
        for size, taken in times.items()
    ]


def _laid_out(
    heights: npt.NDArray[np.int32], shift: int, tiled: bool
) -> tuple[npt.NDArray[np.int32], npt.NDArray[np.int32]]:
    """A pool in which the blocks stand in shuffled order, and the table that finds them."""
    side = 1 << shift
    blocks = POSTS // side
    cut = heights.reshape(blocks, side, blocks, side).swapaxes(1, 2).reshape(-1, side, side)
    if tiled:
        cut = cut.reshape(-1, side // 8, 8, side // 8, 8).swapaxes(2, 3)
    order = np.random.default_rng(1).permutation(blocks * blocks)
    table = np.empty(blocks * blocks, np.int32)
    table[order] = np.arange(blocks * blocks, dtype=np.int32)
    return np.ascontiguousarray(cut[order]).reshape(-1), table


def _name(shift: int, tiled: bool) -> str:
    return f"blocks of {1 << shift}, {'micro-tiles' if tiled else 'row-major'}"
