"""Balls here and in MuJoCo on the same posts: where they touch the ground, and where they rest."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrasim.bench.beside import _rows
from terrasim.counts import COUNT_M, HOLE
from terrasim.engines.comparison import Comparison, Spread
from terrasim.engines.hfield import Floats, window_of
from terrasim.engines.mujoco_balls import drop_beside
from terrasim.engines.mujoco_model import bounce_of, spring_of
from terrasim.engines.touch import Touches, flown, meeting
from terrasim.engines.track import REST_SPEED, track
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.output.report_beside import beside, difference_rows, engine_rows
from terrasim.query import sample
from terrasim.sources.analytic import Flat, Plane, Sine
from terrasim.sources.array_source import ArraySource
from terrasim.sources.source import Source
from terrasim.terrain import Terrain

G = 9.81
DT = 1e-3
COUNT = 50
GRID = Grid(161, 161, 0.25)


def mujoco() -> Any:
    return pytest.importorskip("mujoco", reason="MuJoCo is an optional extra: terrasim[mujoco]")


def drop(source: Source, duration: float, **options: Any) -> Comparison:
    """Balls of 0.1 to 0.2 m, let go 0.2 to 1 m over the middle of a ground."""
    rng = np.random.default_rng(7)
    radii = rng.uniform(0.1, 0.2, COUNT)
    across = rng.uniform(12.0, 28.0, (COUNT, 2))
    with Terrain(source) as terrain:
        z = sample(terrain, across).height + 1.5 * radii + rng.uniform(0.2, 1.0, COUNT)
        places = np.column_stack([across, z])
        return drop_beside(terrain, places, radii, dt=DT, duration=duration, **options)


def check_first_contacts(found: Comparison, place_m: float, places: float = 1.0) -> None:
    """All touched, half a step apart, ``places`` of them within ``place_m``, all within 1 mm.

    MuJoCo's step falls with the speed at its end, so its balls are half a step ahead; within a
    step it goes straight, ``g dt^2 / 2`` or 5 micrometres off the parabola, and float32 puts posts
    up to 3 of them off where the range is 100 m. At 2 m/s or more that is 2.5 microseconds.
    """
    assert found.touched.all()
    np.testing.assert_allclose(found.late_s, 0.5 * DT, rtol=0, atol=1e-3 / 2.0)
    exact = np.abs(found.late_s - 0.5 * DT) < place_m / 2.0
    assert np.mean(exact) >= places
    assert np.mean(found.touch_m < place_m) >= places
    assert found.touch_m.max() < 1e-3


def check_rest(found: Comparison, slope: float) -> None:
    """All at rest in both, as far apart as restitutions that differ by 0.07 carry them.

    A ball that friction holds in an impact goes ``4 h e^2 / (1 - e^2) sin`` down a slope until it
    has hopped out; the derivative by ``e`` times 0.07, which MuJoCo's contact strays by in steps
    of finite length, holds for 9 of 10, twice that for all: its friction is a spring too.
    """
    assert found.rest.all()
    e = found.drop.restitution
    stray = 8.0 * 1.1 * slope * e / (1.0 - e * e) ** 2 * 0.07
    rest = Spread.of(found.rest_m)
    assert rest.most < stray
    assert rest.largest < 2.0 * stray


@pytest.mark.parametrize(("slope", "rolling"), [(0.1, None), (0.05, 0.1)])
def test_on_a_plane_balls_touch_and_rest_where_mujoco_has_them(
    slope: float, rolling: float | None
) -> None:
    """Sliding, and rolling to where rolling friction holds them."""
    mujoco()
    found = drop(Plane(GRID, slope_x=slope), 2.5, restitution=0.3, friction=0.5, rolling=rolling)
    check_first_contacts(found, 5e-6)
    check_rest(found, 0.1)
    # On the plane in both, MuJoCo's 0.011 mm deep in a contact that has to give.
    across = found.ours.place - found.theirs.place
    np.testing.assert_allclose(across[:, 2] - slope * across[:, 0], 1.1e-5, rtol=0, atol=1e-5)


def test_on_a_sine_balls_touch_and_rest_where_mujoco_has_them() -> None:
    """Where a sphere touches a triangle beside its centre's, planes are under 1 mm apart.

    ``radius sin(slope)`` beside the centre, at 0.2 m and 0.2 up to 40 mm, times the angle between
    facets, 0.25 m times the curvature of 0.077 a metre: 0.8 mm.
    """
    mujoco()
    sine = Sine(GRID, amplitude=0.5, wavelength=16.0)
    found = drop(sine, 2.5, restitution=0.3, friction=0.5, rolling=None)
    check_first_contacts(found, 5e-6, places=0.9)
    check_rest(found, 0.2)
    assert np.abs(found.rest_high_m).max() < 0.2 * Spread.of(found.rest_m).largest + 1e-4


def test_no_ball_is_lost_and_the_tables_say_so() -> None:
    mujoco()
    found = drop(Flat(GRID), 1.2, restitution=0.3, friction=0.5, rolling=None)
    counts = found.counts()
    for lost in ("buried", "dropped through", "left the window"):
        assert counts[lost] == (0, 0)
    assert counts["touched the ground"] == (COUNT, COUNT)
    assert difference_rows(found)[0][0] == "time of first contact"
    assert difference_rows(found)[0][1] == "0.5 ms"
    told = {row[0]: row[1:] for row in engine_rows(found)}
    assert told["buried: outside its valid range"] == ("0", "0")
    assert "50 balls let go at rest on " in beside(found)
    rows = {row.name: row for row in _rows("x", found)}
    assert rows["x: first contact"].ratio == pytest.approx(1.0, abs=0.01)
    assert rows["x: step"].ratio == pytest.approx(1.0 / found.cost_ratio)


def test_a_far_anchor_changes_nothing() -> None:
    """Posts and balls moved alike: the same first contacts to a rounding of x."""
    mujoco()
    plane = Plane(GRID, slope_x=0.1)
    place = np.array([[15.0, 12.0, 3.0], [15.3, 12.7, 3.1]])
    with Terrain(plane) as terrain:
        near = drop_beside(terrain, place, 0.1, dt=DT, duration=0.8)
        moved = place - [5.0, 10.0, 0.0]
        far = drop_beside(terrain, moved, 0.1, dt=DT, duration=0.8, anchor=(40, 20))
    for one, other in ((near.ours, far.ours), (near.theirs, far.theirs)):
        assert not one.touches.open.any()
        np.testing.assert_allclose(one.touches.time_s, other.touches.time_s, rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            one.touches.centre - [5.0, 10.0, 0.0], other.touches.centre, rtol=0, atol=1e-9
        )


def test_balls_end_on_the_ground_or_in_it_or_through_it_or_beside_it() -> None:
    place = np.array([[0.0, 0.0, 1.1], [0.0, 0.0, 0.9], [0.0, 0.0, -9.0], [50.0, 0.0, 0.0]])
    velocity = np.zeros((4, 3))
    velocity[0, 0] = 2.0 * REST_SPEED
    one = track(
        Touches.none(4), place, velocity, height=np.ones(4), floor=-5.0,
        inside=np.array([True, True, True, False]), step_s=np.full(3, 4e-6), setup_s=0.0,
    )  # fmt: skip
    assert one.valid.tolist() == [True, False, False, False]
    assert one.buried.tolist() == [False, True, False, False]
    assert one.through.tolist() == [False, False, True, False]
    assert one.left.tolist() == [False, False, False, True]
    assert not one.rests.any()
    assert one.step_us == pytest.approx(1.0)


def test_what_a_lost_ball_did_enters_no_difference_at_rest() -> None:
    mujoco()
    found = drop(Flat(GRID), 1.2, restitution=0.3, friction=0.5, rolling=None)
    before = int(found.rest.sum())
    found.theirs.buried[int(np.flatnonzero(found.rest)[0])] = True
    assert len(found.rest_m) == before - 1
    assert found.counts()["buried"] == (0, 1)


def test_a_ball_meets_a_plane_on_the_parabola_before_or_behind_it() -> None:
    normal = np.tile([0.0, 0.0, 1.0], (4, 1))
    velocity = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, -2.0], [0.0, 0.0, -2.0], [0.0, 0.0, 3.0]])
    times = meeting(np.array([1.0, 1.0, -0.1, 0.0]), normal, velocity, G)
    back = flown(np.zeros((4, 3)), velocity, times, G)[:, 2]
    np.testing.assert_allclose(back[:3], [-1.0, -1.0, 0.1], rtol=0, atol=1e-12)
    assert times[2] < 0.0 < times[0]
    assert times[3] == 0.0


@pytest.mark.parametrize(
    ("e", "ratio"), [(0.9, 0.0343), (0.8, 0.0744), (0.5, 0.2553), (0.2, 0.7312)]
)
def test_a_contact_that_never_pulls_gives_back_what_is_asked(e: float, ratio: float) -> None:
    assert bounce_of(ratio) == pytest.approx(e, rel=0.01)
    spring = spring_of(e, DT)
    assert spring.damping / (2.0 * spring.stiffness**0.5) == pytest.approx(ratio, rel=0.01)
    assert bounce_of(1.0 - 1e-6) == pytest.approx(bounce_of(1.0 + 1e-6), rel=1e-5)


@pytest.mark.parametrize("e", [0.0, 0.3, 0.5, 0.8, 1.0])
def test_mujoco_gives_back_what_is_asked_within_seven_hundredths(e: float) -> None:
    """A bound that the tolerance at rest is made of."""
    from terrasim.engines.mujoco_model import model_of

    module = mujoco()
    place = np.array([[10.0, 10.0, 0.15 + high] for high in (0.2, 0.5, 1.0, 2.0)])
    radii = np.full(4, 0.15)
    with Terrain(Flat(GRID)) as terrain:
        window = window_of(terrain, place, radii, margin=3.0, anchor=(0, 0))
    model = model_of(
        window, place, radii, spring=spring_of(e, DT), friction=0.5, rolling=None, gravity=G, dt=DT
    )
    data = module.MjData(model)
    down, up = np.zeros(4), np.zeros(4)
    for _ in range(700):
        module.mj_step(model, data)
        rate = data.qvel.reshape(4, 3)[:, 2]
        down, up = np.minimum(down, rate), np.maximum(up, rate)
    np.testing.assert_allclose(up / -down, e, rtol=0, atol=0.07)


def test_a_window_holds_the_posts_to_less_than_a_count_rounds() -> None:
    rng = np.random.default_rng(2)
    posts = rng.integers(-4_990_000, 4_990_000, (80, 90)).astype(np.int32)
    source = ArraySource(posts, Grid(80, 90, 0.5, row=-7, col=300, x=-3.0, y=9.0))
    places = np.array([[10.0, 8.0, 60.0], [20.0, 20.0, 60.0]])
    with Terrain(source) as terrain:
        window = window_of(terrain, places, np.full(2, 0.5), margin=2.0, anchor=(-7, 300))
    rows, cols = window.shares.shape
    row, col = round(window.south / 0.5), round(window.west / 0.5)
    heights = window.lowest + window.range * window.shares.astype(np.float64)
    exact = posts[row : row + rows, col : col + cols] * COUNT_M
    np.testing.assert_allclose(heights, exact, rtol=0, atol=3e-6)
    assert window.holds(np.array([[10.0, 8.0], [30.0, 8.0]])).tolist() == [True, False]


def refused(source: Source, **options: Any) -> str:
    places: Floats = np.array([[15.0, 12.0, 3.0]])
    with Terrain(source) as terrain, pytest.raises(InputError) as error:
        window_of(
            terrain, places, np.array([options.get("radius", 0.1)]),
            margin=options.get("margin", 5.0), anchor=(0, 0),
        )  # fmt: skip
    return str(error.value)


def holed() -> ArraySource:
    posts = np.zeros((161, 161), dtype=np.int32)
    posts[50, 60] = HOLE
    return ArraySource(posts, GRID)


@pytest.mark.parametrize(
    ("source", "options", "said"),
    [
        (lambda: Plane(GRID, slope_x=12.0), {}, "range over 120.0 m"),
        (holed, {}, "has no holes, this window has"),
        (lambda: Flat(GRID), {"radius": 2.0}, "over 6 posts of 0.25 m"),
        (lambda: Flat(GRID), {"margin": 600.0}, "posts is over 4,194,304: put the balls closer"),
        (lambda: Flat(GRID), {"margin": -1.0}, "margin must be at least 0 m, got -1.0"),
    ],
)
def test_ground_that_cannot_be_mujocos_is_refused(
    source: Callable[[], Source], options: dict[str, float], said: str
) -> None:
    assert said in refused(source(), **options)


def test_without_mujoco_it_is_said_how_to_get_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with Terrain(Flat(GRID)) as terrain, pytest.raises(InputError, match=r"terrasim\[mujoco\]"):
        drop_beside(terrain, [[15.0, 12.0, 3.0]], 0.1)


def test_nothing_to_compare_is_refused() -> None:
    mujoco()
    with Terrain(Flat(GRID)) as terrain, pytest.raises(InputError, match="nothing to compare: 0"):
        drop_beside(terrain, np.zeros((0, 3)), 0.1)


SCENE = """
balls = [{ count = 5, region = { size_x = 9.0, size_y = 9.0 }, radius = 0.3 }]
[terrain]
kind = "flat"
rows = 65
cols = 65
spacing = 1.0
[run]
duration_s = 0.1
"""


def test_neither_the_import_nor_a_run_of_balls_imports_mujoco(tmp_path: Path) -> None:
    """Nor does this package: MuJoCo comes when balls are dropped beside it."""
    scene = tmp_path / "s.toml"
    scene.write_text(SCENE)
    code = (
        "import sys, terrasim, terrasim.engines.mujoco_balls, terrasim.bench.beside\n"
        "from terrasim.cli import command\n"
        "status = command(['run', sys.argv[1], '--out', sys.argv[2], '--json'])\n"
        "print(status, 'mujoco' in sys.modules, file=sys.stderr)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code, str(scene), str(tmp_path / "out")],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr.splitlines()[-1] == "0 False"
