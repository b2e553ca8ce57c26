# SPDX-License-Identifier: MIT
"""Factors that threads of a program make while its steps run."""

import gc
import logging
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

import warpfactor as wf
from sim_server.errors import InputError
from sim_server.updates.factor_source import Inline

BAR = {"name": "bar", "mesh": {"bar": [4, 2, 2], "size": [0.4, 0.1, 0.1]}}
SOFT = {"corotational": {"young": 1e4, "poisson": 0.4}, "fixed": {"where": "X < 0.01"}}


def bent(update: str = "async", **solver: object) -> dict:
    """A bar that bends under its weight, solved with factors."""
    solver = {"preconditioner": "cholesky", "update": update, **solver}
    return {"dt": 0.02, "effects": {"gravity": True}, "solver": solver, "object": [BAR | {"effects": SOFT}]}


def ours() -> list[str]:
    return [t.name for t in threading.enumerate() if t.name.startswith("thread ")]


def test_steps_with_async_do_not_wait_for_factors(monkeypatch):
    """Not even for one that never comes; those that come later are used."""
    may, begun = threading.Event(), threading.Event()
    submit = Inline.submit

    def slow(self, job):
        begun.set()
        assert may.wait(60)
        return submit(self, job)

    monkeypatch.setattr(Inline, "submit", slow)
    with wf.Simulation(bent(first_factor="go")) as simulation:
        records = simulation.step(10)
        assert begun.wait(60) and (records["factor_step"] == -1).all() and (records["status"] == 0).all()
        may.set()
        end = time.monotonic() + 60
        while simulation.step()["factor_step"][-1] < 0 and time.monotonic() < end:
            time.sleep(1e-3)
        assert 0 <= simulation.records["factor_step"][-1] < 10
    assert ours() == []


def test_the_first_step_has_its_own_factor():
    with wf.Simulation(bent()) as simulation:
        assert ours() == ["thread 1"]
        records = simulation.step(3)
        assert len(records) == 3 and records["step"].tolist() == [1, 2, 3] and records["factor_step"][0] == 0
        assert records["iterations"][0] == 1
    assert ours() == []


def test_lockstep_repeats_to_the_bit():
    found = []
    for workers in (1, 2, 0):
        with wf.Simulation(bent("lockstep-3"), workers=workers) as simulation:
            records = simulation.step(12)
            found.append((simulation.x.copy(), records["factor_step"].tolist()))
    assert found[0][1] == found[1][1] == found[2][1] and max(found[0][1]) >= 6
    assert np.array_equal(found[0][0], found[1][0]) and np.array_equal(found[0][0], found[2][0])


def test_it_is_said_once_that_nothing_makes_factors(caplog):
    with caplog.at_level(logging.WARNING), wf.Simulation(bent(), workers=0) as simulation:
        records = simulation.step(5)
        simulation.step(5)
    (line,) = [r.getMessage() for r in caplog.records]
    assert line.startswith('nothing makes factors: solver.update = "async" and workers = 0')
    assert (records["factor_step"] == -1).all() and (records["status"] == 0).all()


@pytest.mark.parametrize(("update", "preconditioner"), [("every-2", "cholesky"), ("async", "jacobi")])
def test_no_thread_where_none_is_needed(update, preconditioner, caplog):
    for workers in (0, 1):
        with wf.Simulation(bent(update, preconditioner=preconditioner), workers=workers) as simulation:
            assert ours() == [] and len(simulation.step(3)) == 3
    assert caplog.records == []


def test_a_factorization_that_fails_is_told_of_and_steps_go_on(monkeypatch, caplog):
    def fails(self, job):
        raise MemoryError("of a test")

    monkeypatch.setattr(Inline, "submit", fails)
    with wf.Simulation(bent()) as simulation:
        assert (simulation.step(5)["status"] == 0).all()
    assert any("MemoryError: of a test" in r.getMessage() for r in caplog.records)


def test_threads_end_with_a_simulation_that_nobody_closes():
    simulation = wf.Simulation(bent())
    simulation.step(2)
    assert ours()
    del simulation
    gc.collect()
    assert ours() == []


FORKED = """
import os, sys, threading
import warpfactor as wf
from sim_server.updates.factor_source import Inline

begun, submit = threading.Event(), Inline.submit

def watched(self, job):
    begun.set()
    return submit(self, job)

Inline.submit = watched
with wf.Simulation(wf.Scene.load("gallery/beam", ["solver.update=" + sys.argv[1]])) as simulation:
    simulation.step(5)
    begun.clear()
    while not begun.is_set():
        simulation.step()
    at, (read, write) = simulation.inside.engine.step, os.pipe()
    child = os.fork()  # while a factor is being made
    if sys.argv[1] == "async":
        while simulation.step()["factor_step"][-1] < at + 5:
            pass
    simulation.step(20)
    if child == 0:
        with os.fdopen(write, "wb") as pipe:
            pipe.write(simulation.x.tobytes())
        os._exit(0)
    os.close(write)
    with os.fdopen(read, "rb") as pipe:
        other = pipe.read()
    assert os.waitpid(child, 0)[1] == 0
    print(len(other) == simulation.x.nbytes, other == simulation.x.tobytes())
"""


@pytest.mark.parametrize("update", ["async", "lockstep-4"])
def test_factors_are_made_on_both_sides_of_a_fork(update):
    done = subprocess.run(
        [sys.executable, "-c", FORKED, update], cwd=Path(__file__).parents[2], capture_output=True, text=True,
        timeout=100,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.split() in ([["True", "True"]] if update != "async" else [["True", "True"], ["True", "False"]])


def test_fewer_than_no_workers_are_refused():
    with pytest.raises(InputError, match="workers = -1: must be 0 or more"):
        wf.Simulation(bent(), workers=-1)
