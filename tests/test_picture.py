"""Pictures: light from the right side, true places, and the views that are worth it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from terrasim.deform.stamps import Crater
from terrasim.errors import RunError
from terrasim.grid import Grid
from terrasim.output.colours import LOWERED, RAISED, ramp, tinted
from terrasim.output.picture import ALTITUDE_DEG, Tracks, View, draw_picture, hillshade
from terrasim.output.views import Happening, close_up, on_triangles, site, views_of
from terrasim.scenario.scenario import parse_scenario
from terrasim.sources.source import Source
from terrasim.terrain import Terrain

NONE = Happening([], np.zeros((0, 0, 2)), np.zeros(0))


def view(rows: int = 40, cols: int = 60, **more: float) -> View:
    """A sloping rectangle with a hole."""
    heights = np.add.outer(np.arange(rows) * 0.1, np.arange(cols) * 0.2)
    heights[3, 4] = np.nan
    change = np.where(np.hypot(*np.indices((rows, cols)) - 20) < 8, -1.5, 0.0)
    return View("a slope", heights, -30.0, -20.0, 1.0, change)


def read_png(path: Path) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """Pixels of a picture."""
    from matplotlib.image import imread

    return np.asarray(imread(str(path)), dtype=np.float64)


def test_level_ground_is_as_bright_as_the_light_is_high() -> None:
    shade = hillshade(np.full((5, 5), 7.0), 2.0)
    np.testing.assert_allclose(shade, np.sin(np.radians(ALTITUDE_DEG)))


def test_slopes_that_face_the_north_west_are_bright() -> None:
    row, col = np.indices((9, 9)).astype(float)
    faces_north_west = hillshade(0.4 * col - 0.4 * row, 1.0)[4, 4]
    faces_south_east = hillshade(0.4 * row - 0.4 * col, 1.0)[4, 4]
    level = hillshade(0.0 * row, 1.0)[4, 4]
    assert faces_south_east < level < faces_north_west


def test_a_picture_shows_ground_balls_and_deformations(tmp_path: Path) -> None:
    path = tmp_path / "p.png"
    places = np.random.default_rng(1).uniform(-15, 15, (9, 30, 2))
    tracks = Tracks(places, np.full(30, 0.4))
    close = View("close", np.zeros((20, 20)), -5.0, -5.0, 0.5)
    draw_picture(path, [view(), close], title="t", note="synthetic: x", tracks=tracks)
    pixels = read_png(path)
    assert pixels.shape[1] > 1000
    bare = tmp_path / "bare.png"
    draw_picture(bare, [view(), close], title="t", note="synthetic: x")
    yellow = np.array([1.0, 0.82, 0.12])

    def near_yellow(image: np.ndarray[tuple[int, ...], np.dtype[np.float64]]) -> int:
        return int((np.abs(image[..., :3] - yellow).max(axis=-1) < 0.02).sum())

    assert near_yellow(pixels) > near_yellow(read_png(bare)) + 300


def test_a_picture_is_the_same_picture_again(tmp_path: Path) -> None:
    for name in ("a", "b"):
        draw_picture(tmp_path / f"{name}.png", [view()], title="t")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_ground_without_any_height_can_be_drawn(tmp_path: Path) -> None:
    hole = View("nothing", np.full((8, 8), np.nan), 0.0, 0.0, 1.0, np.full((8, 8), np.nan))
    draw_picture(tmp_path / "p.png", [hole], title="t")
    assert (tmp_path / "p.png").stat().st_size > 0


def test_a_picture_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(RunError, match="the picture cannot be written"):
        draw_picture(tmp_path / "none" / "p.png", [view()], title="t")


def test_tints_grow_with_the_change_and_spare_the_rest() -> None:
    ground = ramp(np.full(5, 0.5))
    dyed = tinted(ground, np.array([-2.0, -0.5, 0.0, 0.01, 2.0]), 2.0)
    np.testing.assert_array_equal(dyed[2:4], ground[2:4])
    to_lowered = np.abs(dyed[:2] - np.array(LOWERED)).sum(axis=-1)
    assert to_lowered[0] < to_lowered[1]
    assert np.abs(dyed[4] - np.array(RAISED)).sum() < np.abs(ground[4] - np.array(RAISED)).sum()


def test_between_posts_the_picture_has_the_surface_s_triangles() -> None:
    posts = np.array([[0.0, 1.0], [4.0, 0.0]])
    found = on_triangles(posts, 2)
    # The diagonal joins (x-, y-) to (x+, y+): its middle is halfway between 0 and 0.
    np.testing.assert_array_equal(found, [[0.0, 0.5, 1.0], [2.0, 0.0, 0.5], [4.0, 2.0, 0.0]])
    np.testing.assert_array_equal(on_triangles(posts, 1), posts)


def sine(rows: int = 2000, cols: int = 3000) -> Source:
    """Waves on some square kilometres."""
    terrain = {
        "kind": "sine", "rows": rows, "cols": cols, "spacing": 1.0, "amplitude": 5.0,
        "wavelength": 100.0,
    }  # fmt: skip
    return parse_scenario({"terrain": terrain}).terrain.source(Path())


def test_nothing_that_happens_leaves_the_whole_terrain_alone() -> None:
    with Terrain(sine()) as terrain:
        views = views_of(terrain, (1000, 1500), NONE)
    assert len(views) == 1
    west, east, south, north = views[0].box
    assert (west, south) == (-1500.0, -1000.0)
    # Posts of level 2: the last stands at the edge or up to three posts beyond it.
    assert 1499.0 <= east <= 1502.0
    assert 999.0 <= north <= 1002.0


def test_what_happens_is_shown_closer_and_closer() -> None:
    craters = [Crater(x, 0.0, 10.0, 2.0) for x in (-100.0, 150.0)]
    places = np.zeros((4, 50, 2)) + np.array([150.0, 3.0])
    places += np.random.default_rng(1).uniform(-3, 3, places.shape)
    happening = Happening(craters, places, np.full(50, 0.25))
    with Terrain(sine()) as terrain:
        views = views_of(terrain, (1000, 1500), happening)
    assert len(views) == 3
    whole, wide, close = (one.box for one in views)
    for outer, inner in ((whole, wide), (wide, close)):
        assert outer[0] <= inner[0] < inner[1] <= outer[1]
        assert outer[2] <= inner[2] < inner[3] <= outer[3]
    assert wide[0] <= -110.0
    assert wide[1] >= 160.0
    assert close[1] - close[0] == pytest.approx(160 * 0.25, abs=2.0)
    assert close[0] < 150.0 < close[1]


def test_a_view_at_the_rim_is_moved_inside() -> None:
    happening = Happening([Crater(1490.0, 990.0, 10.0, 2.0)], np.zeros((0, 0, 2)), np.zeros(0))
    with Terrain(sine()) as terrain:
        last = views_of(terrain, (1000, 1500), happening)[-1]
    rows, cols = last.heights.shape
    assert rows == cols
    assert last.box[1] <= 1499.0
    assert last.box[3] <= 999.0


def test_views_show_what_deformations_did() -> None:
    from terrasim.deform.apply import apply

    crater = Crater(10.0, -20.0, 30.0, 4.0)
    happening = Happening([crater], np.zeros((0, 0, 2)), np.zeros(0))
    with Terrain(sine(), pool_bytes=16 << 18) as terrain:
        apply(terrain, [crater], anchor=(1000, 1500))
        close = views_of(terrain, (1000, 1500), happening)[-1]
    assert close.change is not None
    assert close.change.min() == pytest.approx(-4.0, abs=1e-4)
    row, col = np.unravel_index(int(close.change.argmin()), close.change.shape)
    assert close.x + col * close.spacing == pytest.approx(10.0, abs=1e-9)
    assert close.y + row * close.spacing == pytest.approx(-20.0, abs=1e-9)


def test_the_site_holds_stamps_and_trails() -> None:
    places = np.array([[[0.0, 0.0]], [[40.0, 80.0]]])
    found = site(Happening([], places, np.ones(1)))
    assert found is not None
    assert (found.x, found.y) == (20.0, 40.0)
    assert found.half > 40.0
    assert site(NONE) is None
    assert close_up(NONE) is None


def test_a_tiny_terrain_can_be_drawn(tmp_path: Path) -> None:
    source = parse_scenario(
        {"terrain": {"kind": "flat", "rows": 2, "cols": 2, "spacing": 1.0}}
    ).terrain.source(tmp_path)
    assert source.grid == Grid(2, 2, spacing=1.0)
    with Terrain(source) as terrain:
        views = views_of(terrain, (0, 0), NONE)
    draw_picture(tmp_path / "p.png", views, title="tiny")
    assert (tmp_path / "p.png").is_file()
