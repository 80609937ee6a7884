"""The stage of a run: true to the posts, sampled in time where the ground changes alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrasim.scenario.run import run_scenario
from terrasim.scenario.scenario import parse_scenario

SCENE: dict[str, Any] = {
    "terrain": {
        "kind": "sine", "rows": 1500, "cols": 1200, "spacing": 0.5, "amplitude": 4.0,
        "wavelength": 64.0, "wavelength_y": 64.0, "row": 100, "col": -700, "datum": 100.0,
    },
    "stamps": [
        {"kind": "crater", "x": 20.0, "y": 0.0, "radius": 6.0, "depth": 1.0, "rim_height": 0.2},
        {"kind": "crater", "x": -30.0, "y": 9.0, "radius": 6.0, "depth": 1.0, "time_s": 0.4},
        {"kind": "crater", "x": -32.0, "y": 9.0, "radius": 4.0, "depth": 1.0, "time_s": 0.8},
    ],
    "balls": [{"count": 40, "region": {"size_x": 60.0, "size_y": 60.0}, "radius": 0.3}],
    "run": {"duration_s": 1.0, "dt_s": 0.02, "checked_balls": 0},
    "output": {"usd": True, "frames_per_s": 25.0, "usd_cells": 600_000},
}  # fmt: skip


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[Any, dict[str, Any]]:
    """A run's stage and record."""
    from pxr import Usd

    out = tmp_path_factory.mktemp("stage") / "out"
    record = run_scenario(parse_scenario(SCENE), out.parent, out)
    return Usd.Stage.Open(str(out / "scene.usdc")), record


def meshes(stage: Any) -> list[Any]:
    """All tiles."""
    from pxr import UsdGeom

    return [UsdGeom.Mesh(prim) for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh)]


def world_points(mesh: Any, time: float) -> Any:
    """Points of a tile in the world [m]."""
    from pxr import Usd, UsdGeom

    place = UsdGeom.Xformable(mesh).ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    return np.array(mesh.GetPointsAttr().Get(time), np.float64) + np.array(
        place.ExtractTranslation()
    )


def test_the_stage_of_a_run_is_valid(made: tuple[Any, dict[str, Any]]) -> None:
    from pxr import Usd, UsdGeom, UsdValidation

    stage, _ = made
    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    assert [error.GetErrorAsString() for error in context.Validate(stage)] == []
    assert len(meshes(stage)) > 10
    for mesh in meshes(stage):
        points = mesh.GetPointsAttr().Get(Usd.TimeCode.EarliestTime())
        good, why = UsdGeom.Mesh.ValidateTopology(
            mesh.GetFaceVertexIndicesAttr().Get(),
            mesh.GetFaceVertexCountsAttr().Get(),
            len(points),
        )
        assert good, why
        assert mesh.GetExtentAttr().HasAuthoredValue()


def test_points_are_posts_of_the_ground_at_the_time(made: tuple[Any, dict[str, Any]]) -> None:
    """Waves less craters, by their formulas, at the start and at the end."""
    stage, record = made
    anchor_row, anchor_col = record["plan"]["anchor"]
    for time, craters in ((0.0, 1), (25.0, 3)):
        for mesh in meshes(stage):
            x, y, z = world_points(mesh, time).T
            east, north = x - anchor_col * 0.5, y - anchor_row * 0.5
            k = 2.0 * np.pi / 64.0
            ground = 4.0 * np.sin(k * (x + 350.0)) * np.sin(k * (y - 50.0))
            for stamp in SCENE["stamps"][:craters]:
                s = np.hypot(east - stamp["x"], north - stamp["y"]) / stamp["radius"]
                rim, q = stamp.get("rim_height", 0.0), 3.0**-3
                ground += np.where(s <= 1.0, (stamp["depth"] + rim) * s**2 - stamp["depth"], 0.0)
                fall = rim * (np.maximum(s, 1.0) ** -3 - q) / (1.0 - q)
                ground += np.where((s > 1.0) & (s < 3.0), fall, 0.0)
            # A count each for ground and stamps, and float32 of some metres.
            np.testing.assert_allclose(z, ground, atol=3e-5)


