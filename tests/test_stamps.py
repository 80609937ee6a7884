"""Stamps on the ground: volumes, signs, and the crater's profile."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, get_args

import numpy as np
import pytest
from shape_formulas import FORMULAS

from terrasim.counts import COUNT_M
from terrasim.deform.apply import apply
from terrasim.deform.shapes.stamp import Mode
from terrasim.deform.stamps import (
    REGISTRY,
    Berm,
    ConeStamp,
    Crater,
    Gaussian,
    HalfCosine,
    HeightImage,
    Noise,
    Paraboloid,
    SphericalCap,
    Stamp,
    Texture,
    Trench,
)
from terrasim.deform.window import read_window
from terrasim.grid import Grid
from terrasim.query import sample
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

SPACINGS = (1.0, 0.5, 0.25, 0.125)
SIDE = 64
"""Sides of the ground [m]."""
AT = (32.3, 31.8)
STRAIGHT = [(-12.0, -7.0), (9.0, 8.0)]
BENT = [(-15.0, -10.0), (4.0, -7.0), (12.0, 9.0)]
CLOSED = [(-13.0, -10.0), (13.0, -9.0), (2.0, 14.0), (-13.0, -10.0)]
HILL = np.sin(np.linspace(0.0, np.pi, 9))[:, None] * np.sin(np.linspace(0.0, np.pi, 7))
MASK = np.random.default_rng(0).uniform(0.0, 1.0, (9, 7))

VOLUMES: list[tuple[Stamp, float, float]] = [
    # Stamp, its volume by the textbook, length of its kinks [m].
    (Gaussian(*AT, 0.7, 4.0), 2 * math.pi * 16.0 * 0.7, 0.0),
    (Gaussian(*AT, -0.7, 4.0), -2 * math.pi * 16.0 * 0.7, 0.0),
    (ConeStamp(*AT, 9.0, 2.0), math.pi * 81.0 * 2.0 / 3, 18 * math.pi),
    (Paraboloid(*AT, 9.0, -2.0), -math.pi * 81.0 * 2.0 / 2, 18 * math.pi),
    # With the radius of its sphere, 21.25 m.
    (SphericalCap(*AT, 9.0, 2.0), math.pi * 4.0 * (3 * 21.25 - 2.0) / 3, 18 * math.pi),
    (HalfCosine(*AT, 9.0, 2.0), 0.297357633 * math.pi * 81.0 * 2.0, 0.0),
    (Crater(*AT, 9.0, 2.0), -math.pi * 81.0, 18 * math.pi),
    (Crater(*AT, 9.0, 2.0, 0.8), math.pi * 81.0 * (-0.6 + 0.8 * 14 / 13), 72 * math.pi),
    (Crater(*AT, 9.0, 2.0, balanced=True), 0.0, 72 * math.pi),
    # Half of width times depth along the line, and a cone at the ends.
    (Trench(*AT, STRAIGHT, 6.0, 1.5), -(4.5 * math.sqrt(666) + math.pi * 9.0 * 1.5 / 3), 160.0),
    # 1.5 * (6 - 2) along it, and a frustum of radii 3 and 1.
    (
        Berm(*AT, STRAIGHT, 6.0, 1.5, section="box", side=2.0),
        6.0 * math.sqrt(666) + math.pi * 1.5 * (9 + 3 + 1) / 3,
        220.0,
    ),
    # A half circle along it, and half a sphere at the ends: upright at its edge.
    (
        Berm(*AT, STRAIGHT, 6.0, 3.0, section="round"),
        math.pi * 4.5 * math.sqrt(666) + 18 * math.pi,
        160.0,
    ),
    (Trench(*AT, BENT, 6.0, 1.5), math.nan, 230.0),
    (Trench(*AT, CLOSED, 6.0, 1.5, section="box", side=2.0), math.nan, 600.0),
    (Berm(*AT, CLOSED, 6.0, 1.5, section="round", ends="flat"), math.nan, 450.0),
    (Texture(*AT, HeightImage(HILL), 30.0, 20.0, turn_deg=20.0, scale=2.0), math.nan, 400.0),
    (Texture(*AT, HeightImage(HILL, MASK), 30.0, 20.0, turn_deg=20.0), math.nan, 400.0),
]


@pytest.mark.parametrize(
    ("stamp", "volume", "kinks"), VOLUMES, ids=[f"{i} {v[0].name}" for i, v in enumerate(VOLUMES)]
)
def test_volumes_are_the_closed_forms(stamp: Stamp, volume: float, kinks: float) -> None:
    """Within C times the squared spacing: a kink of slope J and length L sets C to J L / 64.

    A kink halfway between posts errs by J / 8; an eighth of that is what is left where it crosses
    the rows at all angles.

    A rise of h in a gaussian's tail is rounded by ``2 pi sigma^2 (rint(h) - h) / h dh`` in all,
    0.16 of a count's volume. Other roundings are independent, half a count at most: ten of their
    standard deviations.
    """
    if not math.isnan(volume):
        assert stamp.volume == pytest.approx(volume, rel=1e-9, abs=1e-12)
    expected, tail = stamp.volume, 0.0
    if isinstance(stamp, Gaussian):
        expected = stamp.volume_to_cut
        tail = 0.16 * 2 * math.pi * stamp.sigma**2 * COUNT_M
        # The cut loses half a count over the variance's area.
        lost = math.pi * stamp.sigma**2 * COUNT_M
        assert abs(stamp.volume - expected) == pytest.approx(lost, rel=1e-6)
    slope = min(stamp.bounds.slope, 1.0)
    constant = slope * kinks / 64.0 + 0.01
    for spacing in SPACINGS:
        posts = round(SIDE / spacing) + 1
        grid = Grid(posts, posts, spacing)
        with Terrain(ArraySource(np.zeros((posts, posts), np.int32), grid)) as terrain:
            ledger = apply(terrain, [stamp])
        floor = 10 * 0.3 * COUNT_M * spacing**2 * math.sqrt(ledger.posts)
        error = ledger.volume(spacing) - expected
        assert abs(error) <= constant * spacing**2 + floor + tail


@pytest.mark.parametrize("height", [1.5, -1.5])
def test_the_ledger_has_the_stamps_sign(height: float) -> None:
    """What is piled up is added alone, what is dug is removed alone."""
    grid = Grid(65, 65, 1.0)
    stamps: list[Stamp] = [kind(32.0, 32.0, 9.0, height) for kind in (ConeStamp, Paraboloid)]
    stamps.append(Gaussian(32.0, 32.0, height, 5.0))
    with Terrain(ArraySource(np.zeros((65, 65), np.int32), grid)) as terrain:
        ledgers = [apply(terrain, [stamp]) for stamp in stamps]
    for ledger in ledgers:
        moved, still = (ledger.added, ledger.removed)[:: 1 if height > 0 else -1]
        assert moved > 0
        assert still == 0
        assert ledger.net == (moved if height > 0 else -moved)


def test_a_trench_and_its_berm_leave_the_ground_as_it_was() -> None:
    grid = Grid(65, 65, 1.0)
    rough = np.random.default_rng(1).integers(-9999, 9999, (65, 65), dtype=np.int32)
    with Terrain(ArraySource(rough, grid)) as terrain:
        dug = apply(terrain, [Trench(*AT, BENT, 6.0, 1.5)])
        filled = apply(terrain, [Berm(*AT, BENT, 6.0, 1.5)])
    assert dug.removed == filled.added > 0
    assert dug.net + filled.net == 0


def met(mode: Mode, h: Any, t: Any, weight: Any) -> Any:
    """What ground becomes of a stamp's surface [counts]."""
    return {
        "add": h + t,
        "dig": np.minimum(h, t),
        "fill": np.maximum(h, t),
        "replace": t,
        "blend": h + np.rint(weight * (t - h)),
    }[mode]


