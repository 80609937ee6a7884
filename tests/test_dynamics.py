"""Shocks and growing stamps on the ground: exact totals, exact ledgers, exact ends."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from terrasim.counts import COUNT_M, HOLE, MAX_COUNT
from terrasim.deform.apply import apply_stamps
from terrasim.deform.dynamics import Dynamic, advance_dynamics, end_dynamics
from terrasim.deform.growth import Growth, RunningGrowth
from terrasim.deform.ledger import Ledger
from terrasim.deform.profiles import Smoothstep
from terrasim.deform.shock import RunningShock, Shock
from terrasim.deform.stamps import (
    ConeStamp,
    Crater,
    Gaussian,
    HeightImage,
    Noise,
    Stamp,
    Texture,
    Trench,
)
from terrasim.deform.target import target_of
from terrasim.errors import InputError, RunError
from terrasim.grid import Grid
from terrasim.output.window import read_window
from terrasim.scenario.fingerprint import hash_heights
from terrasim.sources.analytic import Flat, Sine
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

GRID = Grid(600, 600, spacing=0.5, row=-100, col=200)
ANCHOR = (200, 500)
WAVY = Sine(GRID, amplitude=4.0, wavelength=64.0, wavelength_y=48.0)
HILL = Gaussian(1.3, -2.1, amplitude=1.5, sigma=4.0)
SHOCK = Shock(
    0.0, 0.0, 100.0, 90.0, 10.0, 4.0, damping_1_s=0.1, displacement=HILL,
    velocity=Gaussian(-9.0, 5.0, amplitude=6.0, sigma=3.0),
)  # fmt: skip
GROWTH = Growth(HILL, 2.0, Smoothstep())
EVERY = pytest.mark.parametrize("what", [SHOCK, GROWTH], ids=["shock", "growth"])


def running(what: Shock | Growth, terrain: Terrain, anchor: tuple[int, int] = ANCHOR) -> Any:
    """Something that changes a terrain over time."""
    kind: Any = RunningShock if isinstance(what, Shock) else RunningGrowth
    target = target_of(terrain, detail=what.detail)
    return kind(what, target, anchor, threads=terrain.threads)


def resumed(what: Shock | Growth, terrain: Terrain, state: dict[str, Any]) -> Any:
    """The same from its state."""
    kind: Any = RunningShock if isinstance(what, Shock) else RunningGrowth
    return kind.from_state(state, what, target_of(terrain, detail=what.detail), ANCHOR)


def posts(terrain: Terrain, level: int = 0) -> npt.NDArray[np.int64]:
    """All posts of a level."""
    return read_window(terrain, level, terrain.grid.posts(level)).astype(np.int64)


def untouched(terrain: Terrain) -> bool:
    """Whether every post of every level is what its source says."""
    for level in range(terrain.grid.levels):
        span = terrain.grid.posts(level)
        rows, cols = np.arange(span.row0, span.row1), np.arange(span.col0, span.col1)
        if not np.array_equal(posts(terrain, level), terrain.source.posts(level, rows, cols)):
            return False
    return True


def run_out(terrain: Terrain, one: Dynamic, dt_s: float) -> Ledger:
    """Let something go on to its end."""
    ledger = advance_dynamics(terrain, [one], 0.0)
    while not one.done:
        ledger += advance_dynamics(terrain, [one], dt_s)
    return ledger


@EVERY
def test_the_ledger_is_the_difference_of_the_heights(what: Any) -> None:
    """After every step, exactly; frozen ground keeps all of it and no more."""
    with Terrain(WAVY) as terrain:
        before = posts(terrain).sum()
        one = running(what, terrain)
        ledger = advance_dynamics(terrain, [one], 0.0)
        for _ in range(12):
            ledger += advance_dynamics(terrain, [one], 0.02)
            assert ledger.net == posts(terrain).sum() - before
            assert ledger.net == one.given.counts.sum(dtype=np.int64)
        ledger += end_dynamics(terrain, [one], "freeze")
        assert ledger.net == posts(terrain).sum() - before != 0
        assert ledger.clamped == ledger.holes == 0


def test_a_frozen_shock_leaves_the_volume_of_its_wave() -> None:
    """The mean of the wave over its rectangle, but for half a count a post."""
    with Terrain(WAVY) as terrain:
        one = running(SHOCK, terrain)
        ledger = run_out(terrain, one, 0.025)
        assert ledger.net == one.given.counts.sum(dtype=np.int64)
        wave = one.displacement
        rounded = COUNT_M * math.sqrt(wave.size)
        assert ledger.net * COUNT_M == pytest.approx(wave.sum(), abs=3.0 * rounded)
        volume = ledger.volume(GRID.spacing)
        assert volume == pytest.approx(wave.mean() * wave.size * GRID.spacing**2, rel=1e-4)


@EVERY
def test_what_vanishes_leaves_the_ground_it_found(what: Any) -> None:
    """Every post of every level, to the bit, at its end and on the way."""
    with Terrain(WAVY) as terrain:
        for end_s in (0.2, what.duration_s):
            one = running(what, terrain)
            ledger = advance_dynamics(terrain, [one], 0.0)
            while one.clock.time_s < end_s:
                ledger += advance_dynamics(terrain, [one], 0.025)
            assert not untouched(terrain)
            ledger += end_dynamics(terrain, [one], "vanish")
            assert one.done
            assert ledger.net == 0
            assert untouched(terrain)


@EVERY
def test_stamps_added_meanwhile_stay(what: Any) -> None:
    with Terrain(WAVY) as terrain, Terrain(WAVY) as other:
        crater = Crater(3.0, 1.0, radius=6.0, depth=1.0, rim_height=0.2)
        one = running(what, terrain)
        advance_dynamics(terrain, [one], 0.5 if what is GROWTH else 0.02)
        apply_stamps(terrain, [crater], anchor=ANCHOR)
        advance_dynamics(terrain, [one], 0.02)
        end_dynamics(terrain, [one], "vanish")
        apply_stamps(other, [crater], anchor=ANCHOR)
        np.testing.assert_array_equal(posts(terrain), posts(other))


IMAGE = HeightImage(np.random.default_rng(0).random((9, 11)))


@pytest.mark.parametrize(
    "stamp",
    [
        HILL,
        Crater(0.3, 1.0, radius=20.0, depth=3.0, rim_height=1.0),
        ConeStamp(-4.2, 3.0, radius=15.0, height=-2.0),
        Noise(2.0, 2.0, amplitude=0.7, wavelength=5.0, radius=20.0),
        Trench(0.0, 0.0, points=((-9.0, 1.0), (9.0, 4.0)), depth=1.0, width=4.0),
        Texture(1.0, 1.0, image=IMAGE, size_x=30.0, size_y=20.0, turn_deg=30.0),
        Gaussian(-145.0, 120.0, amplitude=3.0, sigma=9.0),
    ],
    ids=lambda stamp: stamp.name,
)
def test_a_stamp_grown_whole_is_the_stamp_applied(stamp: Stamp) -> None:
    """To the bit, every level and bound: also one that the terrain's edge cuts."""
    with Terrain(WAVY) as grown, Terrain(WAVY) as applied:
        one = running(Growth(stamp, 1.0), grown)
        ledger = advance_dynamics(grown, [one], 1.0)
        expected = apply_stamps(applied, [stamp], anchor=ANCHOR)
        assert hash_heights(grown) == hash_heights(applied)
        assert (ledger.added, ledger.removed) == (expected.added, expected.removed)


