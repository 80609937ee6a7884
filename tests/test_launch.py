"""A gather kernel split over CPU threads writes the same bits as one launch."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import warp as wp

import terrasim as ts
from terrasim.grid import Grid
from terrasim.kernels.sample import sample_surface
from terrasim.launch import SMALLEST_PART, launch
from terrasim.terrain import lattice_of

CPU = wp.get_device("cpu")
TYPES = (wp.float64, wp.vec3d, wp.float64, wp.uint8, wp.float64, wp.uint8)


def answers(count: int, threads: int) -> list[Any]:
    """Answers of the widest query to the same points, in arrays that were all 9 before."""
    random = np.random.default_rng(0)
    posts = random.integers(-(10**7), 10**7, (200, 220), dtype=np.int32)
    grid = Grid(200, 220, 1.0)
    points = np.random.default_rng(1).uniform(-20.0, 240.0, (count, 2))
    with ts.Terrain(ts.ArraySource(posts, grid)) as terrain:
        shared = [terrain.pool, terrain.resident, terrain.error, lattice_of(grid), 0, terrain.used]
        outputs: list[Any] = [wp.full(count, 9.0, dtype=t, device=CPU) for t in TYPES[:3]]
        outputs += [wp.full(count, 9, dtype=t, device=CPU) for t in TYPES[3:]]
        asked: Any = wp.array(points, dtype=wp.vec2d, device=CPU)
        launch(
            sample_surface,
            count,
            shared=shared,
            items=[asked, *outputs],
            device=CPU,
            threads=threads,
        )
    return [array.numpy().copy() for array in outputs]


@pytest.mark.parametrize("threads", [2, 3, 7])
@pytest.mark.parametrize("count", [1, SMALLEST_PART, SMALLEST_PART + 1, 10_007])
def test_the_parts_together_are_the_whole(count: int, threads: int) -> None:
    for one, many in zip(answers(count, 1), answers(count, threads), strict=True):
        assert one.tobytes() == many.tobytes()


def test_no_items_are_no_launch() -> None:
    def never(*_: Any) -> None:
        raise AssertionError

    launch(never, 0, shared=[], items=[], device=CPU)


def test_parts_are_not_smaller_than_they_are_worth(monkeypatch: pytest.MonkeyPatch) -> None:
    sizes: list[int] = []
    plain = wp.launch

    def counted(kernel: Any, dim: int, **rest: Any) -> None:
        sizes.append(dim)
        plain(kernel, dim=dim, **rest)

    monkeypatch.setattr(wp, "launch", counted)
    answers(SMALLEST_PART, 4)
    assert sizes == [SMALLEST_PART]
    sizes.clear()
    answers(4 * SMALLEST_PART, 3)
    assert sum(sizes) == 4 * SMALLEST_PART
    assert len(sizes) == 3
    assert max(sizes) - min(sizes) <= 1


def test_an_error_in_a_part_is_raised(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = wp.launch

    def failing(kernel: Any, dim: int, **rest: Any) -> None:
        raise RuntimeError("no more memory")

    monkeypatch.setattr(wp, "launch", failing)
    with pytest.raises(RuntimeError, match="no more memory"):
        answers(5000, 3)
    monkeypatch.setattr(wp, "launch", plain)
    answers(5000, 3)
