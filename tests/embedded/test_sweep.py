# SPDX-License-Identifier: MIT
"""Sweeps: a run for each combination of values, here and in other processes."""

import csv
import os
import signal
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

import warpfactor as wf
from sim_server.backends.cpu import processors
from sim_server.embedded import sweep
from sim_server.errors import InputError

YOUNG = "object.bar.effects.corotational.young"
SCENE = {
    "dt": 0.02,
    "effects": {"gravity": {"g": [0, -9.81, 0]}},
    "solver": {"preconditioner": "block_jacobi", "tolerance": 1e-8},
    "object": [
        {
            "name": "bar",
            "mesh": {"bar": [1, 1, 4], "size": [0.1, 0.1, 0.4]},
            "effects": {"corotational": {"young": 1e5, "poisson": 0.4}, "fixed": {"where": "Z < 0.01"}},
        }
    ],
}


def sag(simulation):
    return {"sag": -simulation.displacements("bar")[simulation.tip("bar"), 1], "process": os.getpid()}


def test_all_combinations_are_run_in_order(tmp_path):
    """Each row as a simulation by itself has it; the table is that of the file that it is saved to."""
    grid = {YOUNG: [1e5, 4e5], "dt": np.array([0.02, 0.01])}
    table = wf.sweep(SCENE, grid, 0.1, sag, workers=0, processes=1)
    assert table.columns[:2] == [YOUNG, "dt"] and len(table) == 4
    assert [(row[YOUNG], row["dt"]) for row in table] == [(1e5, 0.02), (1e5, 0.01), (4e5, 0.02), (4e5, 0.01)]
    for row in table:
        with wf.Simulation(wf.Scene(SCENE).with_values({k: row[k] for k in grid}), workers=0) as alone:
            records = alone.step(round(0.1 / row["dt"]))
            assert row["sag"] == sag(alone)["sag"] and row["iterations"] == records["iterations"].mean()
            assert row["bar.moved"] == np.linalg.norm(alone.displacements("bar"), axis=1).max()
    assert (table["converged"] == 1).all() and table["residual"].max() <= 1e-8
    assert table["sag"][0] > 1.05 * table["sag"][2] > 0
    with table.save(tmp_path / "table.csv").open() as file:
        assert [float(row["sag"]) for row in csv.DictReader(file)] == list(table["sag"])
    assert str(table).count("\n") >= 7 and "bar.moved" in str(table)


def test_processes_give_what_one_gives():
    grid = {YOUNG: [1e5, 2e5, 4e5]}
    here, beside = (wf.sweep(SCENE, grid, 0.04, sag, workers=0, processes=n) for n in (1, 2))
    assert np.array_equal(here["sag"], beside["sag"]) and set(here["process"]) == {os.getpid()}
    assert os.getpid() not in beside["process"]


def test_a_list_of_values_and_a_function_that_steps():
    def pushed(simulation):
        simulation.forces[simulation.tip("bar")] = 0
        return {"steps": len(simulation.step(3))}

    with pytest.raises(InputError, match="seconds = 0: must be above 0, or 0 with a function"):
        wf.sweep(SCENE, [{"dt": 0.01}], 0)
    table = wf.sweep(SCENE, [{"dt": 0.01}, {YOUNG: 2e5}], 0, lambda s: {"steps": len(s.step(3))}, workers=0)
    assert table.rows == [{"dt": 0.01, "steps": 3}, {YOUNG: 2e5, "steps": 3}]
    failed = wf.sweep(SCENE, {"dt": [0.01]}, 0, pushed, workers=0)
    assert "InputError: forces: there is no room for them" in failed["error"][0]


def test_a_run_that_fails_leaves_the_others():
    """By an exception, and by the end of its process."""

    def ends(simulation):
        if simulation.scene.checked.dt == 0.02:
            raise RuntimeError("as asked")
        if simulation.scene.checked.dt == 0.03:
            os.kill(os.getpid(), signal.SIGKILL)
        return {"fine": 1.0}

    table = wf.sweep(SCENE, {"dt": [0.01, 0.02]}, 0, ends, workers=0, processes=2)
    assert table["error"].tolist() == ["", "RuntimeError: as asked"]
    assert table["fine"][0] == 1 and np.isnan(table["fine"][1])
    assert "Terminated" in wf.sweep(SCENE, {"dt": [0.03, 0.03]}, 0, ends, workers=0, processes=2)["error"][0]


@pytest.mark.parametrize(
    ("grid", "said"),
    [
        ({}, "no combination"), ([], "no combination"), ({"dt": []}, "no combination"),
        ({"dt": 0.1}, "must be a list of values"), ({"dt": "0.1"}, "must be a list of values"),
        ({"dt": [0.01, -1]}, r"dt = -1: .*dt"), ({"solver.tolerence": [1]}, "tolerence"),
    ],
)  # fmt: skip
def test_values_are_checked_before_the_first_run(grid, said):
    def never(simulation):
        pytest.fail("a run began")

    if grid == {}:
        assert len(wf.sweep(SCENE, grid, 0.02, workers=0)) == 1  # the scene as it is
        return
    with pytest.raises(InputError, match=said):
        wf.sweep(SCENE, grid, 0.02, never, workers=0)
    with pytest.raises(InputError, match="processes = 0"):
        wf.sweep(SCENE, {"dt": [0.01]}, 0.02, processes=0)


def test_another_executor_runs_them():
    with ThreadPoolExecutor(1) as threads:
        table = wf.sweep(SCENE, {"dt": [0.01, 0.02]}, 0.02, workers=0, executor=threads)
    assert (table["converged"] == 1).all()


@pytest.mark.slow
def test_submitit_runs_them(tmp_path):
    """By its executor for one machine, which writes, starts and reads jobs as that of Slurm does."""

    def where(simulation):  # not of this module, which those processes do not find
        return {"process": os.getpid()}

    submitit = pytest.importorskip("submitit")
    executor = submitit.AutoExecutor(folder=tmp_path / "jobs", cluster="local")
    executor.update_parameters(timeout_min=5)
    table = wf.sweep(SCENE, {"dt": [0.01, 0.02]}, 0.02, where, workers=0, executor=executor)
    assert "error" not in table.columns, table.rows
    assert (table["converged"] == 1).all() and os.getpid() not in table["process"]
    assert len(list((tmp_path / "jobs").glob("*_result.pkl"))) == 2


def test_as_many_runs_as_control_groups_allow(monkeypatch):
    """In a container of 4 processors on a machine of 64."""
    monkeypatch.setattr(processors.os, "sched_getaffinity", lambda _: set(range(64)))
    monkeypatch.setattr(processors, "quota", lambda: 3.5)
    monkeypatch.setattr(sweep, "run_all", lambda jobs, executor, count: [{"count": count}])
    assert wf.sweep(SCENE, {"dt": [0.01]}, 0.02)["count"].tolist() == [2]
