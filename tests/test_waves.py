"""The wave against its dispersion relation, exact modes, conserved quantities and its symmetry."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
import warp as wp

from terrasim.deform import waves
from terrasim.deform.waves import COURANT_LIMIT, Wave, laplace, wave_bytes
from terrasim.errors import InputError
from terrasim.scenario.device_memory import counted_memory

Field = npt.NDArray[np.float64]


def mode(rows: int, cols: int, m: int, n: int) -> Field:
    """A standing mode of a box whose edges lie half a spacing beyond its posts."""
    along = np.cos(m * np.pi * (np.arange(rows) + 0.5) / rows)
    across = np.cos(n * np.pi * (np.arange(cols) + 0.5) / cols)
    field: Field = along[:, None] * across[None, :]
    return field


def still(field: Field, spacing: float = 1.0, speed_m_s: float = 1.0, **more: Any) -> Wave:
    """A wave that begins at rest."""
    return Wave(field, np.zeros_like(field), spacing, speed_m_s=speed_m_s, **more)


def rough(rows: int, cols: int, seed: int = 0) -> Field:
    """Heights without any smoothness: every mode there is."""
    return np.random.default_rng(seed).standard_normal((rows, cols))


def amplitudes(wave: Wave, shape: Field, dt_s: float, steps: int) -> Field:
    """How much of a mode the wave holds, at the start and after each step."""
    found = [np.vdot(wave.displacement, shape)]
    for _ in range(steps):
        wave.advance(dt_s)
        found.append(np.vdot(wave.displacement, shape))
    part: Field = np.array(found) / np.vdot(shape, shape)
    return part


@pytest.mark.parametrize(
    ("courant", "rows", "m", "cols", "n", "speed"),
    [
        (0.4, 8, 0, 160, 20, 0.99460),
        (0.4, 160, 20, 8, 0, 0.99460),
        (0.704, 8, 0, 160, 20, 0.99674),
        # 16 posts a wavelength along the diagonal are 16 sqrt 2 along each axis: 181 / 16 of half.
        (0.4, 181, 16, 181, 16, 0.99781),
        (0.704, 181, 16, 181, 16, 0.99997),
    ],
)
def test_a_wave_runs_as_fast_as_the_scheme_s_dispersion_relation_says(
    courant: float, rows: int, m: int, cols: int, n: int, speed: float
) -> None:
    """The bar is 1e-4, at 16 posts a wavelength, along an axis and the diagonal."""
    shape = mode(rows, cols, m, n)
    found = amplitudes(still(shape), shape, courant, 60)
    # The frequency from the recurrence that a cosine obeys, over all steps.
    cosine = np.vdot(found[2:] + found[:-2], found[1:-1]) / (
        2.0 * np.vdot(found[1:-1], found[1:-1])
    )
    omega = math.acos(float(cosine)) / courant
    ky, kx = m * np.pi / rows, n * np.pi / cols
    squares = math.sin(kx / 2.0) ** 2 + math.sin(ky / 2.0) ** 2
    assert math.sin(omega * courant / 2.0) ** 2 == pytest.approx(courant**2 * squares, rel=1e-9)
    assert omega / math.hypot(kx, ky) == pytest.approx(speed, abs=2e-5)


def test_it_is_stable_at_a_hundredth_below_the_limit() -> None:
    """A random start holds the mode that grows first."""
    spacing, speed = 0.05, 2.0
    dt_s = 0.99 * COURANT_LIMIT * spacing / speed
    assert dt_s == pytest.approx(0.99 * 17.68e-3, rel=1e-3)
    wave = still(rough(40, 50), spacing, speed)
    highest = np.abs(wave.displacement).max()
    wave.advance(4000 * dt_s, 4000)
    assert wave.steps == 4000
    assert wave.courant == pytest.approx(0.99 * COURANT_LIMIT)
    assert np.abs(wave.displacement).max() < 3.0 * highest


def test_a_hundredth_over_the_limit_it_is_refused_and_would_diverge(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    wave = still(rough(40, 50), 0.05, 2.0)
    dt_s = 1.01 * COURANT_LIMIT * 0.05 / 2.0
    before = wave.displacement
    with pytest.raises(InputError, match=r"limit of 0\.0176777 s .* take at least 2 substeps"):
        wave.advance(dt_s)
    np.testing.assert_array_equal(wave.displacement, before)
    wave.advance(dt_s, 2)
    monkeypatch.setattr(waves, "COURANT_LIMIT", 1.0)
    wave.advance(400 * dt_s, 400)
    assert np.abs(wave.displacement).max() > 1e6


def test_a_standing_mode_is_right_to_second_order() -> None:
    """After one period, of displacement and velocity: the phase is behind by O(dx^2)."""
    errors = []
    for posts in (24, 48, 96):
        shape = mode(posts, posts, 2, 3)
        omega = math.pi * math.hypot(2.0, 3.0)
        wave = Wave(shape, omega * shape, 1.0 / posts, speed_m_s=1.0)
        steps = 2 * posts
        wave.advance(2.0 * math.pi / omega, steps)
        moved = np.abs(wave.displacement - shape).max()
        turned = np.abs(wave.velocity / omega - shape).max()
        errors.append(max(moved, turned))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 2.0, atol=0.1)


def test_energy_stays_without_damping() -> None:
    """To rounding, also where every mode runs; the plain energy alone swings with the step."""
    dt_s = 0.9 * COURANT_LIMIT * 0.5 / 3.0
    wave = Wave(rough(60, 70), rough(60, 70, 1), 0.5, speed_m_s=3.0)
    first, plain = wave.energy(dt_s), wave.energy()
    swing = 0.0
    for _ in range(20):
        wave.advance(50 * dt_s, 50)
        assert wave.energy(dt_s) == pytest.approx(first, rel=1e-13)
        swing = max(swing, abs(wave.energy() / plain - 1.0))
    assert swing > 1e-3


def test_damping_lets_the_amplitude_fall_exponentially() -> None:
    """exp(gamma t) times a damped mode is an undamped one: its size stays, to rounding."""
    gamma, dt_s = 0.03, 0.5
    shape = mode(16, 80, 0, 5)
    times = dt_s * np.arange(301)
    freed = amplitudes(still(shape, damping_1_s=gamma), shape, dt_s, 300) * np.exp(gamma * times)
    cosine = (freed[2] + freed[0]) / (2.0 * freed[1])
    np.testing.assert_allclose(freed[2:] + freed[:-2], 2.0 * cosine * freed[1:-1], atol=1e-12)
    size = freed[1:] ** 2 + freed[:-1] ** 2 - 2.0 * cosine * freed[1:] * freed[:-1]
    np.testing.assert_allclose(size, size[0], rtol=1e-11)


def test_a_damped_mode_is_right_to_second_order_in_the_step() -> None:
    """Against the exact solution in time of the same differences in space."""
    gamma, end_s = 0.5, 20.0
    shape = mode(4, 32, 0, 6)
    square = (2.0 * math.sin(6.0 * np.pi / 64.0)) ** 2 - gamma**2
    swing = math.sqrt(square)
    exact = math.exp(-gamma * end_s) * (
        math.cos(swing * end_s) + gamma / swing * math.sin(swing * end_s)
    )
    errors = []
    for steps in (80, 160, 320):
        wave = still(shape, damping_1_s=gamma)
        wave.advance(end_s, steps)
        errors.append(np.abs(wave.displacement - exact * shape).max())
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    np.testing.assert_allclose(orders, 2.0, atol=0.1)


def test_a_wave_damped_past_swinging_creeps_to_rest() -> None:
    wave = still(mode(16, 80, 0, 5), damping_1_s=50.0)
    for _ in range(50):
        before = np.abs(wave.displacement).max()
        wave.advance(0.5)
        assert np.abs(wave.displacement).max() <= before


def test_the_mean_height_stays_where_the_mean_velocity_is_zero() -> None:
    """What one post gains its neighbours lose; no edge lets anything through."""
    velocity = rough(90, 110, 1)
    wave = Wave(rough(90, 110), velocity - velocity.mean(), 1.0, speed_m_s=1.0)
    mean = wave.displacement.mean()
    wave.advance(3000 * 0.7, 3000)
    assert abs(wave.displacement.mean() - mean) < 1e-12


@pytest.mark.parametrize("gamma", [0.0, 0.2])
def test_else_the_mean_height_moves_with_the_mean_velocity(gamma: float) -> None:
    velocity = rough(30, 40, 1) + 2.0
    wave = Wave(rough(30, 40), velocity, 1.0, speed_m_s=1.0, damping_1_s=gamma)
    mean = wave.displacement.mean()
    wave.advance(3.0, 300)
    seconds = -math.expm1(-2.0 * gamma * 3.0) / (2.0 * gamma) if gamma else 3.0
    # The time between velocities is a step: what damping makes of it is right to second order.
    assert wave.displacement.mean() - mean == pytest.approx(velocity.mean() * seconds, rel=1e-5)


def test_a_symmetric_wave_stays_symmetric_to_the_bit() -> None:
    """Under reflections and turns by right angles, edges included."""
    quarter = rough(71, 71)
    half = quarter + quarter[::-1]
    both = half + half[:, ::-1]
    field = both + both.T
    wave = Wave(field, 0.5 * field, 0.3, speed_m_s=2.0, damping_1_s=0.1)
    wave.advance(200 * 0.1, 200)
    for found in (wave.displacement, wave.velocity):
        np.testing.assert_array_equal(found, found[::-1])
        np.testing.assert_array_equal(found, found[:, ::-1])
        np.testing.assert_array_equal(found, found.T)
    assert np.abs(wave.displacement - field).max() > 0.1


def test_a_turned_wave_turns_to_the_bit() -> None:
    field, velocity = rough(70, 130), rough(70, 130, 1)
    one = Wave(field, velocity, 1.0, speed_m_s=1.0, damping_1_s=0.01)
    other = Wave(np.rot90(field).copy(), np.rot90(velocity).copy(), 1.0, speed_m_s=1.0,
                 damping_1_s=0.01)  # fmt: skip
    one.advance(60.0, 100)
    other.advance(60.0, 100)
    np.testing.assert_array_equal(np.rot90(one.displacement), other.displacement)


def test_threads_change_no_bit() -> None:
    """There are 3,300 runs of posts: enough for three parts of a launch."""
    found = []
    for threads in (1, 2, 3):
        wave = Wave(rough(300, 700), rough(300, 700, 1), 1.0, speed_m_s=1.0, threads=threads)
        wave.advance(14.0, 20)
        found.append((wave.displacement, wave.velocity))
    for displacement, velocity in found[1:]:
        np.testing.assert_array_equal(displacement, found[0][0])
        np.testing.assert_array_equal(velocity, found[0][1])


def test_how_many_posts_a_thread_takes_changes_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    """On CUDA each takes one."""
    found = []
    for width in (64, 1):
        monkeypatch.setitem(waves._WIDTH, False, width)
        wave = still(rough(30, 140), damping_1_s=0.1)
        wave.advance(6.0, 12)
        found.append(wave.displacement)
    np.testing.assert_array_equal(found[0], found[1])


def test_substeps_in_one_call_are_those_of_many() -> None:
    """A call joins the half steps between its substeps: the same but for rounding."""
    one, other = still(rough(30, 40), damping_1_s=0.1), still(rough(30, 40), damping_1_s=0.1)
    one.advance(6.0, 12)
    for _ in range(12):
        other.advance(0.5)
    np.testing.assert_allclose(one.displacement, other.displacement, atol=1e-12)
    np.testing.assert_allclose(one.velocity, other.velocity, atol=1e-12)
    assert (one.steps, one.courant) == (other.steps, other.courant) == (12, 0.5)


def test_its_velocity_is_that_of_its_displacement() -> None:
    """A central difference of the displacement, to second order in the step."""
    wave = still(mode(8, 64, 0, 4), damping_1_s=0.02)
    wave.advance(10.0, 1000)
    before = wave.displacement
    wave.advance(0.01)
    now = wave.velocity
    wave.advance(0.01)
    np.testing.assert_allclose((wave.displacement - before) / 0.02, now, atol=2e-6)


def test_no_time_changes_nothing() -> None:
    wave = still(rough(5, 6))
    wave.advance(0.0)
    np.testing.assert_array_equal(wave.displacement, rough(5, 6))
    assert wave.steps == 0


def test_one_row_of_posts_is_a_string() -> None:
    """It takes no part of a second dimension: the mode of a line, to its own frequency."""
    shape = mode(1, 64, 0, 4)
    found = amplitudes(still(shape), shape, 0.5, 40)
    omega = 4.0 * math.asin(0.5 * math.sin(4.0 * np.pi / 128.0))
    np.testing.assert_allclose(found, np.cos(omega * 0.5 * np.arange(41)), atol=1e-12)


def test_the_sum_of_neighbours_is_that_of_the_wave() -> None:
    """One small step from rest moves each post by half the step squared times it."""
    wave = still(rough(9, 11), 0.5, 3.0)
    wave.advance(1e-3)
    moved = (wave.displacement - rough(9, 11)) / (0.5 * 1e-6 * 9.0)
    np.testing.assert_allclose(moved, laplace(rough(9, 11), 0.5), atol=1e-8)


def test_its_bytes_are_those_the_allocator_counts() -> None:
    with counted_memory() as memory:
        wave = still(rough(70, 130))
        assert memory.held == wave_bytes(70, 130)
        wave.advance(0.5)
        assert memory.held == wave_bytes(70, 130)


GOOD: Field = np.zeros((3, 4))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"speed_m_s": 0.0}, "speed_m_s must be above 0 m/s and finite, got 0"),
        ({"speed_m_s": -1.0}, "speed_m_s must be above 0 m/s and finite, got -1"),
        ({"speed_m_s": math.nan}, "speed_m_s must be above 0 m/s and finite, got nan"),
        ({"damping_1_s": -0.1}, r"damping_1_s must be at least 0 1/s and finite, got -0\.1"),
        ({"damping_1_s": math.nan}, "damping_1_s must be at least 0 1/s and finite, got nan"),
        ({"spacing": 0.0}, r"spacing must be above 0 m, got 0\.0"),
        ({"spacing": math.nan}, "spacing must be above 0 m, got nan"),
        ({"displacement": np.zeros((0, 4))}, r"displacement must be .* not empty, got float64"),
        ({"displacement": np.zeros(4)}, "displacement must be float64, 2-D"),
        ({"displacement": GOOD.astype(np.float32)}, "displacement must be float64, .* got float32"),
        ({"displacement": GOOD + math.nan}, "displacement must be finite, got nan"),
        ({"velocity": GOOD + math.inf}, "velocity must be finite, got inf"),
        ({"velocity": np.zeros((4, 3))}, r"shape \(3, 4\), got \(4, 3\)"),
    ],
)
def test_what_is_no_wave_is_refused(change: dict[str, Any], told: str) -> None:
    given: dict[str, Any] = {
        "displacement": GOOD,
        "velocity": GOOD,
        "spacing": 1.0,
        "speed_m_s": 1.0,
    } | change
    with pytest.raises(InputError, match=told):
        Wave(**given)


@pytest.mark.parametrize(
    ("dt_s", "substeps", "told"),
    [
        (-1.0, 1, "dt_s must be at least 0 s and finite, got -1"),
        (math.nan, 1, "dt_s must be at least 0 s and finite, got nan"),
        (math.inf, 1, "dt_s must be at least 0 s and finite, got inf"),
        (0.1, 0, "substeps must be at least 1, got 0"),
    ],
)
def test_what_is_no_step_is_refused(dt_s: float, substeps: int, told: str) -> None:
    wave = still(GOOD, device=wp.get_device("cpu"))
    with pytest.raises(InputError, match=told):
        wave.advance(dt_s, substeps)
