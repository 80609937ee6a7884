"""The terrain, what changed it and what moved on it, as a USD stage.

Each tile is a mesh of its own: points near its origin in float32, the origin in a double-precision
translation. A tile has time samples if a deformation touched it during the run, balls always.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from terrasim.errors import RunError
from terrasim.output.triangles import Triangles

Floats = npt.NDArray[np.float32]
Place = tuple[float, float, float]

BALL_COLOUR = (0.86, 0.33, 0.10)


@dataclass(frozen=True)
class MeshPrim:
    """One tile of ground."""

    name: str
    """Name of its prim."""
    origin: Place
    """World place of the local origin [m]."""
    triangles: Triangles
    """Points of each triangle, int32, shape ``(triangles, 3)``."""
    points: Mapping[float, Floats]
    """Points [m] by time code, float32, shape ``(count, 3)``; one entry for ground at rest."""
    colours: Mapping[float, Floats]
    """Colour of each point by time code, RGB, float32, shape ``(count, 3)``, likewise."""


@dataclass(frozen=True)
class BallPrims:
    """Moving balls around one origin."""

    origin: Place
    """World place of the local origin [m]."""
    radii: Floats
    """Radii [m], float32, shape ``(count,)``."""
    positions: Mapping[float, Floats]
    """Centres relative to the origin [m] by time code, float32, shape ``(count, 3)``."""


@dataclass(frozen=True)
class Clock:
    """Time codes of a stage."""

    start: float
    """First time code."""
    end: float
    """Last time code."""
    per_second: float
    """Time codes in a second."""


def write_stage(
    path: Path,
    meshes: Iterable[MeshPrim],
    balls: BallPrims | None,
    clock: Clock,
    *,
    eye: tuple[Place, Place] | None = None,
    documentation: str = "",
) -> None:
    """Write a stage.

    Args:
        path: File to make, ``.usdc`` or ``.usda``.
        meshes: Tiles of ground.
        balls: Balls, if there are any.
        clock: Time codes.
        eye: Where a camera stands and what it looks at [m].
        documentation: What the stage shows, in a sentence or two.

    Raises:
        RunError: If the file cannot be written.
    """
    from pxr import Tf, Usd, UsdGeom

    try:
        stage = Usd.Stage.CreateNew(str(path))
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        stage.SetStartTimeCode(clock.start)
        stage.SetEndTimeCode(clock.end)
        stage.SetTimeCodesPerSecond(clock.per_second)
        stage.SetFramesPerSecond(clock.per_second)
        stage.SetMetadata("documentation", documentation)
        world = UsdGeom.Xform.Define(stage, "/World")
        stage.SetDefaultPrim(world.GetPrim())
        UsdGeom.Scope.Define(stage, "/World/Terrain")
        for mesh in meshes:
            _add_mesh(stage, mesh)
        if balls is not None:
            _add_balls(stage, balls)
        _add_lights(stage)
        if eye is not None:
            _add_camera(stage, *eye)
        saved = stage.GetRootLayer().Save()
    except Tf.ErrorException as error:
        reason = " ".join(str(error).split())
        raise RunError(f"{path}: the stage cannot be written ({reason[:200]})") from None
    if not saved:
        raise RunError(f"{path}: the stage cannot be written; make room or choose another folder")


def prim_name(level: int, row: int, col: int) -> str:
    """Name of a tile's prim: a minus sign is no part of a name."""
    return f"L{level}_R{row}_C{col}".replace("-", "m")


def _add_mesh(stage: Any, mesh: MeshPrim) -> None:
    from pxr import Gf, UsdGeom, Vt

    prim = UsdGeom.Mesh.Define(stage, f"/World/Terrain/{mesh.name}")
    UsdGeom.XformCommonAPI(prim).SetTranslate(Gf.Vec3d(*mesh.origin))
    counts = np.full(len(mesh.triangles), 3, np.int32)
    prim.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(counts))
    prim.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(mesh.triangles.reshape(-1)))
    # The triangles are the surface; nothing is to be smoothed.
    prim.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    _author(prim.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex), mesh.colours)
    _author(prim.CreatePointsAttr(), mesh.points)
    extents = {time: _extent(points) for time, points in mesh.points.items()}
    _author(prim.CreateExtentAttr(), extents)


