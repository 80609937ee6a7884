"""What dynamics are made of: profiles, and fields that are refused."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import pytest

from terrasim.deform.growth import Growth, RunningGrowth
from terrasim.deform.profiles import Exponential, Linear, Profile, Smoothstep, Table
from terrasim.deform.shock import RunningShock, Shock
from terrasim.deform.stamps import Gaussian
from terrasim.deform.target import target_of
from terrasim.errors import InputError
from terrasim.grid import Grid, Span
from terrasim.sources.analytic import Flat
from terrasim.terrain import Terrain

FLAT = Flat(Grid(600, 600, spacing=0.5, row=-100, col=200))
ANCHOR = (200, 500)
HILL = Gaussian(1.3, -2.1, amplitude=1.5, sigma=4.0)

PROFILES = [
    Linear(),
    Linear(1.0, 0.25),
    Smoothstep(),
    Smoothstep(-0.5, 0.5),
    Exponential(),
    Exponential(0.0, 2.0, 0.1),
    Table((0.0, 0.3, 1.0), (0.0, 1.5, 0.5)),
]


@pytest.mark.parametrize("profile", PROFILES, ids=lambda one: one.name)
def test_a_profile_s_rate_is_its_slope(profile: Profile) -> None:
    for part in (0.05, 0.25, 0.5, 0.75, 0.95):
        slope = (profile.factor(part + 1e-6) - profile.factor(part - 1e-6)) / 2e-6
        assert profile.rate(part) == pytest.approx(slope, abs=1e-6)
        assert abs(profile.factor(part)) <= profile.largest


def test_profiles_have_their_values() -> None:
    assert [Linear(0.5, 2.0).factor(part) for part in (0.0, 0.5, 1.0)] == [0.5, 1.25, 2.0]
    assert [Smoothstep().factor(part) for part in (0.0, 0.25, 0.5, 1.0)] == [0, 0.15625, 0.5, 1]
    decay = Exponential(2.0, 1.0, 0.25)
    assert decay.factor(0.0) == 2.0
    assert decay.factor(0.25) == pytest.approx(1.0 + math.exp(-1.0))
    table = Table((0.0, 0.5, 1.0), (0.0, 3.0, 1.0))
    assert [table.factor(part) for part in (0.0, 0.25, 0.5, 0.75, 1.0)] == [0, 1.5, 3, 2, 1]
    assert (table.rate(0.5), table.rate(1.0)) == (-4.0, -4.0)


def shock(**change: Any) -> Callable[[], Any]:
    given: dict[str, Any] = {
        "x": 0.0, "y": 0.0, "size_x": 90.0, "size_y": 90.0, "speed_m_s": 9.0, "duration_s": 2.0,
        "displacement": HILL,
    }  # fmt: skip
    return lambda: Shock(**(given | change))


def growth(**change: Any) -> Callable[[], Any]:
    given: dict[str, Any] = {"stamp": HILL, "duration_s": 2.0}
    return lambda: Growth(**(given | change))


DUG = Gaussian(0.0, 0.0, amplitude=1.0, sigma=1.0, mode="dig", z=3.0)


@pytest.mark.parametrize(
    ("make", "told"),
    [
        *(
            (shock(**{field: math.nan}), f"shock: {field} must be a finite number, got nan")
            for field in ("x", "y", "size_x", "size_y", "speed_m_s", "duration_s", "damping_1_s")
        ),
        (shock(size_x=0.0), r"shock: size_x must lie between 1e-06 and 1e\+09 m, got 0"),
        (shock(speed_m_s=0.0), "shock: speed_m_s must be above 0 m/s and finite, got 0"),
        (shock(speed_m_s=-2.0), "shock: speed_m_s must be above 0 m/s and finite, got -2"),
        (shock(damping_1_s=-0.1), r"shock: damping_1_s must be at least 0 1/s and finite, got -0"),
        (shock(duration_s=0.0), r"shock: duration_s must be above 0 s and finite, got 0"),
        (shock(substeps=0), "shock: substeps must be at least 1, got 0"),
        (shock(substeps=1.5), "shock: substeps must be a whole number, got 1.5"),
        (shock(zero_mean=1), "shock: zero_mean must be true or false, got 1"),
        (shock(displacement=None), "shock: displacement must be given where there is no velocity"),
        (shock(displacement=3.0), "shock: displacement must be a stamp, got 3"),
        (shock(displacement=DUG), "shock: displacement must be of mode add, got dig"),
        (shock(velocity=DUG), "shock: velocity must be of mode add, got dig"),
        (growth(duration_s=0.0), "growth: duration_s must be above 0 s and finite, got 0"),
        (growth(duration_s=math.nan), "growth: duration_s must be a finite number, got nan"),
        (growth(stamp=None), "growth: stamp must be a stamp, got None"),
        (growth(stamp=DUG), "growth: stamp must be of mode add, got dig"),
        (growth(profile="linear"), "growth: profile must be a profile, got 'linear'"),
        (lambda: Linear(math.nan), "linear: start must be a finite number, got nan"),
        (lambda: Smoothstep(0.0, math.inf), "smoothstep: finish must be a finite number, got inf"),
        (lambda: Exponential(time_constant=0.0), "exponential: time_constant must be above 0"),
        (lambda: Table((0.0,), (1.0,)), "table: times must hold 2 to 100000 numbers, got 1"),
        (lambda: Table((0.0, 1.0), (1.0, math.nan)), "table: factors must be a finite number"),
        (lambda: Table((0.0, 1.0), (1.0, 2.0, 3.0)), r"factors must be as many .* \(2\), got 3"),
        (lambda: Table((0.0, 0.9), (1.0, 2.0)), r"table: times must run from 0 to 1, got 0.0 to"),
        (lambda: Table((0.0, 0.5, 0.5, 1.0), (1.0,) * 4), "table: times must rise"),
    ],
)  # fmt: skip
def test_what_is_no_dynamic_is_refused(make: Callable[[], Any], told: str) -> None:
    with pytest.raises(InputError, match=told):
        make()


def begun(what: Shock | Growth, terrain: Terrain) -> Any:
    """Something that changes a terrain over time."""
    kind: Any = RunningShock if isinstance(what, Shock) else RunningGrowth
    return kind(what, target_of(terrain, detail=False), ANCHOR)


def test_what_does_not_fit_the_terrain_is_refused() -> None:
    far = Gaussian(5000.0, 0.0, amplitude=1.0, sigma=1.0)
    high = Gaussian(0.0, 0.0, amplitude=21_000.0, sigma=1.0)
    with Terrain(FLAT) as terrain:
        for what in (shock(x=5000.0)(), shock(x=0.25, size_x=0.1)(), growth(stamp=far)()):
            with pytest.raises(InputError, match="its rectangle must hold a post of the terrain"):
                begun(what, terrain)
        with pytest.raises(InputError, match=r"stamp must stay within 21474\.8 m .*, got 42000"):
            begun(growth(stamp=high, profile=Linear(0.0, 2.0))(), terrain)
        with pytest.raises(InputError, match="does not go with these posts"):
            RunningShock(shock(detail=True)(), target_of(terrain, detail=False))
        with pytest.raises(InputError, match="no detail grid"):
            target_of(terrain, detail=True)
        one = begun(shock()(), terrain)
        with pytest.raises(InputError, match="end must be 'freeze' or 'vanish', got 'melt'"):
            one.end("melt")
        for dt_s in (-1.0, math.nan):
            with pytest.raises(InputError, match="dt_s must be at least 0 s and finite, got"):
                one.advance(dt_s)
        assert not terrain.ground.edited


def test_a_rectangle_holds_the_posts_it_says() -> None:
    """Those within half its size of its middle, ends included, cut at the terrain's edge."""
    with Terrain(FLAT) as terrain:
        target = target_of(terrain, detail=False)
        small = shock(x=1.0, y=-2.0, size_x=3.0, size_y=2.0)()
        assert small.span(target, ANCHOR) == Span(194, 199, 499, 506)
        wide = shock(size_x=1e6, size_y=1e6)()
        assert wide.span(target, ANCHOR) == Span(-100, 500, 200, 800)
