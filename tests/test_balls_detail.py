"""Balls over base and detail: as over dense ground of the same heights, over every border."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from detail_ground import base_between, dense_ground, detailed_ground, put_detail

from terrasim.balls.balls import Balls, step, totals
from terrasim.counts import COUNT_M, HOLE, Counts
from terrasim.grid import Grid
from terrasim.query import sample
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

G = 9.81
Table = npt.NDArray[np.float64]


def run(terrain: Terrain, balls: Balls, dt: float, steps: int) -> None:
    for _ in range(steps):
        step(terrain, balls, dt)


def state(balls: Balls) -> bytes:
    """Everything that moves, without the cells."""
    return b"".join(a.numpy().tobytes() for a in (balls.offset, balls.z, balls.velocity))


def random_posts(rows: int, cols: int, factor: int, tall: float) -> Counts:
    """Posts of a base up to ``tall`` metres high, all of them multiples of ``factor``."""
    rng = np.random.default_rng(1)
    heights: Counts = rng.integers(0, int(tall * 1e5 / factor), (rows, cols), np.int32)
    return heights * np.int32(factor)


def between(base: Counts, factor: int) -> Counts:
    """The base's surface at the detail's posts [counts], of posts that are multiples."""
    total = base_between(base, factor)
    hole = total == -(2**63)
    return np.where(hole, HOLE, np.where(hole, 0, total) // factor).astype(np.int32)


def patchy(base: Counts, factor: int) -> Counts:
    """The same with squares of random heights, over borders of cells and blocks."""
    rng = np.random.default_rng(2)
    dense = between(base, factor)
    for _ in range(60):
        r, c = (int(rng.integers(-9, size - 9)) for size in dense.shape)
        part = dense[max(r, 0) : r + 18, max(c, 0) : c + 18]
        more = rng.integers(0, 8000, part.shape, np.int32)
        part[...] = np.where(part == HOLE, HOLE, part + more)
    return dense


def thrown(terrain: Terrain, count: int, friction: float) -> Balls:
    """Balls let go all over the ground and somewhat beyond its edges."""
    rng = np.random.default_rng(5)
    grid = terrain.grid
    sides = [(grid.cols - 1) * grid.spacing, (grid.rows - 1) * grid.spacing]
    place = np.column_stack([rng.uniform(-2.0, side + 2.0, count) for side in sides])
    return Balls.at(
        terrain,
        np.column_stack([place, rng.uniform(0.0, 0.5, count)]),
        rng.normal(0.0, 3.0, (count, 3)),
        radius=rng.uniform(0.02, 0.2, count),
        restitution=rng.uniform(0.0, 0.9, count),
        friction=rng.uniform(0.0, friction, count),
        anchor=(grid.row, grid.col),
        above_ground=True,
    )


def check_alike(dense: Counts, factor: int, friction: float, within: float) -> None:
    """Hold that balls move alike over base and detail and over ``dense`` as a base."""
    spacing, count, steps = 0.75, 300, 120
    found = []
    with (
        detailed_ground(dense, factor, spacing) as detailed,
        dense_ground(dense, spacing / factor) as base,
    ):
        for terrain in (detailed, base):
            balls = thrown(terrain, count, friction)
            run(terrain, balls, 1 / 120, steps)
            happened = totals(balls)
            assert happened.impacts > count
            assert happened.projected > 10
            assert happened.off > 0
            tally = balls.tally.numpy()
            counted = [tally[name] for name in ("impacts", "projected", "held", "off", "hole")]
            found.append((balls.positions(terrain), balls.velocity.numpy(), np.array(counted)))
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=0, atol=within)
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=0, atol=10 * within)
    np.testing.assert_array_equal(found[0][2], found[1][2])


@pytest.mark.parametrize("factor", [2, 3, 8])
def test_balls_move_as_over_dense_ground_of_the_same_heights(factor: int) -> None:
    """From ground without detail onto such with it and back, and beyond the terrain's edges.

    Without friction a step is exact, however many edges divide it: what remains is rounding of
    places some 100 m from the anchor, 1.4e-14 m, which impacts on small triangles spread.
    """
    dense = patchy(random_posts(280, 40, factor, 0.3), factor)
    check_alike(dense, factor, friction=0.0, within=1e-11)


@pytest.mark.parametrize("factor", [2, 3])
def test_holes_in_the_base_are_holes_in_its_detail(factor: int) -> None:
    base = random_posts(280, 40, factor, 0.3)
    base[np.random.default_rng(3).random(base.shape) < 0.02] = HOLE
    check_alike(patchy(base, factor), factor, friction=0.0, within=1e-11)


@pytest.mark.parametrize("factor", [2, 5])
def test_with_friction_too_where_the_triangles_are_the_same(factor: int) -> None:
    """A slide that turns is exact to first order in the time between edges.

    So it is the same where the edges are: here every cell has detail.
    """
    rng = np.random.default_rng(4)
    dense = between(random_posts(270, 40, factor, 0.3), factor)
    dense += rng.integers(0, 4000, dense.shape, np.int32)
    check_alike(dense, factor, friction=0.8, within=1e-10)


def test_a_scene_moved_by_whole_blocks_repeats_to_the_bit_on_any_number_of_threads() -> None:
    dense = patchy(random_posts(280, 40, 3, 0.3), 3)
    found = []
    for row, col, threads in ((0, 0, 1), (-2 << 20, 3 << 21, 1), (0, 0, 3)):
        with detailed_ground(dense, 3, 0.7, row, col, threads=threads) as terrain:
            balls = thrown(terrain, 300, 0.5)
            run(terrain, balls, 1 / 120, 120)
            found.append((state(balls), (balls.cell.numpy() - [row, col]).tobytes()))
    assert found[0] == found[1] == found[2]


def test_a_detail_factor_alone_changes_nothing() -> None:
    """Nor does detail elsewhere: steps without a block of it under them have the same bits."""
    base = random_posts(300, 60, 1, 0.5)
    found = []
    for factor in (None, 1, 4):
        source = ArraySource(base, Grid(base.shape[0], base.shape[1], 0.7))
        with Terrain(source, detail_factor=factor) as terrain:
            if factor == 4:
                put_detail(terrain, np.full((3, 3), 70_000, np.int32), 1150, 230)
            balls = thrown(terrain, 400, 0.5)
            # Rows from 256 on lie under a detail block that has some; none of the rest gets there.
            near = balls.cell.numpy()[:, 0] > 230
            run(terrain, balls, 1 / 120, 100)
            arrays = (balls.cell, balls.offset, balls.z, balls.velocity, balls.tally)
            found.append([array.numpy()[~near].tobytes() for array in arrays])
    assert found[0] == found[1] == found[2]


def detail_of_a_plane(rise: tuple[int, int], factor: int, size: int) -> Terrain:
    """A plane exact in counts; in its middle the base is off it, and detail makes up for that."""
    posts = size * factor + 1
    row, col = np.mgrid[0:posts, 0:posts]
    dense = (row * rise[0] + col * rise[1]).astype(np.int32)
    base = np.ascontiguousarray(dense[::factor, ::factor])
    middle = slice(size // 3, 2 * size // 3)
    rng = np.random.default_rng(6)
    base[middle, middle] += rng.integers(-500, 500, base[middle, middle].shape, np.int32)
    terrain = Terrain(
        ArraySource(base, Grid(base.shape[0], base.shape[1], 1.0)), detail_factor=factor
    )
    total = base_between(base, factor)
    put_detail(terrain, (dense.astype(np.int64) * factor - total).astype(np.int32))
    return terrain


@pytest.mark.parametrize("rise", [(0, 0), (123, -234)])
@pytest.mark.parametrize("factor", [3, 8])
def test_borders_of_detail_are_not_felt_on_a_plane(rise: tuple[int, int], factor: int) -> None:
    """Balls slide over ground with and without detail, onto it and off it, as on one plane."""
    rng = np.random.default_rng(3)
    count, time = 60, 2.0
    way = rng.uniform(0.0, 2 * np.pi, count)
    velocity = np.column_stack([np.cos(way), np.sin(way), np.zeros(count)]) * 24.0
    slope = np.array([rise[1], rise[0]]) * factor * COUNT_M
    velocity[:, 2] = velocity[:, :2] @ slope
    with detail_of_a_plane(rise, factor, 150) as terrain:
        place = np.column_stack([rng.uniform(72, 78, (count, 2)), np.zeros(count)])
        balls = Balls.at(
            terrain, place, velocity, radius=0.3, friction=0.0, restitution=0.9, above_ground=True
        )
        run(terrain, balls, 0.01, 200)
        pull = -G * slope / (1.0 + slope @ slope)
        expected = place[:, :2] + velocity[:, :2] * time + pull * time**2 / 2.0
        assert (np.abs(expected - 75.0).max(axis=1) > 27.0).all()
        np.testing.assert_allclose(balls.positions(terrain)[:, :2], expected, rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            balls.velocity.numpy()[:, :2], velocity[:, :2] + pull * time, rtol=0, atol=1e-9
        )
        assert totals(balls).impacts == totals(balls).projected == 0


def rut(factor: int, depth: int, **more: Any) -> Terrain:
    """Level ground with a rut along y, a third of a cell of the base wide."""
    base = np.zeros((12, 12), np.int32)
    terrain = Terrain(ArraySource(base, Grid(12, 12, 1.0)), detail_factor=factor, **more)
    across = np.zeros(11 * factor + 1, np.int32)
    half = factor // 6
    middle = 5 * factor + factor // 2
    for away in range(-half, half + 1):
        across[middle + away] = -depth * factor * (half - abs(away)) // half
    put_detail(terrain, np.tile(across, (11 * factor + 1, 1)))
    return terrain


def test_a_ball_comes_to_rest_in_a_rut_that_only_detail_has() -> None:
    """In the rut's line, at the height that both sides carry it, and there it stays to the bit."""
    factor, depth = 24, 4000
    with rut(factor, depth) as terrain:
        x = 5.5
        places = [[x + 0.1, 5.3, 0.05], [x - 0.08, 4.0, 0.2], [x + 0.02, 7.77, 0.0]]
        balls = Balls.at(
            terrain, places, radius=0.02, restitution=0.3, friction=0.1, above_ground=True
        )
        run(terrain, balls, 1 / 240, 1500)
        assert not balls.velocity.numpy().any()
        found = balls.positions(terrain)
        np.testing.assert_allclose(found[:, 0], x, atol=1e-3)
        slope = depth * COUNT_M / (4 / factor)
        # On one plane of the two, whichever is under the centre.
        rest = -depth * COUNT_M + np.abs(found[:, 0] - x) * slope + 0.02 * np.hypot(1.0, slope)
        np.testing.assert_allclose(found[:, 2], rest, rtol=0, atol=1e-9)
        before = state(balls)
        run(terrain, balls, 1 / 240, 100)
        assert state(balls) == before