def _author(attribute: Any, values: Mapping[float, Any]) -> None:
    """Set an attribute's one value, or its time samples."""
    from pxr import Vt

    for time, value in sorted(values.items()):
        array = value
        if isinstance(value, np.ndarray):
            array = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(value))
        if len(values) == 1:
            attribute.Set(array)
        else:
            attribute.Set(array, time)


def _add_balls(stage: Any, balls: BallPrims) -> None:
    from pxr import Gf, UsdGeom, Vt

    place = UsdGeom.Xform.Define(stage, "/World/Balls")
    UsdGeom.XformCommonAPI(place).SetTranslate(Gf.Vec3d(*balls.origin))
    instancer = UsdGeom.PointInstancer.Define(stage, "/World/Balls/Instances")
    UsdGeom.Scope.Define(stage, "/World/Balls/Instances/Prototypes")
    ball = UsdGeom.Sphere.Define(stage, "/World/Balls/Instances/Prototypes/Ball")
    ball.CreateRadiusAttr(1.0)
    ball.CreateExtentAttr(_extent(np.array([[-1.0] * 3, [1.0] * 3], np.float32)))
    ball.CreateDisplayColorAttr([Gf.Vec3f(*BALL_COLOUR)])
    instancer.CreatePrototypesRel().SetTargets([ball.GetPath()])
    count = len(balls.radii)
    instancer.CreateProtoIndicesAttr(Vt.IntArray.FromNumpy(np.zeros(count, np.int32)))
    scales = np.repeat(balls.radii[:, None], 3, axis=1).astype(np.float32)
    instancer.CreateScalesAttr(Vt.Vec3fArray.FromNumpy(scales))
    extents = {
        time: _extent(np.concatenate([centres - scales, centres + scales]))
        for time, centres in balls.positions.items()
    }
    _author(instancer.CreatePositionsAttr(), balls.positions)
    _author(instancer.CreateExtentAttr(), extents)


def _add_lights(stage: Any) -> None:
    from pxr import Gf, UsdGeom, UsdLux

    UsdGeom.Xform.Define(stage, "/World/Lights")
    sun = UsdLux.DistantLight.Define(stage, "/World/Lights/Sun")
    sun.CreateIntensityAttr(2.5)
    # From the north-west and 40 degrees up, as the picture's hillshade has it.
    UsdGeom.XformCommonAPI(sun).SetRotate(Gf.Vec3f(50.0, 0.0, -135.0))
    sky = UsdLux.DomeLight.Define(stage, "/World/Lights/Sky")
    sky.CreateIntensityAttr(0.35)


def _add_camera(stage: Any, eye: Place, target: Place) -> None:
    from pxr import Gf, UsdGeom

    camera = UsdGeom.Camera.Define(stage, "/World/Camera")
    view = Gf.Matrix4d().SetLookAt(Gf.Vec3d(*eye), Gf.Vec3d(*target), Gf.Vec3d(0.0, 0.0, 1.0))
    camera.AddTransformOp().Set(view.GetInverse())
    distance = float(np.linalg.norm(np.subtract(eye, target)))
    camera.CreateClippingRangeAttr(Gf.Vec2f(distance * 1e-3, distance * 1e4))
    camera.CreateFocusDistanceAttr(distance)


def _extent(points: Floats) -> Any:
    """Smallest and largest corner of some points; of none, the origin."""
    from pxr import Gf, Vt

    if len(points) == 0:
        return Vt.Vec3fArray([Gf.Vec3f(0.0), Gf.Vec3f(0.0)])
    low, high = points.min(axis=0), points.max(axis=0)
    return Vt.Vec3fArray.FromNumpy(np.stack([low, high]).astype(np.float32))


def sampled(
    rest: Floats, changes: Sequence[tuple[float, Floats]], start: float, step: float
) -> dict[float, Floats]:
    """Time samples of points that change at certain times.

    A renderer interpolates between samples, so before each change stands one with what was there.

    Args:
        rest: Points at the beginning.
        changes: Time code and points from then on, in order.
        start: The stage's first time code.
        step: Time codes between the sample before a change and the change.
    """
    if not changes:
        return {start: rest}
    found = {start: rest}
    before = rest
    for time, points in changes:
        found.setdefault(max(start, time - step), before)
        found[time] = points
        before = points
    return found
