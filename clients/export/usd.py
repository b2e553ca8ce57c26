# SPDX-License-Identifier: MIT
"""Exports a log as a USD stage (.usdc) for usdview, Blender, Houdini, Omniverse, by usd-core.

/World/OBJECT/surface is a Mesh (the skin of an object that has one), /World/OBJECT/elements a TetMesh of the purpose
"guide", so that renderers draw it only if asked to; their points are time samples, and so are their corners where the
mesh changed. /World/OBSTACLE is a Mesh with time samples of its transform. Metres, y up.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from clients.export.box import box_of
from clients.log.atomic_file import atomic_file
from clients.log.frames import Mesh
from clients.log.obstacles import Obstacle, Pose
from clients.log.reader import Log
from clients.viewer.film import BODIES, STONE
from clients.viewer.obstacle_surface import obstacle_surface
from clients.viewer.surface import Surface

MOST_RATE = 100_000.0  # time codes in a second


def write_usd(log: Log, names: Sequence[str], to: Path, progress: Callable[[float], None] = lambda _: None) -> None:
    """Writes objects and all obstacles. A time code is the time between two frames, so that frames have whole numbers.

    Frames with NaN or infinite positions are left out, which is said on stderr. Raises OSError.
    """
    from pxr import Tf, Usd, UsdGeom

    names = [name for name in names if log.object_log(name).frames]
    paths = _paths([*names, *log.obstacles])
    with atomic_file(to) as part:
        part.touch()  # a bad path is reported before the conversion; USD would make its folders
        stage = Usd.Stage.CreateInMemory()
        UsdGeom.SetStageMetersPerUnit(stage, 1.0)
        UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
        rate = _rate(log, names)
        stage.SetTimeCodesPerSecond(rate)
        stage.SetFramesPerSecond(rate)
        stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/World").GetPrim())
        done, skipped, end = 0, 0, 0.0
        for number, name in enumerate(names):
            body = _Body(stage, paths[name], BODIES[number % len(BODIES)] / 255)
            for frame in log.frames(name):
                done, end = done + 1, max(end, frame.time)
                progress(done)
                if np.isfinite(frame.x).all():
                    body.frame(log.mesh(name, frame.epoch), frame.x, frame.time * rate)
                else:
                    skipped += 1
        box = box_of(log, names)
        for obstacle in log.obstacles.values():
            _write_obstacle(stage, paths[obstacle.name], log, obstacle, box, rate)
        stage.SetStartTimeCode(0.0)
        stage.SetEndTimeCode(end * rate)
        try:
            stage.GetRootLayer().Export(str(part))
        except Tf.ErrorException as error:  # the disk is full
            raise OSError(str(error).strip()) from None
    if skipped:
        print(f"{log.path}: {skipped} frames with NaN or infinite positions are left out", file=sys.stderr)


def _paths(names: Sequence[str]) -> dict[str, str]:
    """Returns a path for each name, in which what a name may not hold in USD is an underscore."""
    from pxr import Tf

    found: dict[str, str] = {}
    for name in names:
        path = f"/World/{Tf.MakeValidIdentifier(name)}"
        while path in found.values():  # "left.leg" beside "left_leg"
            path += "_"
        found[name] = path
    return found


def _rate(log: Log, names: Sequence[str]) -> float:
    """Returns the frames in a second of the object that has most of them."""
    most = max(names, key=lambda name: len(log.object_log(name).frames))
    count = len(log.object_log(most).frames)
    length = log.frame(most, -1).time - log.frame(most, 0).time if count > 1 else 0.0
    return min(round((count - 1) / length, 6), MOST_RATE) if length > 0 else 24.0


class _Body:
    """The prims of an object. color (3,): between 0 and 1."""

    def __init__(self, stage: Any, path: str, color: NDArray) -> None:
        from pxr import UsdGeom, Vt

        UsdGeom.Xform.Define(stage, path)
        self._surface = UsdGeom.Mesh.Define(stage, f"{path}/surface")
        self._surface.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        self._elements = UsdGeom.TetMesh.Define(stage, f"{path}/elements")
        self._elements.CreatePurposeAttr(UsdGeom.Tokens.guide)
        for prim in (self._surface, self._elements):
            prim.CreateDisplayColorAttr(Vt.Vec3fArray.FromNumpy(color.astype(np.float32)[None]))
        self._mesh: Mesh | None = None
        self._drawn: Surface | None = None

    def frame(self, mesh: Mesh, x: NDArray, code: float) -> None:
        """Writes positions x (n, 3) [m] at a time code, and the corners of a mesh that is new."""
        from pxr import UsdGeom, Vt

        if self._mesh is None or self._mesh.epoch != mesh.epoch:
            first = self._mesh is None
            self._mesh, self._drawn = mesh, Surface(mesh, "displacement")
            self._corners(self._drawn, mesh, None if first else code)
        assert self._drawn is not None
        for prim, points in ((self._surface, self._drawn.points(x)), (self._elements, x)):
            values = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points, np.float32))
            prim.CreatePointsAttr().Set(values, code)
            prim.CreateExtentAttr().Set(UsdGeom.PointBased.ComputeExtent(values), code)

    def _corners(self, drawn: Surface, mesh: Mesh, code: float | None) -> None:
        """Writes corners of triangles and elements; with a time code if they are not the first ones."""
        from pxr import Usd, Vt

        triangles, outer = drawn.triangles.astype(np.int32), mesh.triangles.astype(np.int32)
        values = {
            self._surface.CreateFaceVertexCountsAttr(): Vt.IntArray.FromNumpy(np.full(len(triangles), 3, np.int32)),
            self._surface.CreateFaceVertexIndicesAttr(): Vt.IntArray.FromNumpy(np.ascontiguousarray(triangles.ravel())),
            self._elements.CreateTetVertexIndicesAttr(): Vt.Vec4iArray.FromNumpy(
                np.ascontiguousarray(mesh.tets, np.int32)
            ),
            self._elements.CreateSurfaceFaceVertexIndicesAttr(): Vt.Vec3iArray.FromNumpy(np.ascontiguousarray(outer)),
        }
        for attribute, value in values.items():
            if code is not None and attribute.GetNumTimeSamples() == 0:  # what held so far holds before this time only
                attribute.Set(attribute.Get(), 0.0)
            attribute.Set(value, Usd.TimeCode.Default() if code is None else code)


def _write_obstacle(
    stage: Any, path: str, log: Log, obstacle: Obstacle, box: tuple[NDArray, NDArray], rate: float
) -> None:
    from pxr import UsdGeom, Vt

    vertices, triangles = obstacle_surface(obstacle, *box)
    if not len(vertices):
        return
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    points = Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(vertices, np.float32))
    mesh.CreatePointsAttr(points)
    mesh.CreateExtentAttr(UsdGeom.PointBased.ComputeExtent(points))
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(triangles), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(np.ascontiguousarray(triangles.ravel(), np.int32)))
    mesh.CreateDisplayColorAttr(Vt.Vec3fArray.FromNumpy(np.array([STONE], np.float32) / 255))
    transform = mesh.AddTransformOp()
    transform.Set(_matrix(obstacle.start))
    for frame in log.poses.get(obstacle.name, ()):
        transform.Set(_matrix(frame.pose), frame.time * rate)


def _matrix(pose: Pose) -> Any:
    """Returns a pose as USD has it: points are rows."""
    from pxr import Gf

    matrix = np.eye(4)
    matrix[:3, :3], matrix[3, :3] = pose.matrix().T, pose.position
    return Gf.Matrix4d(*matrix.ravel().tolist())
