# SPDX-License-Identifier: MIT
"""Exports read back by the programs that they are for."""

from __future__ import annotations

import csv
from pathlib import Path
from xml.etree import ElementTree

import meshio
import numpy as np
import pytest

from clients.errors import BadInput, ClientError
from clients.export.export import export
from clients.log.reader import Log
from sim_server.recording.recorder import Recorder
from tests.sample_run import DT, REST, TETS, object_step, positions, record, state, topology, velocities

STEPS = 9


@pytest.fixture
def log(tmp_path: Path):
    with Log(record(tmp_path / "run.mcap", STEPS, ("beam", "liver"))) as opened:
        yield opened


def test_npz_has_the_agreed_arrays(log: Log, tmp_path: Path) -> None:
    assert export(log, "beam", tmp_path / "beam.npz") == [tmp_path / "beam.npz"]
    with np.load(tmp_path / "beam.npz", allow_pickle=False) as found:
        arrays = dict(found)
    assert arrays["step"].dtype == np.int64 and arrays["step"].tolist() == list(range(STEPS + 1))
    np.testing.assert_array_equal(arrays["time"], np.arange(STEPS + 1) * DT)
    np.testing.assert_array_equal(arrays["x"], np.stack([positions(s) for s in range(STEPS + 1)]))
    np.testing.assert_array_equal(arrays["v"], np.stack([velocities(s) for s in range(STEPS + 1)]))
    np.testing.assert_array_equal(arrays["tets"], TETS)
    steps = [object_step("beam", s) for s in range(1, STEPS + 1)]
    for name in (
        "step",
        "iterations",
        "residual",
        "factor_step",
        "step_seconds",
        "time",
        "factor_age",
        "excess",
        "factor_age_bound",
    ):
        assert arrays[f"scalars/{name}"].tolist() == [getattr(s, name) for s in steps], name
    told = [s.elastic_energy if s.HasField("elastic_energy") else np.nan for s in steps]
    np.testing.assert_array_equal(arrays["scalars/elastic_energy"], told)
    assert np.isnan(told).sum() == 6 and np.isnan(arrays["scalars/kinetic_energy"]).tolist() == [True] + [False] * 8
    assert arrays["scalars/status"].tolist() == ["converged"] * 3 + ["max_iterations"] + ["converged"] * 5
    assert arrays["scalars/preconditioner"].tolist() == ["block_jacobi"] * 2 + ["cholesky"] * 7
    assert sorted(p.name for p in tmp_path.iterdir()) == ["beam.npz", "run.mcap"]


def test_npz_of_a_log_without_frames(tmp_path: Path) -> None:
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.step(object_step("beam", 1))
    with Log(tmp_path / "run.mcap") as log:
        export(log, "beam", tmp_path / "beam.npz")
    with np.load(tmp_path / "beam.npz") as found:
        assert found["x"].shape == (0, 0, 3) and found["tets"].shape == (0, 4)
        assert found["scalars/step"].tolist() == [1]


def test_csv_reads_back_exactly(log: Log, tmp_path: Path) -> None:
    export(log, "liver", tmp_path / "liver.csv")
    with (tmp_path / "liver.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert len(rows) == STEPS
    for step, row in enumerate(rows, 1):
        expected = object_step("liver", step)
        assert int(row["step"]) == step and int(row["factor_step"]) == expected.factor_step
        assert float(row["residual"]) == expected.residual and float(row["time"]) == expected.time
    assert rows[3]["status"] == "max_iterations"


@pytest.mark.parametrize(("frame", "step"), [("last", STEPS), ("0", 0), ("4", 4), ("-2", STEPS - 1)])
def test_vtu_of_one_frame(log: Log, tmp_path: Path, frame: str, step: int) -> None:
    export(log, "beam", tmp_path / "beam.vtu", frame=frame)
    mesh = meshio.read(tmp_path / "beam.vtu")
    np.testing.assert_array_equal(mesh.points, positions(step))
    np.testing.assert_array_equal(mesh.cells_dict["tetra"], TETS)
    np.testing.assert_array_equal(mesh.point_data["displacement"], positions(step) - REST)
    np.testing.assert_array_equal(mesh.point_data["velocity"], velocities(step))
    # sigma_xx = 2 mu e + lambda e, sigma_yy = lambda e: von Mises is 2 mu e, with mu = 1e5 / 2.5
    np.testing.assert_allclose(mesh.point_data["von_mises"], 2 * 4e4 * 0.01 * step, rtol=1e-9, atol=1e-6)


def test_vtu_of_all_frames_with_their_times(log: Log, tmp_path: Path) -> None:
    written = export(log, "beam", tmp_path / "out.vtu", frame="all")
    assert [path.name for path in written] == [*(f"out_{k}.vtu" for k in range(STEPS + 1)), "out.pvd"]
    sets = ElementTree.parse(tmp_path / "out.pvd").findall("./Collection/DataSet")
    assert [float(s.attrib["timestep"]) for s in sets] == [k * DT for k in range(STEPS + 1)]
    for step, entry in enumerate(sets):
        np.testing.assert_array_equal(meshio.read(tmp_path / entry.attrib["file"]).points, positions(step))


def test_two_epochs_need_a_choice(tmp_path: Path) -> None:
    """After a cut the node count may differ, and one array cannot hold both."""
    more = np.vstack([REST, [[2, 2, 2]]])
    with Recorder(tmp_path / "cut.mcap") as recorder:
        recorder.topology(topology("beam"))
        recorder.state(state("beam", 0))
        recorder.topology(topology("beam", 2, more))
        recorder.state(state("beam", 1, 2, more))
        recorder.state(state("beam", 2, 2, more))
    with Log(tmp_path / "cut.mcap") as log:
        with pytest.raises(BadInput, match="choose one with --epoch, of 1, 2"):
            export(log, "beam", tmp_path / "x.npz")
        with pytest.raises(BadInput, match="--epoch 3: frames of 'beam' were recorded of 1, 2"):
            export(log, "beam", tmp_path / "x.npz", epoch=3)
        export(log, "beam", tmp_path / "x.npz", epoch=2)
        with np.load(tmp_path / "x.npz") as found:
            assert found["x"].shape == (2, 6, 3) and found["step"].tolist() == [1, 2]
        export(log, "beam", tmp_path / "x.vtu", frame="all")
        assert len(meshio.read(tmp_path / "x_0.vtu").points) == 5
        assert len(meshio.read(tmp_path / "x_2.vtu").points) == 6


def test_bad_requests(log: Log, tmp_path: Path) -> None:
    with pytest.raises(BadInput, match="no object 'spleen'; objects in the log: beam, liver"):
        export(log, "spleen", tmp_path / "x.npz")
    with pytest.raises(BadInput, match=r"the suffix '\.obj' is not one of \.npz, \.csv, \.vtu"):
        export(log, "beam", tmp_path / "x.obj")
    with pytest.raises(BadInput, match="--frame first: allowed are last, all, or a frame number"):
        export(log, "beam", tmp_path / "x.vtu", frame="first")
    with pytest.raises(BadInput, match="no frame 10 of object 'beam'; 10 frames"):
        export(log, "beam", tmp_path / "x.vtu", frame="10")
    with pytest.raises(ClientError, match="cannot be written: No such file"):
        export(log, "beam", tmp_path / "missing" / "x.npz")
    assert [p.name for p in tmp_path.iterdir()] == ["run.mcap"]
