"""The shapes of stamps: profiles, volumes, and what is refused."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest

from terrasim.counts import COUNT_M
from terrasim.deform.apply import apply
from terrasim.deform.stamps import REGISTRY, Crater, Gaussian, Stamp
from terrasim.errors import InputError
from terrasim.grid import Grid
from terrasim.query import sample
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain


@pytest.mark.parametrize(
    ("stamp", "constant"),
    [
        (Gaussian(64.3, 63.8, 0.7, 6.0), 0.1),
        (Gaussian(64.3, 63.8, -0.7, 6.0), 0.1),
        (Crater(64.3, 63.8, 9.0, 2.0, 0.0), 25.0),
        (Crater(64.3, 63.8, 9.0, 2.0, 0.8), 25.0),
    ],
)
def test_volumes_are_the_closed_forms(stamp: Stamp, constant: float) -> None:
    """Within C times the squared spacing; a kink along a crest of length 2 pi R sets C."""
    for spacing in (1.0, 0.5, 0.25):
        posts = round(128 / spacing) + 1
        grid = Grid(posts, posts, spacing)
        with Terrain(ArraySource(np.zeros((posts, posts), np.int32), grid)) as terrain:
            ledger = apply(terrain, [stamp])
        # Roundings of half a count, independent: ten of their standard deviations.
        floor = 10 * 0.3 * COUNT_M * spacing**2 * math.sqrt(ledger.posts)
        assert abs(ledger.volume(spacing) - stamp.volume) <= constant * spacing**2 + floor


def test_a_crater_is_a_bowl_with_a_rim() -> None:
    """Floor, crest and end at the heights and places the docstring gives."""
    grid = Grid(101, 101, 1.0)
    with Terrain(ArraySource(np.zeros((101, 101), np.int32), grid)) as terrain:
        apply(terrain, [Crater(50.0, 50.0, 10.0, 4.0, 1.0)])
        points = [[50.0, 50.0], [60.0, 50.0], [50.0, 35.0], [80.0, 50.0]]
        found = sample(terrain, points).height
    half = (1.5**-3 - 1 / 27) / (26 / 27)
    np.testing.assert_allclose(found, [-4.0, 1.0, half, 0.0], atol=COUNT_M / 2)


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: Gaussian(0.0, 0.0, 1.0, 0.0), "gaussian: sigma must lie between .* got 0"),
        (lambda: Gaussian(0.0, 0.0, 1.0, -1.0), "got -1.0"),
        (lambda: Gaussian(math.nan, 0.0, 1.0, 1.0), "gaussian: x must be a finite number, got nan"),
        (lambda: Gaussian(0.0, 0.0, math.inf, 1.0), "amplitude must be a finite number, got inf"),
        (lambda: Gaussian(0.0, 0.0, 3e4, 1.0), "amplitude must stay within 21475 m, got 30000"),
        (lambda: Crater(0.0, 0.0, 0.0, 1.0), "crater: radius must lie between .* got 0"),
        (lambda: Crater(0.0, 0.0, 1.0, -1.0), "crater: depth must be at least 0 m, got -1.0"),
        (lambda: Crater(0.0, 0.0, 1.0, 1.0, -0.1), "rim_height must be at least 0 m, got -0.1"),
        (lambda: Crater("a", 0.0, 1.0, 1.0), "crater: x must be a finite number, got a"),  # type: ignore[arg-type]
    ],
)
def test_a_bad_stamp_is_refused(make: Callable[[], Stamp], said: str) -> None:
    """The message names stamp, field, rule and value."""
    with pytest.raises(InputError, match=said):
        make()


def test_the_registry_names_every_stamp() -> None:
    assert all(name == kind.name for name, kind in REGISTRY.items())
    assert len({kind.__name__ for kind in REGISTRY.values()}) == len(REGISTRY)
