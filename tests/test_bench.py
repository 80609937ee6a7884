"""The bench's machinery, and that what it compares does the same work."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrasim.bench.bench import BENCHES, Row, bench, save, table
from terrasim.bench.queries import _placement, numpy_heights
from terrasim.bench.timing import median_ratio
from terrasim.counts import HOLE
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.query import sample
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain


def test_the_numba_loop_does_the_work_of_sample() -> None:
    """Heights and states agree to the bit: borders, holes and beyond the edge included."""
    pytest.importorskip("numba", reason="numba is a development dependency")
    from terrasim.bench.numba_loop import heights_loop

    rng = np.random.default_rng(4)
    posts = rng.integers(-500_000, 500_000, (600, 700)).astype(np.int32)
    posts[rng.integers(0, 600, 40), rng.integers(0, 700, 40)] = HOLE
    posts[0, 100:200] = HOLE
    points = rng.uniform(-20.0, 720.0, (20_000, 2))
    with Terrain(ArraySource(posts, Grid(600, 700, 1.0))) as terrain:
        ours = sample(terrain, points)
        height, state = np.full(len(points), np.nan), np.empty(len(points), np.uint8)
        heights_loop()(
            terrain.pool.numpy(),
            terrain.resident.numpy(),
            _placement(terrain.grid),
            points,
            height,
            state,
        )
    np.testing.assert_array_equal(state, ours.state)
    np.testing.assert_array_equal(height, ours.height)
    assert set(np.unique(state)) == {0, 1, 2, 3}


def test_the_numpy_version_does_the_work_of_sample() -> None:
    """Inside a plain terrain they agree to the bit."""
    rng = np.random.default_rng(5)
    posts = rng.integers(-500_000, 500_000, (300, 300)).astype(np.int32)
    points = rng.uniform(0.0, 299.0, (5_000, 2))
    with Terrain(ArraySource(posts, Grid(300, 300, 1.0))) as terrain:
        np.testing.assert_array_equal(numpy_heights(posts, points), sample(terrain, points).height)


def test_every_layout_gives_the_same_heights() -> None:
    """Each variant finds the same posts at its own places."""
    import warp as wp

    from terrasim.bench.layout import POSTS, _laid_out
    from terrasim.kernels.layout import VARIANTS

    rng = np.random.default_rng(6)
    heights = rng.integers(-1000, 1000, (POSTS, POSTS)).astype(np.int32)
    points = rng.uniform(0.0, POSTS - 1.0, (2_000, 2))
    for (shift, tiled), kernel in VARIANTS.items():
        pool, layers = _laid_out(heights, shift, tiled)
        out = wp.empty(len(points), dtype=wp.float64, device="cpu")
        inputs = [wp.array(pool, device="cpu"), wp.array(layers, device="cpu"), POSTS >> shift]
        asked: Any = wp.array(points, dtype=wp.vec2d, device="cpu")
        wp.launch(kernel, len(points), inputs=[*inputs, asked], outputs=[out], device="cpu")
        np.testing.assert_array_equal(out.numpy(), numpy_heights(heights, points))


def test_a_saved_result_keeps_the_rows_of_other_benches(tmp_path: Path) -> None:
    """A second save replaces rows of the same name and keeps the rest."""
    first = {"device": "A CPU, 2 GHz", "rows": [vars(Row("a", 1.0, "s")), vars(Row("b", 2.0, "s"))]}
    second = {"device": "A CPU, 2 GHz", "rows": [vars(Row("b", 3.0, "s", "c", 1.5))]}
    save(first, tmp_path)
    path = save(second, tmp_path)
    assert path.name == "a-cpu-2-ghz.json"
    values = {row["name"]: row["value"] for row in json.loads(path.read_text())["rows"]}
    assert values == {"a": 1.0, "b": 3.0}


def test_an_unknown_bench_is_refused_with_the_known_ones() -> None:
    """The error names it and lists the others."""
    with pytest.raises(InputError, match=r"no bench 'speed'.*queries"):
        bench(["speed"])


@pytest.mark.parametrize("name", list(BENCHES))
def test_every_bench_has_a_module_that_measures(name: str) -> None:
    """The names of the command line lead somewhere."""
    from importlib import import_module

    assert callable(import_module(BENCHES[name]).measure)


def test_a_table_shows_every_row() -> None:
    """A person sees the name, the figure and what it is compared with."""
    text = table({"device": "x", "rows": [vars(Row("reads", 5.0, "ns", "a copy", 2.0))]})
    assert "reads" in text
    assert "2.00 x a copy" in text


def test_the_ratio_is_taken_round_by_round() -> None:
    """Drift that hits both sides of a round cancels."""
    assert median_ratio([1.0, 10.0, 100.0], [2.0, 20.0, 200.0]) == 0.5