def test_detail_that_rises_lifts_a_ball_and_detail_that_is_dug_lets_it_fall() -> None:
    base = np.full((300, 300), 12_345, np.int32)
    with Terrain(ArraySource(base, Grid(300, 300, 1.0)), detail_factor=4) as terrain:
        place = [[10.3, 10.4, 0.0], [256.2, 100.6, 0.0], [100.0, 100.0, 0.0]]
        balls = Balls.at(terrain, place, radius=0.1, restitution=0.0, above_ground=True)
        run(terrain, balls, 0.01, 3)
        at_rest = balls.z.numpy().copy()
        put_detail(terrain, np.full((9, 9), 4 * 5_000, np.int32), 37, 37)
        put_detail(terrain, np.full((9, 9), -4 * 5_000, np.int32), 398, 1020)
        step(terrain, balls, 0.01)
        assert balls.z.numpy()[0] == at_rest[0] + 0.05
        assert at_rest[1] - 0.01 < balls.z.numpy()[1] < at_rest[1]
        assert balls.z.numpy()[2] == at_rest[2]
        assert balls.tally.numpy()["projected"].tolist() == [1, 0, 0]
        run(terrain, balls, 0.01, 50)
        np.testing.assert_allclose(balls.z.numpy() - at_rest, [0.05, -0.05, 0.0], atol=1e-12)