def test_slow_growth_loses_nothing() -> None:
    """A thousandth of a count a step: the total is rounded, never its change."""
    low = Growth(ConeStamp(0.0, 0.0, radius=8.0, height=2e-5), 2.0)
    with Terrain(WAVY) as terrain, Terrain(WAVY) as other:
        one = running(low, terrain)
        patches = sum(one.advance(1e-3) is not None for _ in range(2000))
        assert one.done
        assert 2 < patches < 200
        run_out(other, same := running(low, other), 1.0)
        np.testing.assert_array_equal(one.given.counts, same.given.counts)
        assert one.given.counts.max() == 2


@EVERY
def test_nothing_beyond_its_posts_changes(what: Any) -> None:
    """And no block that it does not reach is brought in."""
    with Terrain(WAVY) as terrain:
        before = posts(terrain)
        one = running(what, terrain)
        run_out(terrain, one, 0.025)
        changed = np.argwhere(posts(terrain) != before) + np.array([GRID.row, GRID.col])
        span = one.given.span
        assert (changed >= [span.row0, span.col0]).all()
        assert (changed < [span.row1, span.col1]).all()


def test_a_patch_holds_no_more_than_changes() -> None:
    with Terrain(WAVY) as terrain:
        one = running(Shock(0.0, 0.0, 200.0, 200.0, 5.0, 9.0, displacement=HILL), terrain)
        patch = one.advance(0.0)
        assert patch is not None
        assert patch.counts.shape < (100, 100)
        for edge in (patch.counts[0], patch.counts[-1], patch.counts[:, 0], patch.counts[:, -1]):
            assert edge.any()
        assert one.advance(0.0) is None


