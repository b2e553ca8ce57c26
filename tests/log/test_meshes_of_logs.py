# SPDX-License-Identifier: MIT
"""Meshes of a log: a reader holds few of them, and refuses what does not fit together."""

import tracemalloc
import weakref
from pathlib import Path

import numpy as np
import pytest

from clients.errors import BadInput
from clients.export.export import export
from clients.log.frames import mesh_of
from clients.log.reader import Log
from clients.viewer import film
from clients.viewer.surface import Surface
from protocol import messages_pb2 as pb
from protocol.refused import Refused
from sim_server.recording.recorder import Recorder
from tests.sample_run import REST, TETS, TRIANGLES, header, scene, state, topology

CUTS, MANY = 60, 4000


def cut(number: int, removed: list[int], nodes: int = len(REST)) -> pb.Topology:
    """As a log has it: only what the cut changes."""
    parts = {"removed": np.array(removed, "<i4").tobytes(), "triangles": TRIANGLES[:1].astype("<i4").tobytes()}
    return pb.Topology(header=header("beam"), nodes=nodes, cut=number, **parts)


def frame(step: int, number: int, rest: np.ndarray = REST) -> pb.State:
    found = state("beam", step, rest=rest)
    found.cut = number
    return found


@pytest.fixture(scope="module")
def cuts(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Each cut removes one element more of many."""
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    tets = np.random.default_rng(0).integers(0, len(REST), (MANY, 4))
    with Recorder(path) as recorder:
        recorder.scene(scene(["beam"]))
        recorder.topology(topology("beam", tets=tets), block=True)
        for number in range(1, CUTS + 1):
            recorder.topology(cut(number, list(range(number))), block=True)
            recorder.state(frame(number, number), block=True)
    return path


def test_a_reader_holds_few_meshes_of_many_cuts(cuts: Path) -> None:
    tracemalloc.start()
    with Log(cuts) as log:
        held = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
        assert held < 10 * 24 * MANY, "an element has 24 bytes"
        assert len(log.objects["beam"].meshes) == CUTS + 1 and not log.notes
        for number in np.random.default_rng(1).permutation(CUTS + 1).tolist():
            mesh = log.mesh("beam", 1 + number)
            assert (mesh.epoch, len(mesh.tets), len(mesh.young)) == (1 + number, MANY - number, MANY - number)
            assert log.uncut("beam", 1 + number) == 1 == (mesh.uncut or mesh).epoch


def test_films_hold_one_surface_of_an_object(cuts: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("PIL")
    alive: weakref.WeakSet[Surface] = weakref.WeakSet()

    class Noted(Surface):
        def __init__(self, *args: object) -> None:
            super().__init__(*args)  # type: ignore[arg-type]
            alive.add(self)

    monkeypatch.setattr(film, "Surface", Noted)
    with Log(cuts) as log:
        stage = film.Stage(log, (32, 32))  # which looks at frames of many cuts
        assert stage.end > 0 and len(alive) == 1


def test_another_mesh_of_the_same_epoch_is_left_out(tmp_path: Path) -> None:
    """Moduli may be others; elements and nodes may not, and a cut has as many nodes as its mesh."""
    more, other = np.vstack([REST, [[2, 2, 2]]]), TETS[::-1].copy()
    with Recorder(tmp_path / "run.mcap") as recorder:
        softer = topology("beam")
        softer.young = np.full(len(TETS), 2e5, "<f4").tobytes()
        for message in (
            topology("beam"),
            cut(1, [0]),
            softer,
            topology("beam", tets=other),
            topology("beam", rest=more),
        ):
            recorder.topology(message)
        recorder.state(frame(1, 1))
        recorder.topology(cut(2, [1], nodes=len(more)))
        recorder.state(frame(2, 2, more))
    with Log(tmp_path / "run.mcap") as log:
        assert "3 malformed messages left out, first: /topology/beam: Topology of 'beam': epoch 1 again" in log.notes[0]
        mesh = log.mesh("beam", 2)
        assert (mesh.tets.tolist(), mesh.young.tolist()) == ([TETS[1].tolist()], [2e5])
        with pytest.raises(BadInput, match="epoch 3, is not in the log"):
            export(log, "beam", tmp_path / "beam.npz")


def test_a_mesh_with_young_alone_is_cut() -> None:
    whole = topology("beam")
    whole.poisson = b""
    mesh = mesh_of(cut(1, [0]), mesh_of(whole))
    assert len(mesh.young) == 1 and len(mesh.poisson) == 0
    with pytest.raises(Refused, match="nodes is 6; allowed: 5, of the mesh that was cut"):
        mesh_of(cut(1, [0], nodes=6), mesh_of(whole))