@pytest.mark.parametrize("mode", get_args(Mode))
def test_every_stamp_meets_the_ground_as_its_mode_says(mode: Mode) -> None:
    """On rough ground, against the formulas in NumPy: a count off where rounding is in doubt."""
    rng = np.random.default_rng(4)
    for stamp, formula, _ in FORMULAS:
        if (mode == "add") != (stamp.mode == "add"):
            # What is added may have another extent, and noise and images another height.
            continue
        west, south, east, north = stamp.extent
        # Places that lie evenly among the posts would meet many heights halfway.
        spacing = max(east - west, north - south) / 39.7
        made = replace(stamp, mode=mode, z=None if mode == "add" else 0.3)
        if not isinstance(stamp, Noise):
            made = replace(made, x=0.37 * spacing, y=0.22 * spacing)
        row, col = (math.floor((made.y + south) / spacing), math.floor((made.x + west) / spacing))
        grid = Grid(44, 44, spacing, row=row - 1, col=col - 1, datum=-2.0)
        before = rng.integers(100_000, 300_000, (44, 44), dtype=np.int32)
        dy, dx = np.meshgrid(
            (grid.row + np.arange(44)) * spacing - made.y,
            (grid.col + np.arange(44)) * spacing - made.x,
            indexing="ij",
        )
        height, weight = formula(dx, dy)
        ground = before.astype(np.float64)
        surface = (height + (0.0 if made.z is None else made.z + 2.0)) / COUNT_M
        expected = np.where(weight > 0.0, met(mode, ground, np.rint(surface), weight), ground)
        with Terrain(ArraySource(before, grid)) as terrain:
            ledger = apply(terrain, [made])
            found = read_window(terrain, grid.row, grid.col, 44, 44, False)
        assert np.abs(found - expected).max() <= 1.0, made
        assert np.count_nonzero(found != expected) <= 2, made
        assert ledger.posts == np.count_nonzero(found != before)
        assert ledger.net == (found - before).sum()