def test_only_struck_tiles_have_time_samples(made: tuple[Any, dict[str, Any]]) -> None:
    stage, _ = made
    sampled = [mesh for mesh in meshes(stage) if mesh.GetPointsAttr().GetNumTimeSamples()]
    assert 1 <= len(sampled) <= 4
    for mesh in sampled:
        times = mesh.GetPointsAttr().GetTimeSamples()
        # The craters come at 0.4 s and 0.8 s, in the tenth and twentieth frame.
        assert times == [0.0, 9.0, 10.0, 19.0, 20.0] or times in (
            [0.0, 9.0, 10.0],
            [0.0, 19.0, 20.0],
        )
        assert mesh.GetExtentAttr().GetTimeSamples() == times
        before = np.array(mesh.GetPointsAttr().Get(times[1]))
        np.testing.assert_array_equal(before, np.array(mesh.GetPointsAttr().Get(0.0)))
        after = np.array(mesh.GetPointsAttr().Get(times[2]))
        assert np.abs(after - before).max() > 0.5


def test_balls_in_the_stage_lie_on_its_ground(made: tuple[Any, dict[str, Any]]) -> None:
    """A resting or rolling ball touches the triangle below it: its centre is a radius above."""
    from pxr import Usd, UsdGeom

    stage, record = made
    instancer = UsdGeom.PointInstancer.Get(stage, "/World/Balls/Instances")
    times = instancer.GetPositionsAttr().GetTimeSamples()
    assert times == [float(i) for i in range(26)]
    assert record["frames"] == 26
    place = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Balls"))
    origin = place.ComputeLocalToWorldTransform(Usd.TimeCode.Default()).ExtractTranslation()
    first = np.array(instancer.GetPositionsAttr().Get(0.0), np.float64) + np.array(origin)
    near = np.concatenate([world_points(mesh, 0.0) for mesh in meshes(stage)])
    for x, y, z in first:
        distance = np.hypot(near[:, 0] - x, near[:, 1] - y)
        ground = near[int(distance.argmin()), 2]
        # The nearest post is within 0.36 m, on slopes up to 0.8, under a ball of 0.3 m.
        assert 0.3 - 0.3 < z - ground < 0.3 * 1.3 + 0.36 * 0.8 + 0.1


def test_detail_is_where_things_happen(made: tuple[Any, dict[str, Any]]) -> None:
    stage, record = made
    names = [mesh.GetPrim().GetName() for mesh in meshes(stage)]
    levels = {int(name[1 : name.index("_")]) for name in names}
    assert min(levels) == 0
    assert max(levels) >= 2
    assert record["stage"]["level"] == 0
    assert record["stage"]["error_m"] == 0.0
    assert record["stage"]["cells"] <= 600_000


def test_fewer_cells_make_a_coarser_stage_that_says_so(tmp_path: Path) -> None:
    from pxr import Usd

    scene = SCENE | {"output": SCENE["output"] | {"usd_cells": 50_000}}
    record = run_scenario(parse_scenario(scene), tmp_path, tmp_path / "out")
    assert record["stage"]["level"] > 0
    found = next(one for one in record["errors"] if one["name"] == "levels, stage")
    assert found["metres"] == record["stage"]["error_m"] > 0.0
    assert "usd_cells" in found["note"]
    stage = Usd.Stage.Open(str(tmp_path / "out" / "scene.usdc"))
    assert len(meshes(stage)) > 0


def test_tints_change_with_the_ground(made: tuple[Any, dict[str, Any]]) -> None:
    stage, _ = made
    for mesh in meshes(stage):
        colours = mesh.GetDisplayColorPrimvar().GetAttr()
        assert colours.GetTimeSamples() == mesh.GetPointsAttr().GetTimeSamples()
        assert len(colours.Get(0.0)) == len(mesh.GetPointsAttr().Get(0.0))
