# SPDX-License-Identifier: MIT
"""Files for ParaView, USD tools and films: all objects of a log in one call, read back by readers that are not ours."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import imageio_ffmpeg
import numpy as np
import pytest
from pxr import Usd, UsdGeom

from clients.errors import BadInput, ClientError
from clients.export.export import export
from clients.export.mp4 import write_mp4
from clients.log.reader import Log
from clients.log.von_mises import StressField
from clients.viewer.surface import Surface
from protocol import messages_pb2 as pb
from sim_server.recording.recorder import Recorder
from tests.clients.test_foxglove import corners, decoded
from tests.sample_contact import record_contact
from tests.sample_run import DT, REST, TETS, TRIANGLES, header, positions, record, scene, state, topology, velocities

STEPS = 9
SKIN_NODES = np.array([[0, 1, 2, 3], [1, 2, 3, 4], [0, 1, 2, 3]], np.int32)
SKIN_WEIGHTS = np.array([[0.25, 0.25, 0.25, 0.25], [0.5, 0.5, 0, 0], [1.5, 0.5, -0.5, -0.5]])
SKIN_TRIANGLES = np.array([[0, 1, 2]], np.int32)


@pytest.fixture
def log(tmp_path: Path):
    with Log(record(tmp_path / "run.mcap", STEPS, ("beam", "liver"))) as opened:
        yield opened


@pytest.fixture
def cut_log(tmp_path: Path):
    """From step 2 on without the second element, from step 4 on another mesh with one node more."""
    more = np.vstack([REST, [[2, 2, 2]]])
    removed = pb.Topology(
        header=header("beam"), nodes=len(REST), cut=1, removed=np.array([1], "<i4").tobytes(),
        triangles=TRIANGLES[:4].astype("<i4").tobytes(),
    )  # fmt: skip
    with Recorder(tmp_path / "cut.mcap") as recorder:
        recorder.scene(scene(["beam"]))
        recorder.topology(topology("beam"))
        for step in range(2):
            recorder.state(state("beam", step), block=True)
        recorder.topology(removed)
        for step in range(2, 4):
            message = state("beam", step)
            message.cut = 1
            recorder.state(message, block=True)
        recorder.topology(topology("beam", 5, more))
        for step in range(4, 6):
            recorder.state(state("beam", step, 5, more), block=True)
    with Log(tmp_path / "cut.mcap") as opened:
        yield opened


@pytest.fixture
def skinned(tmp_path: Path):
    message = topology("beam")
    message.skin_nodes, message.skin_triangles = SKIN_NODES.tobytes(), SKIN_TRIANGLES.tobytes()
    message.skin_weights = SKIN_WEIGHTS.tobytes()
    with Recorder(tmp_path / "skinned.mcap") as recorder:
        recorder.scene(scene(["beam"]))
        recorder.topology(message)
        for step in range(3):
            recorder.state(state("beam", step), block=True)
    with Log(tmp_path / "skinned.mcap") as opened:
        yield opened


def vertices(step: int) -> np.ndarray:
    return np.einsum("sc,scd->sd", SKIN_WEIGHTS, positions(step)[SKIN_NODES])


class ByVtk:
    """A .vtkhdf as VTK's own reader has it: grids by name at a time."""

    def __init__(self, path: Path) -> None:
        self._vtk = pytest.importorskip("vtk")
        self._reader = self._vtk.vtkHDFReader()
        self._reader.SetFileName(str(path))

    def at(self, time: float) -> dict[str, Any]:
        # Through a filter, as a program asks: a reader that was asked for information alone forgets the times of blocks
        self._reader.UpdateTimeStep(time)
        found = self._reader.GetOutputDataObject(0)
        assert self._reader.GetTimeValue() == pytest.approx(time)
        if found.IsA("vtkUnstructuredGrid"):
            return {"": found}
        name = self._vtk.vtkCompositeDataSet.NAME()
        return {
            found.GetMetaData(k).Get(name): found.GetPartitionedDataSet(k).GetPartition(0)
            for k in range(found.GetNumberOfPartitionedDataSets())
        }


def points_of(grid: Any) -> np.ndarray:
    from vtk.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(grid.GetPoints().GetData())


def array_of(data: Any, name: str) -> np.ndarray:
    from vtk.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(data.GetArray(name))


def cells_of(grid: Any) -> np.ndarray:
    from vtk.util.numpy_support import vtk_to_numpy

    return vtk_to_numpy(grid.GetCells().GetConnectivityArray()).reshape(grid.GetNumberOfCells(), -1)