def test_a_crater_is_a_bowl_with_a_rim() -> None:
    """Floor, crest and end at the heights and places the docstring gives."""
    grid = Grid(101, 101, 1.0)
    with Terrain(ArraySource(np.zeros((101, 101), np.int32), grid)) as terrain:
        apply(terrain, [Crater(50.0, 50.0, 10.0, 4.0, 1.0)])
        points = [[50.0, 50.0], [60.0, 50.0], [50.0, 35.0], [80.0, 50.0]]
        found = sample(terrain, points).height
    half = (1.5**-3 - 1 / 27) / (26 / 27)
    np.testing.assert_allclose(found, [-4.0, 1.0, half, 0.0], atol=COUNT_M / 2)


def test_a_bend_too_sharp_for_its_pieces_has_no_closed_form() -> None:
    assert math.isnan(Trench(0.0, 0.0, [(0, 0), (1, 0), (0, 0.1)], 2.0, 1.0).volume)
    assert not math.isnan(Trench(0.0, 0.0, [(0, 0), (9, 0), (9, 9)], 2.0, 1.0).volume)


def test_a_stamp_scales_with_all_its_lengths() -> None:
    """Twice as large, eight times the volume; angles, seeds and the world's heights stay."""
    for stamp, _, _ in VOLUMES:
        volume = stamp.scaled(2.0).volume
        assert volume == pytest.approx(8.0 * stamp.volume, rel=1e-12, abs=1e-12)
        np.testing.assert_allclose(
            replace(stamp, detail=True).scaled(2.0).extent[2:],
            2.0 * np.array(replace(stamp, detail=True).extent[2:]),
            rtol=0.05,
        )
    pit = Crater(1.0, 2.0, 3.0, 1.0, mode="dig", z=5.0, detail=True).scaled(2.0)
    assert pit == Crater(1.0, 2.0, 6.0, 2.0, mode="dig", z=5.0, detail=True)


def test_the_registry_names_every_stamp() -> None:
    assert all(name == kind.name for name, kind in REGISTRY.items())
    assert len({kind.__name__ for kind in REGISTRY.values()}) == len(REGISTRY)