def test_no_step_ends_below_the_ground_on_fine_detail() -> None:
    """Sixty-four detail cells a cell, a thousandth of a ball's way each, over a block's border."""
    factor = 64
    base = random_posts(270, 20, 1, 0.2)
    rng = np.random.default_rng(8)
    with Terrain(
        ArraySource(base, Grid(base.shape[0], base.shape[1], 1.0)), detail_factor=factor
    ) as terrain:
        patch = rng.integers(-200 * factor, 200 * factor, (8 * factor, 8 * factor), np.int32)
        put_detail(terrain, patch, 252 * factor, 6 * factor)
        place = np.column_stack(
            [rng.uniform(7, 13, 200), rng.uniform(253, 259, 200), rng.uniform(0, 0.3, 200)]
        )
        balls = Balls.at(
            terrain,
            place,
            rng.normal(0.0, 2.0, (200, 3)),
            radius=0.05,
            restitution=0.5,
            friction=0.1,
            above_ground=True,
        )
        for _ in range(60):
            step(terrain, balls, 1 / 120)
            at = balls.positions(terrain)
            clear = at[:, 2] - sample(terrain, at[:, :2]).height
            # Slopes reach 4 m in a detail cell of 1/64 m: rounding of x counts for so much in z.
            assert clear.min() >= 0.05 - 1e-9
        assert totals(balls).impacts > 200