def test_vtk_reads_all_objects_at_every_time(log: Log, tmp_path: Path) -> None:
    assert export(log, None, tmp_path / "all.vtkhdf") == [tmp_path / "all.vtkhdf"]
    reader = ByVtk(tmp_path / "all.vtkhdf")
    stress = StressField(REST, TETS, np.full(2, 1e5), np.full(2, 0.25))
    for step in (0, 5, 2, STEPS):
        grids = reader.at(step * DT)
        assert set(grids) == {"beam", "liver"}
        for grid in grids.values():
            np.testing.assert_array_equal(points_of(grid), positions(step))
            np.testing.assert_array_equal(cells_of(grid), TETS)
            data = grid.GetPointData()
            np.testing.assert_allclose(array_of(data, "displacement"), positions(step) - REST, atol=1e-7)
            np.testing.assert_array_equal(array_of(data, "velocity"), velocities(step))
            np.testing.assert_allclose(array_of(data, "von_mises"), stress.nodes(positions(step)), rtol=1e-5)
            np.testing.assert_array_equal(array_of(grid.GetCellData(), "young"), np.full(2, 1e5))


def test_vtk_reads_a_vtu_and_its_skin(skinned: Log, tmp_path: Path) -> None:
    vtk = pytest.importorskip("vtk")
    export(skinned, None, tmp_path / "beam.vtu")
    for name, points, cells in (("beam", positions(2), TETS), ("beam_skin", vertices(2), SKIN_TRIANGLES)):
        reader = vtk.vtkXMLUnstructuredGridReader()
        reader.SetFileName(str(tmp_path / f"{name}.vtu"))
        reader.Update()
        np.testing.assert_allclose(points_of(reader.GetOutput()), points, atol=1e-14)
        np.testing.assert_array_equal(cells_of(reader.GetOutput()), cells)


def test_a_vtkhdf_has_elements_once_and_frames_of_one_object(log: Log, tmp_path: Path) -> None:
    export(log, "beam", tmp_path / "beam.vtkhdf")
    with h5py.File(tmp_path / "beam.vtkhdf") as file:
        root = file["VTKHDF"]
        assert root.attrs["Type"] == b"UnstructuredGrid" and root["Steps"].attrs["NSteps"] == STEPS + 1
        assert root["Connectivity"].shape == (TETS.size,) and root["Points"].shape == ((STEPS + 1) * len(REST), 3)
        np.testing.assert_allclose(root["Steps/Values"], np.arange(STEPS + 1) * DT)
    grid = ByVtk(tmp_path / "beam.vtkhdf").at(4 * DT)[""]
    np.testing.assert_array_equal(points_of(grid), positions(4))


def test_a_vtkhdf_follows_cuts(cut_log: Log, tmp_path: Path) -> None:
    export(cut_log, None, tmp_path / "cut.vtkhdf")
    reader = ByVtk(tmp_path / "cut.vtkhdf")
    counts = [
        (grid.GetNumberOfPoints(), grid.GetNumberOfCells()) for k in range(6) for grid in reader.at(k * DT).values()
    ]
    assert counts == [(5, 2)] * 2 + [(5, 1)] * 2 + [(6, 2)] * 2
    np.testing.assert_array_equal(cells_of(reader.at(3 * DT)[""]), TETS[:1])
    np.testing.assert_array_equal(points_of(reader.at(5 * DT)[""])[5], [2 * 1.05, 2, 2])


def test_a_vtkhdf_has_skins_as_blocks_of_their_own(skinned: Log, tmp_path: Path) -> None:
    export(skinned, None, tmp_path / "skinned.vtkhdf")
    grids = ByVtk(tmp_path / "skinned.vtkhdf").at(2 * DT)
    assert set(grids) == {"beam", "beam_skin"}
    np.testing.assert_allclose(points_of(grids["beam_skin"]), vertices(2), atol=1e-14)
    np.testing.assert_array_equal(cells_of(grids["beam_skin"]), SKIN_TRIANGLES)