@pytest.mark.parametrize("sign", [1, -1])
@EVERY
def test_ground_at_the_end_of_its_range_gives_back_only_what_it_took(what: Any, sign: int) -> None:
    """It is counted as clamped, and what vanishes leaves the ground it found all the same."""
    near = sign * (MAX_COUNT - 30_000) * COUNT_M
    hill = Gaussian(1.3, -2.1, amplitude=1.5 * sign, sigma=4.0)
    which = {"stamp": hill} if what is GROWTH else {"displacement": hill, "velocity": None}
    what = replace(what, **which)
    with Terrain(Flat(GRID, height=near)) as terrain:
        before = posts(terrain).sum()
        one = running(what, terrain)
        ledger = advance_dynamics(terrain, [one], 0.0)
        for _ in range(30):
            ledger += advance_dynamics(terrain, [one], 0.03)
        assert ledger.clamped > 0
        assert np.abs(posts(terrain)).max() == MAX_COUNT
        assert ledger.net == posts(terrain).sum() - before
        assert one.given.counts.sum(dtype=np.int64) == ledger.net
        ledger += end_dynamics(terrain, [one], "vanish")
        assert ledger.net == 0
        assert untouched(terrain)


@EVERY
def test_holes_stay_holes(what: Any) -> None:
    heights = np.random.default_rng(1).random((300, 300)) * 3.0
    heights[140:160, 130:171] = np.nan
    source = ArraySource.from_metres(heights, spacing=0.5)
    with Terrain(source) as terrain:
        one = running(what, terrain, (150, 150))
        ledger = advance_dynamics(terrain, [one], 0.03)
        ledger += advance_dynamics(terrain, [one], 0.02)
        assert ledger.holes > 0
        assert (posts(terrain)[140:160, 130:171] == HOLE).all()
        end_dynamics(terrain, [one], "vanish")
        assert untouched(terrain)


@EVERY
def test_it_goes_on_from_its_state_to_the_bit(what: Any) -> None:
    with Terrain(WAVY) as terrain, Terrain(WAVY) as other:
        one, two = running(what, terrain), running(what, other)
        for _ in range(10):
            advance_dynamics(terrain, [one], 0.03)
            advance_dynamics(other, [two], 0.03)
        two = resumed(what, other, {name: part.copy() for name, part in two.state().items()})
        for _ in range(10):
            advance_dynamics(terrain, [one], 0.03)
            advance_dynamics(other, [two], 0.03)
        assert hash_heights(terrain) == hash_heights(other)
        assert one.summary() == two.summary()
        for name, part in one.state().items():
            np.testing.assert_array_equal(part, two.state()[name])
        np.testing.assert_array_equal(one.speed, two.speed)


@EVERY
def test_a_state_of_something_else_is_refused(what: Any) -> None:
    with Terrain(WAVY) as terrain:
        state = running(what, terrain).state()
        short = state | {"given": state["given"][1:]}
        with pytest.raises(InputError, match="given must be int32 of shape"):
            resumed(what, terrain, short)
        with pytest.raises(InputError, match="steps is missing from its state"):
            resumed(what, terrain, {name: state[name] for name in state if name != "steps"})
        with pytest.raises(InputError, match="clock must be finite"):
            resumed(what, terrain, state | {"clock": state["clock"] * math.nan})