def test_a_fast_ball_is_not_held_up_by_the_number_of_detail_cells() -> None:
    """Flight is exact over thousands of detail cells a step, met on the way from plain ground."""
    factor = 128
    base = np.zeros((40, 40), np.int32)
    with Terrain(ArraySource(base, Grid(40, 40, 1.0)), detail_factor=factor) as terrain:
        put_detail(terrain, np.ones((20 * factor, 39 * factor), np.int32), 10 * factor, 0)
        start, speed = np.array([[2.3, 1.1, 50.0]]), np.array([[60.0, 70.0, 0.0]])
        balls = Balls.at(terrain, start, speed, radius=0.1)
        step(terrain, balls, 0.5)
        expected = start + speed * 0.5 - [[0.0, 0.0, G / 8.0]]
        np.testing.assert_allclose(balls.positions(terrain), expected, rtol=0, atol=1e-11)
        assert totals(balls).held == 0


def test_a_ball_wedged_between_plain_ground_and_detail_feels_every_detail_cell() -> None:
    """It slides down a valley whose one side is a cell, the other detail of many slopes.

    A step begins a bit beside the valley's line, and the time back to it is as the root of a bit.
    """
    factor, spacing = 4, 1.0
    row, col = np.mgrid[0 : 40 * factor + 1, 0 : 70 * factor + 1]
    # Where a block of detail ends: the one after it has none.
    middle = 64 * factor
    dense = (20_000 * np.abs(col - middle) - 6_000 * row).astype(np.int32)
    # Each row of detail cells on the west side rises in its own way; the edge itself is straight.
    steep = np.random.default_rng(7).integers(0, 8_000, (40 * factor + 1, 1))
    dense += np.where(col < middle, steep, 0).astype(np.int32)
    places = [[64.0 + 1e-9 * k, 1.0 + k / 3, 0.0] for k in range(1, 9)]
    found = []
    with (
        detailed_ground(dense, factor, spacing) as detailed,
        dense_ground(dense, spacing / factor) as base,
    ):
        for terrain in (detailed, base):
            balls = Balls.at(
                terrain, places, radius=0.02, restitution=0.0, friction=0.05, above_ground=True
            )
            run(terrain, balls, 1 / 10, 20)
            found.append((balls.positions(terrain), balls.velocity.numpy()))
    assert (found[0][0][:, 1] > np.array(places)[:, 1] + 3.0).any()
    np.testing.assert_allclose(found[0][0], found[1][0], rtol=0, atol=1e-6)
    np.testing.assert_allclose(found[0][1], found[1][1], rtol=0, atol=1e-6)