def test_an_object_without_a_frame_at_a_time_stays_as_it_was(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.scene(scene(["beam", "liver"]))
        for name in ("beam", "liver"):
            recorder.topology(topology(name))
        for step in range(4):
            recorder.state(state("beam", step), block=True)
            if step != 2:
                recorder.state(state("liver", step), block=True)
    with Log(tmp_path / "run.mcap") as log:
        export(log, None, tmp_path / "all.vtkhdf")
    reader = ByVtk(tmp_path / "all.vtkhdf")
    for step, shown in ((1, 1), (2, 1), (3, 3)):
        grids = reader.at(step * DT)
        np.testing.assert_array_equal(points_of(grids["beam"]), positions(step))
        np.testing.assert_array_equal(points_of(grids["liver"]), positions(shown))


def test_usd_has_surfaces_and_elements_of_all_objects(log: Log, tmp_path: Path) -> None:
    assert export(log, None, tmp_path / "all.usdc") == [tmp_path / "all.usdc"]
    stage = Usd.Stage.Open(str(tmp_path / "all.usdc"))
    assert UsdGeom.GetStageMetersPerUnit(stage) == 1.0 and UsdGeom.GetStageUpAxis(stage) == UsdGeom.Tokens.y
    assert stage.GetDefaultPrim().GetPath() == "/World" and stage.GetTimeCodesPerSecond() == pytest.approx(1 / DT)
    assert (stage.GetStartTimeCode(), stage.GetEndTimeCode()) == (0, pytest.approx(STEPS))
    for name in ("beam", "liver"):
        surface = UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}/surface"))
        elements = UsdGeom.TetMesh(stage.GetPrimAtPath(f"/World/{name}/elements"))
        assert surface.GetSubdivisionSchemeAttr().Get() == "none"
        assert surface.GetPointsAttr().GetTimeSamples() == pytest.approx(range(STEPS + 1))
        np.testing.assert_array_equal(np.reshape(surface.GetFaceVertexIndicesAttr().Get(), (-1, 3)), TRIANGLES)
        np.testing.assert_array_equal(np.array(elements.GetTetVertexIndicesAttr().Get()), TETS)
        assert surface.GetFaceVertexIndicesAttr().GetNumTimeSamples() == 0
        for code in surface.GetPointsAttr().GetTimeSamples():
            expected = positions(round(code)).astype(np.float32)
            np.testing.assert_array_equal(np.array(surface.GetPointsAttr().Get(code)), expected)
            np.testing.assert_array_equal(np.array(elements.GetPointsAttr().Get(code)), expected)
            extent = np.array(surface.GetExtentAttr().Get(code))
            np.testing.assert_array_equal(extent, [expected.min(axis=0), expected.max(axis=0)])
        valid, reason = UsdGeom.Mesh.ValidateTopology(
            surface.GetFaceVertexIndicesAttr().Get(), surface.GetFaceVertexCountsAttr().Get(), len(REST)
        )
        assert valid, reason


