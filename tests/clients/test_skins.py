# SPDX-License-Identifier: MIT
"""The skin of an object as clients get it: checked, shown instead of the elements' faces, exported, replayed."""

from pathlib import Path

import meshio
import numpy as np
import pytest

from clients.export.export import export
from clients.log.frames import mesh_of
from clients.log.reader import Log
from clients.viewer.surface import Surface
from protocol import messages_pb2 as pb
from protocol.refused import Refused
from sim_server.recording.recorder import Recorder
from sim_server.replay.log import Recording
from sim_server.replay.run import Replay
from tests.ports import free_endpoint
from tests.sample_run import REST, positions, state, topology
from tests.system.server_process import beam, run

NODES = np.array([[0, 1, 2, 3], [1, 2, 3, 4], [0, 1, 2, 3]], np.int32)
WEIGHTS = np.array([[0.25, 0.25, 0.25, 0.25], [0.5, 0.5, 0, 0], [1.5, 0.5, -0.5, -0.5]])
TRIANGLES = np.array([[0, 1, 2]], np.int32)


def message(nodes: np.ndarray = NODES, weights: np.ndarray = WEIGHTS, triangles: np.ndarray = TRIANGLES) -> pb.Topology:
    found = topology("beam")
    found.skin_nodes, found.skin_triangles = nodes.astype("<i4").tobytes(), triangles.astype("<i4").tobytes()
    found.skin_weights = weights.astype("<f8").tobytes()
    return found


def at_vertices(x: np.ndarray) -> np.ndarray:
    return np.array([sum(w * x[n] for w, n in zip(*each, strict=True)) for each in zip(WEIGHTS, NODES, strict=True)])


def test_it_moves_with_the_nodes() -> None:
    skin = mesh_of(pb.Topology.FromString(message().SerializeToString())).skin
    assert skin is not None
    np.testing.assert_array_equal(skin.triangles, TRIANGLES)
    np.testing.assert_allclose(skin.positions(positions(3)), at_vertices(positions(3)), atol=1e-15)
    assert mesh_of(topology("beam")).skin is None


def test_a_skin_that_was_cut_has_the_faces_that_were_laid_bare() -> None:
    """Without the second element: the face that both had, at its nodes, beside what is left of the skin."""
    left = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
    cut = message(triangles=TRIANGLES[:0])
    cut.cut, cut.removed, cut.triangles = 1, np.array([1], "<i4").tobytes(), left.astype("<i4").tobytes()
    for before in (None, mesh_of(message())):
        mesh = mesh_of(cut, before)
        skin = mesh.skin
        assert skin is not None and mesh.epoch == 2
        at = skin.positions(positions(3))
        np.testing.assert_allclose(at[: len(NODES)], at_vertices(positions(3)), atol=1e-15)
        np.testing.assert_array_equal(at[skin.triangles], positions(3)[left[3:]])
        again = mesh_of(cut, mesh).skin
        assert again is not None and len(again.nodes) == len(skin.nodes)


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"nodes": NODES + 2}, "skin_nodes"),
        ({"nodes": NODES[:2]}, "skin_weights"),
        ({"nodes": NODES - 1}, "skin_nodes"),
        ({"weights": WEIGHTS * 1.001}, r"skin_weights have sums off 1 by 0\.001; allowed: 1e-06"),
        ({"weights": WEIGHTS * np.nan}, "skin_weights"),
        ({"weights": WEIGHTS + np.array([4, -4, 0, 0])}, "skin_weights of magnitude 5.5; allowed: 4"),
        ({"triangles": TRIANGLES + 1}, "skin_triangles"),
    ],
)
def test_what_cannot_be_one_is_refused(changed: dict[str, np.ndarray], said: str) -> None:
    with pytest.raises(Refused, match=said):
        mesh_of(message(**changed))


def test_it_is_shown_in_place_of_the_faces_of_elements() -> None:
    mesh, x = mesh_of(message()), positions(10)
    surface, stress = Surface(mesh, "displacement"), Surface(mesh, "von_mises")
    np.testing.assert_allclose(surface.points(x), at_vertices(x).astype(np.float32))
    np.testing.assert_array_equal(surface.triangles, TRIANGLES)
    np.testing.assert_allclose(surface.values(x), 0.1 * abs(at_vertices(REST)[:, 0]), atol=1e-12)
    np.testing.assert_allclose(stress.values(x), 2 * 4e4 * 0.1, rtol=1e-6)
    assert np.isnan(surface.values(x * np.nan)).tolist() == [True] * 3 and surface.normals(surface.points(x)).shape == (
        3,
        3,
    )


def test_an_export_has_it_in_a_second_file(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.topology(message())
        for step in range(2):
            recorder.state(state("beam", step))
        apart = state("beam", 2)  # the second element alone is strained
        apart.x = np.vstack([REST[:4], [[2, 1, 1]]]).tobytes()
        recorder.state(apart)
    with Log(tmp_path / "run.mcap") as log:
        assert [path.name for path in export(log, "beam", tmp_path / "one.vtu", "1")] == ["one_skin.vtu", "one.vtu"]
        export(log, "beam", tmp_path / "all.vtu", frame="all")
    found = meshio.read(tmp_path / "one_skin.vtu")
    np.testing.assert_allclose(found.points, at_vertices(positions(1)), atol=1e-15)
    np.testing.assert_array_equal(found.cells_dict["triangle"], TRIANGLES)
    assert {"displacement", "velocity", "von_mises"} <= set(found.point_data)
    stress = meshio.read(tmp_path / "all_2_skin.vtu").point_data["von_mises"]
    assert stress[2] == 0 and stress[1] > 0, "weights beyond the mesh make no negative ones"
    text = (tmp_path / "all.pvd").read_text()
    assert 'part="0" file="all_1.vtu"' in text and 'part="1" file="all_1_skin.vtu"' in text


@pytest.mark.system
def test_a_run_with_one_is_logged_and_repeated_without_its_file(tmp_path: Path) -> None:
    scene, log = beam(tmp_path, bar=(1, 1, 2), solver='update = "every-2"'), tmp_path / "run.mcap"
    scene.write_text(scene.read_text().replace('name = "beam"', 'name = "beam"\nskin = "fine.obj"'))
    (tmp_path / "fine.obj").write_text("v 0.2 0.2 0.3\nv 0.8 0.2 2.9\nv 0.5 0.9 3.5\nf 1 2 3\n")
    end = ("--steps", "6", "--listen", free_endpoint(), "--record", str(log), "--device", "cpu")
    done = run("sim_server", str(scene), "--free-run", *end)
    assert done.returncode == 0, done.stderr
    (tmp_path / "fine.obj").unlink()
    with Log(log) as opened:
        skin = opened.mesh("beam", 1).skin
        assert skin is not None
        np.testing.assert_allclose(skin.positions(opened.frame("beam", 0).x)[2], [0.5, 0.9, 3.5], atol=1e-12)
    with Recording(log) as recording:
        assert Replay(recording).run().same
