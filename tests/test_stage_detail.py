"""Stages and pictures of ground with detail: as it is, and as it changes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from detail_ground import add_detail, rough_ground, scatter

from terrasim.counts import to_metres
from terrasim.grid import Span
from terrasim.output.stage_tiles import StageTiles
from terrasim.output.tiles import choose_tiles
from terrasim.output.usd import Clock, write_stage
from terrasim.output.views import Happening, detail_between, on_triangles, views_of
from terrasim.query import sample
from terrasim.scenario.estimate import stage_error
from terrasim.scenario.run import run_scenario
from terrasim.scenario.scenario import parse_scenario
from terrasim.sources.array_source import ArraySource
from terrasim.terrain import Terrain

Table = npt.NDArray[np.float64]


def test_a_stage_follows_edits_of_the_detail(tmp_path: Path) -> None:
    """Triangles stay; before the edit they lie in the base's, after it on base and detail."""
    from pxr import Usd, UsdGeom, UsdValidation

    factor = 4
    with rough_ground(factor) as terrain:
        grid = terrain.grid
        before = terrain.source.posts
        focus = [Span(grid.row + 60, grid.row + 62, grid.col + 100, grid.col + 102)]
        choice = choose_tiles(grid, focus, most_cells=1 << 22)
        box = Span(grid.row + 34, grid.row + 42, grid.col + 120, grid.col + 128)
        tiles = StageTiles(terrain, choice, [box])
        tiles.changed(3.0, [box])
        part = np.random.default_rng(3).integers(-40_000, 40_000, (20, 20)).astype(np.int32)
        add_detail(terrain, part, 35 * factor, 121 * factor)
        tiles.changed(5.0, [box])
        tiles.changed(7.0, [box])
        prims = tiles.prims(0.0, 1.0)
        changed = [prim for prim in prims if len(prim.points) > 1]
        # Post (34, 124) from the first is the corner of two tiles.
        assert {tuple(prim.points) for prim in changed} == {(0.0, 4.0, 5.0)}
        assert 1 <= len(changed) <= 4
        assert tiles.parts == (factor, factor)
        for prim in changed:
            for time in (0.0, 5.0):
                points = prim.points[time] + np.array(prim.origin)
                if time == 0.0:
                    heights = below(terrain, before, points[:, :2])
                else:
                    heights = sample(terrain, points[:, :2]).height
                np.testing.assert_allclose(points[:, 2], heights, rtol=0, atol=5e-5)
            moved = np.abs(prim.points[5.0][:, 2] - prim.points[0.0][:, 2])
            dyed = np.abs(prim.colours[5.0] - prim.colours[0.0]).max(axis=1)
            assert moved.max() > 0.05
            assert (dyed[moved == 0.0] == 0.0).all()
            assert dyed.max() > 0.05
    write_stage(tmp_path / "scene.usdc", prims, None, Clock(0.0, 10.0, 24.0))
    stage = Usd.Stage.Open(str(tmp_path / "scene.usdc"))
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    assert [error.GetErrorAsString() for error in context.Validate(stage)] == []
    for prim in prims:
        mesh = UsdGeom.Mesh.Get(stage, f"/World/Terrain/{prim.name}")
        for time, points in prim.points.items():
            low, high = np.array(mesh.GetExtentAttr().Get(time))
            np.testing.assert_array_equal(low, points.min(axis=0))
            np.testing.assert_array_equal(high, points.max(axis=0))


def below(terrain: Terrain, posts: Any, places: Table) -> Table:
    """Heights of the source's own surface [m]."""
    grid = terrain.grid
    counts = posts(0, grid.row + np.arange(grid.rows), grid.col + np.arange(grid.cols))
    with Terrain(ArraySource(counts, grid)) as plain:
        return np.asarray(sample(plain, places).height)


@pytest.mark.parametrize("finer", [1, 3, 8])
def test_pictures_are_shaded_from_base_and_detail(finer: int) -> None:
    """Values on and between posts, as the surface has them."""
    factor = 4
    with rough_ground(factor) as terrain:
        scatter(terrain)
        grid = terrain.grid
        posts = Span(grid.row + 25, grid.row + 50, grid.col + 50, grid.col + 90)
        counts = terrain.source.posts(
            0, np.arange(posts.row0, posts.row1), np.arange(posts.col0, posts.col1)
        )
        found = on_triangles(to_metres(counts, grid.datum), finer)
        more = detail_between(terrain, posts, finer)
        assert more.any()
        r, c = (np.arange(size) / finer for size in found.shape)
        x = grid.post_x(0) + (posts.col0 + c) * grid.spacing
        y = grid.post_y(0) + (posts.row0 + r) * grid.spacing
        places = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
        expected = sample(terrain, places).height.reshape(found.shape)
        # Places in a world 3e5 m wide are rounded to 6e-11 m, times slopes of some 10.
        np.testing.assert_allclose(found + more, expected, rtol=0, atol=1e-8)