def test_usd_follows_cuts_and_shows_skins(cut_log: Log, skinned: Log, tmp_path: Path) -> None:
    export(cut_log, None, tmp_path / "cut.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "cut.usdc"))
    surface = UsdGeom.Mesh(stage.GetPrimAtPath("/World/beam/surface"))
    elements = UsdGeom.TetMesh(stage.GetPrimAtPath("/World/beam/elements"))
    counts = [
        (len(elements.GetTetVertexIndicesAttr().Get(k)), len(elements.GetPointsAttr().Get(k)))
        for k in surface.GetPointsAttr().GetTimeSamples()
    ]
    assert counts == [(2, 5)] * 2 + [(1, 5)] * 2 + [(2, 6)] * 2
    for index, code in enumerate(surface.GetPointsAttr().GetTimeSamples()):
        drawn = Surface(cut_log.mesh("beam", cut_log.objects["beam"].epochs[index]), "displacement")
        corners = np.reshape(surface.GetFaceVertexIndicesAttr().Get(code), (-1, 3))
        np.testing.assert_array_equal(corners, drawn.triangles)
        assert len(surface.GetFaceVertexCountsAttr().Get(code)) == len(corners)
    export(skinned, None, tmp_path / "skinned.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "skinned.usdc"))
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/World/beam/surface")).GetPointsAttr().Get(2)
    np.testing.assert_allclose(np.array(points), vertices(2), atol=1e-6)


def test_foxglove_follows_cuts_and_shows_skins(cut_log: Log, skinned: Log, tmp_path: Path) -> None:
    export(cut_log, None, tmp_path / "cut.foxglove.mcap")
    entities = [update.entities[0] for _, _, update in decoded(tmp_path / "cut.foxglove.mcap")["/bodies"]]
    for index, entity in enumerate(entities):
        drawn = Surface(cut_log.mesh("beam", cut_log.objects["beam"].epochs[index]), "displacement")
        points, triangles = corners(entity)
        np.testing.assert_array_equal(triangles, drawn.triangles)
        assert len(points) == len(drawn.nodes)
    assert len(entities) == 6
    export(skinned, None, tmp_path / "skinned.foxglove.mcap")
    _, _, update = decoded(tmp_path / "skinned.foxglove.mcap")["/bodies"][2]
    np.testing.assert_allclose(corners(update.entities[0])[0], vertices(2), atol=1e-6)


def test_names_that_usd_does_not_allow(tmp_path: Path) -> None:
    with Log(record(tmp_path / "run.mcap", 2, ("left_leg", "left.leg"))) as log:
        export(log, None, tmp_path / "run.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    for name in ("left_leg", "left_leg_"):
        assert len(UsdGeom.Mesh(stage.GetPrimAtPath(f"/World/{name}/surface")).GetPointsAttr().GetTimeSamples()) == 3


def test_usd_moves_obstacles(tmp_path: Path) -> None:
    with Log(record_contact(tmp_path / "run.mcap", 5)) as log:
        export(log, None, tmp_path / "run.usdc")
    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    tool = UsdGeom.Mesh(stage.GetPrimAtPath("/World/tool"))
    for step in range(6):
        matrix = np.array(tool.ComputeLocalToWorldTransform(step))
        np.testing.assert_allclose(matrix[3], [0, -1 + step / 8, 0, 1], atol=1e-12)
        np.testing.assert_allclose(np.array([0, 1, 0, 0]) @ matrix, [0, 0, 1, 0], atol=1e-12)  # a quarter turn about x
    assert len(UsdGeom.Mesh(stage.GetPrimAtPath("/World/floor")).GetPointsAttr().Get()) == 4
    assert len(tool.GetPointsAttr().Get()) > 100


def test_a_frame_that_is_not_finite_is_left_out_of_usd(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    broken = state("beam", 1)
    broken.x = np.full((5, 3), np.nan).tobytes()
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.topology(topology("beam"))
        recorder.state(state("beam", 0), block=True)
        recorder.state(broken, block=True)
        recorder.state(state("beam", 2), block=True)
    with Log(tmp_path / "run.mcap") as log:
        export(log, None, tmp_path / "run.usdc")
        export(log, None, tmp_path / "run.vtkhdf")
    assert "1 frames with NaN or infinite positions are left out" in capsys.readouterr().err
    stage = Usd.Stage.Open(str(tmp_path / "run.usdc"))
    points = UsdGeom.Mesh(stage.GetPrimAtPath("/World/beam/surface")).GetPointsAttr()
    assert points.GetTimeSamples() == pytest.approx([0, 2])
    with h5py.File(tmp_path / "run.vtkhdf") as file:
        assert np.isnan(file["VTKHDF/Points"][5:10]).all() and np.isfinite(file["VTKHDF/Points"][10:]).all()


def test_a_film_has_the_pictures_of_its_time(tmp_path: Path) -> None:
    pytest.importorskip("PIL")
    with Log(record(tmp_path / "run.mcap", 20)) as log:
        write_mp4(log, ["beam"], tmp_path / "run.mp4", size=(96, 80))
    film = imageio_ffmpeg.read_frames(str(tmp_path / "run.mp4"))
    told = next(film)
    pictures = [np.frombuffer(data, np.uint8).reshape(80, 96, 3) for data in film]
    assert told["size"] == (96, 80) and told["fps"] == 30 and told["codec"] == "h264"
    assert len(pictures) == 13, "0 to 0.4 s at 30 pictures in a second"
    red = pictures[0].astype(int)[..., 0] - pictures[0][..., 2]
    assert (red > 60).mean() > 0.02, "the body is orange"
    assert np.abs(pictures[0].astype(int) - pictures[-1]).max() > 50, "and moves"


def test_each_object_has_a_file_where_a_format_holds_one(log: Log, tmp_path: Path) -> None:
    assert export(log, None, tmp_path / "a.npz") == [tmp_path / "a_beam.npz", tmp_path / "a_liver.npz"]
    assert export(log, None, tmp_path / "a.csv") == [tmp_path / "a_beam.csv", tmp_path / "a_liver.csv"]
    written = export(log, None, tmp_path / "a.vtu", frame="all")
    assert {tmp_path / "a_beam.pvd", tmp_path / "a_liver.pvd"} <= set(written) and len(written) == 2 * (STEPS + 2)
    with Log(record(tmp_path / "one.mcap", 1)) as one:
        assert export(one, None, tmp_path / "one.npz") == [tmp_path / "one.npz"]


def test_progress_counts_the_frames_of_all_objects(log: Log, tmp_path: Path) -> None:
    for suffix in (".vtkhdf", ".usdc"):
        told: list[float] = []
        export(log, None, tmp_path / f"a{suffix}", progress=told.append)
        assert told == list(range(1, 2 * (STEPS + 1) + 1))


def test_what_cannot_be_written(log: Log, tmp_path: Path) -> None:
    for suffix in (".vtkhdf", ".usdc", ".mp4"):
        with pytest.raises(ClientError, match="cannot be written: "):
            export(log, None, tmp_path / "missing" / f"x{suffix}")
    with Recorder(tmp_path / "empty.mcap") as recorder:
        recorder.topology(topology("beam"))
    with Log(tmp_path / "empty.mcap") as empty, pytest.raises(BadInput, match="no frames of beam were recorded"):
        export(empty, None, tmp_path / "x.vtkhdf")
    assert sorted(p.name for p in tmp_path.iterdir()) == ["empty.mcap", "run.mcap"]
