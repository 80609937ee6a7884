"""The stage: valid, its extents right, and time samples where something changes alone."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from terrasim.errors import RunError
from terrasim.output.usd import BallPrims, Clock, MeshPrim, prim_name, sampled, write_stage

CLOCK = Clock(0.0, 50.0, 25.0)
SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float32)
HALVES = np.array([[0, 1, 2], [0, 2, 3]], np.int32)


def square(name: str, east: float = 0.0, changes: list[Any] | None = None) -> MeshPrim:
    """Two triangles of ground."""
    points = sampled(SQUARE, changes or [], CLOCK.start, 1.0)
    return MeshPrim(name, (east, 0.0, 0.0), HALVES, points, {0.0: np.ones((4, 3), np.float32)})


def dropped(count: int = 3) -> BallPrims:
    """Balls that fall by a metre a frame."""
    rng = np.random.default_rng(1)
    start = rng.uniform(0, 9, (count, 3)).astype(np.float32)
    fall = np.array([0, 0, 1], np.float32)
    positions = {float(t): start - np.float32(t) * fall for t in range(5)}
    return BallPrims((1e7, 0.0, 0.0), np.full(count, 0.25, np.float32), positions)


def written(path: Path, meshes: list[MeshPrim], balls: BallPrims | None) -> Any:
    """A stage read back from its file."""
    from pxr import Usd

    eye = ((0.0, -50.0, 30.0), (0.0, 0.0, 0.0))
    write_stage(path, meshes, balls, CLOCK, eye=eye, documentation="two tiles")
    return Usd.Stage.Open(str(path))


def complaints(stage: Any) -> list[str]:
    """What USD's own validators say against a stage."""
    from pxr import UsdValidation

    registry = UsdValidation.ValidationRegistry()
    context = UsdValidation.ValidationContext(registry.GetOrLoadAllValidators())
    return [str(error.GetErrorAsString()) for error in context.Validate(stage)]


def test_a_stage_passes_usd_s_validators(tmp_path: Path) -> None:
    raised = SQUARE + np.float32(0.5)
    meshes = [square("a"), square("b", 1.0, [(20.0, raised)])]
    stage = written(tmp_path / "scene.usdc", meshes, dropped())
    assert complaints(stage) == []


def test_the_validators_are_at_work() -> None:
    from pxr import Usd, UsdGeom

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.Mesh.Define(stage, "/World")
    assert complaints(stage) != []


def test_every_mesh_has_a_valid_topology_and_its_true_extent(tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom

    raised = SQUARE + np.float32(0.5)
    meshes = [square("a"), square("b", 1.0, [(20.0, raised)])]
    stage = written(tmp_path / "scene.usdc", meshes, None)
    found = [UsdGeom.Mesh(p) for p in stage.Traverse() if p.IsA(UsdGeom.Mesh)]
    assert len(found) == 2
    for mesh in found:
        for time in (Usd.TimeCode.EarliestTime(), 19.0, 20.0, 50.0):
            points = mesh.GetPointsAttr().Get(time)
            good, why = UsdGeom.Mesh.ValidateTopology(
                mesh.GetFaceVertexIndicesAttr().Get(),
                mesh.GetFaceVertexCountsAttr().Get(),
                len(points),
            )
            assert good, why
            extent = np.array(mesh.GetExtentAttr().Get(time))
            np.testing.assert_array_equal(extent, UsdGeom.PointBased.ComputeExtent(points))


def test_only_what_changes_has_time_samples(tmp_path: Path) -> None:
    from pxr import UsdGeom

    raised = SQUARE + np.float32(0.5)
    meshes = [square("still"), square("struck", 1.0, [(20.0, raised)])]
    stage = written(tmp_path / "scene.usdc", meshes, None)
    still = UsdGeom.Mesh.Get(stage, "/World/Terrain/still").GetPointsAttr()
    struck = UsdGeom.Mesh.Get(stage, "/World/Terrain/struck").GetPointsAttr()
    assert still.GetNumTimeSamples() == 0
    assert struck.GetTimeSamples() == [0.0, 19.0, 20.0]


def test_ground_rests_until_the_sample_before_a_change() -> None:
    first, second = SQUARE + np.float32(1), SQUARE + np.float32(2)
    found = sampled(SQUARE, [(20.0, first), (20.5, second)], 0.0, 1.0)
    assert sorted(found) == [0.0, 19.0, 19.5, 20.0, 20.5]
    assert found[19.0] is SQUARE
    assert found[20.0] is first
    assert found[20.5] is second


def test_a_change_at_the_start_leaves_no_sample_before_it() -> None:
    first = SQUARE + np.float32(1)
    found = sampled(SQUARE, [(0.0, first)], 0.0, 1.0)
    assert list(found) == [0.0]
    assert found[0.0] is first


def test_balls_are_instances_with_an_extent_that_holds_their_radii(tmp_path: Path) -> None:
    from pxr import UsdGeom

    balls = dropped()
    stage = written(tmp_path / "scene.usdc", [square("a")], balls)
    instancer = UsdGeom.PointInstancer.Get(stage, "/World/Balls/Instances")
    assert instancer.GetPositionsAttr().GetTimeSamples() == [0.0, 1.0, 2.0, 3.0, 4.0]
    for time, centres in balls.positions.items():
        np.testing.assert_array_equal(np.array(instancer.GetPositionsAttr().Get(time)), centres)
        low, high = np.array(instancer.GetExtentAttr().Get(time))
        np.testing.assert_array_equal(low, centres.min(axis=0) - np.float32(0.25))
        np.testing.assert_array_equal(high, centres.max(axis=0) + np.float32(0.25))


def test_the_place_of_balls_keeps_double_precision(tmp_path: Path) -> None:
    from pxr import Usd, UsdGeom

    stage = written(tmp_path / "scene.usdc", [square("a")], dropped())
    place = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Balls"))
    matrix = place.ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    assert matrix.ExtractTranslation()[0] == 1e7


def test_the_stage_says_its_units_axis_and_time(tmp_path: Path) -> None:
    from pxr import UsdGeom

    stage = written(tmp_path / "scene.usdc", [square("a")], None)
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0
    assert stage.GetDefaultPrim().GetPath() == "/World"
    assert stage.GetStartTimeCode() == 0.0
    assert stage.GetEndTimeCode() == 50.0
    assert stage.GetTimeCodesPerSecond() == 25.0


def test_the_sun_shines_from_the_north_west() -> None:
    from pxr import Gf, Usd, UsdGeom

    from terrasim.output.usd import _add_lights

    stage = Usd.Stage.CreateInMemory()
    UsdGeom.Xform.Define(stage, "/World")
    _add_lights(stage)
    sun = UsdGeom.Xformable(stage.GetPrimAtPath("/World/Lights/Sun"))
    turn = sun.ComputeLocalToWorldTransform(Usd.TimeCode.Default())
    ray = turn.TransformDir(Gf.Vec3d(0, 0, -1))
    assert ray[0] > 0.4
    assert ray[1] < -0.4
    assert ray[2] < -0.5


def test_a_minus_sign_is_no_part_of_a_prim_s_name() -> None:
    assert prim_name(3, -2, 7) == "L3_Rm2_C7"


def test_a_stage_that_cannot_be_written_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(RunError, match=r"scene\.usdc") as caught:
        write_stage(tmp_path / "file" / "scene.usdc", [], None, CLOCK)
    assert "\n" not in str(caught.value)