def test_a_close_view_shows_detail_and_what_it_changed() -> None:
    factor = 8
    with rough_ground(factor) as terrain:
        part = np.full((5, 5), 8 * 50_000, np.int32)
        add_detail(terrain, part, 101 * factor, 101 * factor)
        places = np.full((2, 3, 2), 50.5)
        happening = Happening([], places, np.full(3, 0.02))
        close = views_of(terrain, (terrain.grid.row, terrain.grid.col), happening)[-1]
        west, east, south, north = close.box
        assert east - west < 8.0
        assert west < 50.75 < east
        assert south < 50.75 < north
        assert "0.0625 m in the detail" in close.title
        row, col = (
            round((50.75 - close.y) / close.spacing),
            round((50.75 - close.x) / close.spacing),
        )
        x, y = close.x + col * close.spacing, close.y + row * close.spacing
        west_x, south_y = 1e5 - 60 * 0.5, -3e5 - 290 * 0.5
        assert close.heights[row, col] == pytest.approx(
            float(sample(terrain, [[west_x + x, south_y + y]]).height[0]), abs=1e-8
        )


def test_a_run_with_detail_compiles_what_its_plan_names_and_says_what_its_stage_shows(
    tmp_path: Path,
) -> None:
    """A crater in the detail, under balls: its bottom is in the stage, and the balls come to it."""
    from pxr import Usd, UsdGeom

    scene = {
        "terrain": {"kind": "flat", "rows": 80, "cols": 80, "spacing": 1.0, "height": 7.0},
        "detail": {"factor": 8},
        "stamps": [
            {"kind": "crater", "x": 0.3, "y": 0.2, "radius": 1.5, "depth": 0.4, "detail": True}
        ],
        "balls": [{"count": 9, "region": {"size_x": 1.0, "size_y": 1.0}, "radius": 0.05}],
        "run": {"duration_s": 4.0, "dt_s": 0.01, "checked_balls": 0},
        "output": {"usd": True, "picture": True, "usd_cells": 20_000},
    }
    record = run_scenario(parse_scenario(scene), tmp_path, tmp_path / "out")
    assert "terrasim.kernels.balls_detail" in record["plan"]["kernels"]
    assert "terrasim.kernels.balls" not in record["plan"]["kernels"]
    assert (record["stage"]["detail_parts"], record["stage"]["detail_factor"]) == (8, 8)
    stage = Usd.Stage.Open(str(tmp_path / "out" / "scene.usdc"))
    lowest = min(
        float(UsdGeom.Mesh(prim).GetExtentAttr().Get(0.0)[0][2])
        + UsdGeom.Xformable(prim).ComputeLocalToWorldTransform(0.0).ExtractTranslation()[2]
        for prim in stage.Traverse()
        if prim.IsA(UsdGeom.Mesh)
    )
    # The nearest detail post is 0.08 m from the middle of the bowl.
    assert 7.0 - 0.4 <= lowest <= 7.0 - 0.4 + 0.002
    instances = UsdGeom.PointInstancer.Get(stage, "/World/Balls/Instances")
    place = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Balls"))
    origin = place.ComputeLocalToWorldTransform(0.0).ExtractTranslation()
    times = instances.GetPositionsAttr().GetTimeSamples()
    z = np.array(instances.GetPositionsAttr().Get(times[-1]))[:, 2] + origin[2]
    assert (z < 7.0 - 0.1).all()
    assert (z > lowest + 0.05).all()
    assert (tmp_path / "out" / "picture.png").is_file()


def test_a_stage_with_too_little_room_for_its_detail_names_the_remedy() -> None:
    shown = {
        "cells": 9, "level": 0, "error_m": 0.02, "detail_parts": 2, "detail_factor": 8,
    }  # fmt: skip
    note = stage_error(shown).note
    assert "of its detail's 8 cells along a side it shows 2: raise output.usd_cells" in note
    assert "detail" not in stage_error(shown | {"detail_parts": 8}).note
