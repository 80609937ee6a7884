"""What figures are made of: fitted orders, the Pareto front, measures of frames."""

from __future__ import annotations

import math

import numpy as np
import pytest

from terrasim.study.frames import Frames
from terrasim.study.knobs import turned
from terrasim.study.measures import MEASURES, measured
from terrasim.study.orders import fit_order, pareto, step_of
from terrasim.study.solutions import solve
from terrasim.study.watch import frame_steps


@pytest.mark.parametrize("order", [1.0, 2.0, 0.5])
def test_a_power_law_gives_its_order_back(order: float) -> None:
    steps = [0.4, 0.2, 0.1, 0.05]
    fit = fit_order(steps, [3.0 * h**order for h in steps])
    assert fit is not None
    assert fit.order == pytest.approx(order)
    assert fit.size == pytest.approx(3.0)
    assert fit.spread == pytest.approx(0.0, abs=1e-9)
    assert fit.text == f"order {order:.2f} ± 0.00 (4 points)"


def test_what_has_no_order_is_given_none() -> None:
    assert fit_order([0.1, 0.1], [1.0, 2.0]) is None
    assert fit_order([0.2, 0.1, 0.05], [1.0, 0.0, None]) is None
    flat = fit_order([0.2, 0.1, 0.05], [1.0, 1.01, 0.99])
    grows = fit_order([0.2, 0.1, 0.05], [1e-15, 2e-15, 3e-15])
    assert flat is not None
    assert grows is not None
    assert flat.text == "does not depend on it"
    assert grows.text.startswith("rounding")


def test_nothing_beats_a_variant_on_the_front() -> None:
    rng = np.random.default_rng(1)
    costs, errors = rng.random(200).tolist(), rng.random(200).tolist()
    front = pareto(costs, errors)
    for i in range(200):
        beaten = any(costs[j] <= costs[i] and errors[j] <= errors[i] and j != i for j in range(200))
        assert (i in front) != beaten
    assert pareto([1.0, None, 2.0], [None, 0.1, 0.2]) == [2]
    assert pareto([1.0, 1.0], [0.5, 0.5]) == [0]


def test_steps_are_told_from_other_knobs() -> None:
    assert step_of("run.dt_s", 0.01) == 0.01
    assert step_of("terrain.spacing", 2) == 2.0
    assert step_of("detail.factor", 8) == 0.125
    assert [step_of("samples.level", level) for level in (0, 3)] == [1.0, 8.0]
    assert step_of("run.threads", 2) is None
    assert step_of("run.dt_s", 0.0) is None
    assert step_of("collision.contact", "plane") is None


def frames(places: list[list[list[float]]], times: list[float]) -> Frames:
    """Frames with given places."""
    table = np.array(places)
    return Frames(np.array(times), table, 2.0 * table)


def test_errors_are_distances_at_the_times_both_know() -> None:
    seen = frames(
        [[[0, 0, 0], [1, 0, 0]], [[0, 3, 4], [1, 0, 9]], [[0, 0, 1], [1, 2, 0]]], [0, 1, 2]
    )
    true = frames([[[0, 0, 0], [1, 0, 0]], [[0, 0, 0], [1, 0, 0]]], [0, 2])
    names = ("error", "error_rms", "error_path", "error_velocity")
    values = measured(names, {}, seen, true)
    assert values == pytest.approx(
        {"error": 2.0, "error_rms": math.sqrt(2.5), "error_path": 2.0, "error_velocity": 4.0}
    )
    whole = frames([[[0, 0, 0], [1, 0, 0]]] * 3, [0, 1, 2])
    assert measured(("error_path",), {}, seen, whole) == {"error_path": 9.0}


def test_heights_are_compared_where_there_are_no_balls() -> None:
    none = np.zeros((0, 0, 3))
    seen = Frames(np.zeros(0), none, none, np.array([1.0, math.nan, 3.0]))
    true = Frames(np.zeros(0), none, none, np.array([1.5, math.nan, 3.0]))
    assert measured(("error",), {}, seen, true) == {"error": 0.5}


def test_every_measure_says_what_it_is() -> None:
    for name, one in MEASURES.items():
        assert one.meaning, name
        assert (one.found is None) != (one.referred is None), name


def test_the_first_and_last_step_are_framed() -> None:
    assert frame_steps(100, 4).tolist() == [0, 25, 50, 75, 100]
    assert frame_steps(3, 10).tolist() == [0, 1, 2, 3]
    assert frame_steps(0, 4).tolist() == [0]


def test_tables_given_stay_as_they_are() -> None:
    table = {"run": {"dt_s": 1.0}, "balls": [{"radius": 1.0}]}
    made = turned(table, {"run.dt_s": 2.0, "balls[1].radius": 3.0})
    assert made == {"run": {"dt_s": 2.0}, "balls": [{"radius": 3.0}]}
    assert table == {"run": {"dt_s": 1.0}, "balls": [{"radius": 1.0}]}


def test_a_solution_begins_where_its_ball_does() -> None:
    """Every ball is solved from what was seen of it at first."""
    rng = np.random.default_rng(2)
    places, velocities = rng.random((2, 3, 3)) + 1.0, rng.random((2, 3, 3))
    up, material = np.tile([0.0, 0.0, 1.0], (3, 1)), np.tile([0.1, 0.7, 0.0, 0.0], (3, 1))
    seen = Frames(np.array([0.0, 0.3]), places, velocities, np.zeros(0), np.zeros(3), up, material)
    true = solve("bounce", seen, 9.81)
    np.testing.assert_array_equal(true.places[0], places[0])
    np.testing.assert_array_equal(true.velocities[0], velocities[0])
    assert not np.array_equal(true.places[1], places[1])
