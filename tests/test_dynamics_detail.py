"""Shocks and growing stamps on the detail grid."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.counts import COUNT_M, MAX_COUNT
from terrasim.deform.apply import apply_stamps
from terrasim.deform.dynamics import advance_dynamics, end_dynamics
from terrasim.deform.growth import Growth, RunningGrowth
from terrasim.deform.profiles import Smoothstep
from terrasim.deform.shock import RunningShock, Shock
from terrasim.deform.stamps import Crater, Gaussian
from terrasim.deform.target import target_of
from terrasim.deform.window import read_window
from terrasim.grid import Grid
from terrasim.sources.analytic import Sine
from terrasim.terrain import Terrain

FACTOR = 8
GRID = Grid(300, 300, spacing=0.5, row=-100, col=70)
WAVY = Sine(GRID, amplitude=4.0, wavelength=64.0, wavelength_y=48.0)
# Four blocks of level 0 meet here.
ANCHOR = (0, 256)
HILL = Gaussian(0.4, -0.1, amplitude=0.2, sigma=0.6, detail=True)
SHOCK = Shock(0.0, 0.0, 12.0, 10.0, 5.0, 0.4, displacement=HILL, detail=True)
GROWTH = Growth(HILL, 0.4, Smoothstep())
EVERY = pytest.mark.parametrize("what", [SHOCK, GROWTH], ids=["shock", "growth"])


def fine(**more: Any) -> Terrain:
    """Ground with detail."""
    return Terrain(WAVY, detail_factor=FACTOR, **more)


def running(what: Shock | Growth, terrain: Terrain) -> Any:
    """Something that changes the detail of a terrain over time."""
    kind: Any = RunningShock if isinstance(what, Shock) else RunningGrowth
    return kind(what, target_of(terrain, detail=True), ANCHOR, threads=terrain.threads)


def totals(terrain: Terrain) -> npt.NDArray[np.int64]:
    """Base and detail around the anchor [counts / factor]."""
    row = (ANCHOR[0] - terrain.detail.row0) * FACTOR
    col = (ANCHOR[1] - terrain.detail.col0) * FACTOR
    return read_window(terrain, row - 150, col - 150, 300, 300, detail=True)


@EVERY
def test_the_ledger_is_the_difference_of_the_heights(what: Any) -> None:
    """In parts of a count that a detail post stands for; what vanishes leaves nothing."""
    with fine() as terrain:
        before = totals(terrain)
        one = running(what, terrain)
        ledger = advance_dynamics(terrain, [one], 0.0)
        while not one.done:
            ledger += advance_dynamics(terrain, [one], 0.008)
            if one.clock.time_s < 0.05:
                assert ledger.net == (totals(terrain) - before).sum()
        assert ledger.unit == FACTOR**3
        assert ledger.net == (totals(terrain) - before).sum() != 0
        base = read_window(terrain, GRID.row, GRID.col, GRID.rows, GRID.cols)
        rows, cols = np.arange(GRID.rows) + GRID.row, np.arange(GRID.cols) + GRID.col
        np.testing.assert_array_equal(base, WAVY.posts(0, rows, cols))
        ledger += end_dynamics(terrain, [one], "vanish")
        assert ledger.net == 0
        np.testing.assert_array_equal(totals(terrain), before)


@pytest.mark.parametrize(
    "stamp",
    [HILL, Crater(0.4, 0.3, radius=1.5, depth=0.3, rim_height=0.1, detail=True)],
    ids=lambda stamp: stamp.name,
)
def test_a_stamp_grown_whole_is_the_stamp_applied(stamp: Any) -> None:
    with fine() as grown, fine() as applied:
        one = running(Growth(stamp, 0.4, Smoothstep()), grown)
        ledger = advance_dynamics(grown, [one], 0.1)
        ledger += advance_dynamics(grown, [one], 0.3)
        expected = apply_stamps(applied, [stamp], anchor=ANCHOR)
        np.testing.assert_array_equal(totals(grown), totals(applied))
        assert (ledger.net, ledger.unit) == (expected.net, expected.unit)


@EVERY
def test_differences_at_the_end_of_their_range_give_back_only_what_they_took(what: Any) -> None:
    near = (MAX_COUNT - 50_000) * COUNT_M / FACTOR
    # Its top is a detail post.
    mound = replace(HILL, x=0.375, y=-0.125, amplitude=near)
    with fine() as terrain:
        apply_stamps(terrain, [mound], anchor=ANCHOR)
        before = totals(terrain)
        one = running(what, terrain)
        ledger = advance_dynamics(terrain, [one], 0.0)
        for _ in range(50):
            ledger += advance_dynamics(terrain, [one], 0.008)
        assert ledger.clamped > 0
        ledger += end_dynamics(terrain, [one], "vanish")
        np.testing.assert_array_equal(totals(terrain), before)
        assert ledger.net == 0


def test_pools_and_threads_change_no_bit() -> None:
    found = []
    for more in ({}, {"threads": 3, "pool_bytes": 8 << 18, "detail_pool_bytes": 12 << 18}):
        with fine(**more) as terrain:
            several = [running(SHOCK, terrain), running(GROWTH, terrain)]
            for _ in range(20):
                advance_dynamics(terrain, several, 0.008)
            found.append(totals(terrain))
    np.testing.assert_array_equal(found[0], found[1])