@EVERY
def test_threads_and_pools_change_no_bit(what: Any) -> None:
    hashes = set()
    for threads, pool_bytes in ((1, 64 << 20), (3, 64 << 20), (2, 8 << 18)):
        with Terrain(WAVY, threads=threads, pool_bytes=pool_bytes) as terrain:
            run_out(terrain, running(what, terrain), 0.03)
            hashes.add(hash_heights(terrain))
    assert len(hashes) == 1


@EVERY
def test_time_stops_at_its_end(what: Any) -> None:
    """However the steps are cut: the last is shorter, and later ones change nothing."""
    with Terrain(WAVY) as terrain:
        one = running(what, terrain)
        run_out(terrain, one, 0.023)
        assert one.clock.time_s == what.duration_s
        assert one.advance(0.01) is None
        assert not one.speed.any()
        tenths = running(Growth(HILL, 0.3), terrain)
        for _ in range(3):
            tenths.advance(0.1)
        assert tenths.done


@EVERY
def test_the_speed_of_the_ground_is_that_of_its_heights(what: Any) -> None:
    with Terrain(WAVY) as terrain:
        one = running(what, terrain)
        for _ in range(40):
            one.advance(0.01)
        before = one.given.counts.astype(np.int64)
        one.advance(0.01)
        speed = one.speed
        one.advance(0.01)
        moved = (one.given.counts - before) * COUNT_M / 0.02
        # Two totals are rounded; the rest is the third derivative in time.
        np.testing.assert_allclose(speed, moved, atol=COUNT_M / 0.02 + 0.02 * np.abs(moved).max())


def test_a_shock_says_what_became_of_it() -> None:
    with Terrain(WAVY) as terrain:
        free = Shock(0.0, 0.0, 90.0, 90.0, 12.0, 2.0, displacement=HILL)
        one = running(free, terrain)
        run_out(terrain, one, 0.025)
        said = one.summary()
        assert said["steps"] == 80
        assert said["courant"] == pytest.approx(12.0 * 0.025 / 0.5)
        assert said["energy_start_m4_s2"] > 0.0
        assert said["energy_end_m4_s2"] == pytest.approx(said["energy_start_m4_s2"], rel=1e-11)


def test_a_velocity_of_no_mean_leaves_the_mean_height() -> None:
    push = Gaussian(0.0, 0.0, amplitude=6.0, sigma=3.0)
    for zero_mean in (True, False):
        shock = Shock(0.0, 0.0, 90.0, 90.0, 12.0, 2.0, velocity=push, zero_mean=zero_mean)
        with Terrain(WAVY) as terrain:
            one = running(shock, terrain)
            run_out(terrain, one, 0.025)
            assert (abs(one.displacement.mean()) < 1e-12) == zero_mean


def test_two_at_once_add_up() -> None:
    """In any order, for each adds its own total."""
    hashes = set()
    for order in (1, -1):
        with Terrain(WAVY) as terrain:
            several = [running(SHOCK, terrain), running(GROWTH, terrain)][::order]
            for _ in range(10):
                advance_dynamics(terrain, several, 0.03)
            hashes.add(hash_heights(terrain))
    assert len(hashes) == 1


def test_the_largest_step_is_named_and_nothing_is_changed() -> None:
    with Terrain(WAVY) as terrain:
        one = running(SHOCK, terrain)
        limit = 0.5 / (10.0 * math.sqrt(2.0))
        advance_dynamics(terrain, [one], 0.99 * limit)
        before = one.state()
        with pytest.raises(InputError, match=rf"shock: a step of .* limit of {limit:.6g} s"):
            advance_dynamics(terrain, [one], 1.01 * limit)
        for name, part in one.state().items():
            np.testing.assert_array_equal(part, before[name])


def test_a_wave_that_leaves_the_range_of_heights_fails_the_run() -> None:
    """It says so before it changes the ground, and what was given can still be taken back."""
    push = Gaussian(0.0, 0.0, amplitude=20_000.0, sigma=30.0)
    with Terrain(WAVY) as terrain:
        one = running(Shock(0.0, 0.0, 90.0, 90.0, 10.0, 9.0, velocity=push), terrain)
        with pytest.raises(RunError, match=r"shock: a (height|change at once) of .* counts"):
            run_out(terrain, one, 0.03)
        end_dynamics(terrain, [one], "vanish")
        assert untouched(terrain)
