# SPDX-License-Identifier: MIT
"""Factors that a loop takes up in a step whose solve uses none: a simulation made again from the log uses them where
the recorded one did."""

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol import messages_pb2 as pb
from sim_server.backends.kinds import Kind
from sim_server.recording import messages
from sim_server.recording.recorder import Recorder
from sim_server.replay.log import Recording
from sim_server.replay.run import Replay
from sim_server.simulation import Simulation
from sim_server.updates.factor_source import Inline, Job
from tests.scenes import bar, simulation

BEAM: dict[str, Any] = {"cells": (6, 2, 2), "size": (3, 1, 1), "young": 5e5, "poisson": 0.4, "fixed": "X < 0.01"}


def beam(**solver: Any) -> Simulation:
    """Bends under its weight; `auto` chooses solves."""
    wanted = {"preconditioner": "auto", "tolerance": 1e-8} | solver
    return simulation(bar(**BEAM, pose={"rotate": [40, 0, 70]}), gravity=(3.0, -9.81, 2.0), **wanted)


def run(sim: Simulation, plan: str) -> NDArray[Any]:
    """Steps in words of letters, as a loop that runs freely may happen to make them; their records.

    f: a solve with the factor in use, j: by block Jacobi; c: the matrix of the step is copied; n: the factor of the
    matrix copied last is handed over first; o: the step waits for a factor of its own matrix.
    """
    engine, settings, records = sim.engine, sim.engine.settings(0), []
    inline = Inline({b.name: sim.system.body_pattern(b.first, b.last) for b in sim.world.bodies})
    copy = np.zeros_like(sim.system.values)

    def hand_over(step: int, values: NDArray[np.float64]) -> None:
        inline.submit(Job("bar", 1, step, True, values, sim.scene.solver.factor_dtype))
        (factor,) = inline.poll()
        engine.post_factor(0, factor.pattern, factor.values, step)

    for word in plan.split():
        settings.kind = Kind.CHOLESKY if "f" in word else Kind.BLOCK_JACOBI
        if "n" in word:
            hand_over(engine.matrix_step(0), copy)
        if "c" in word:
            engine.request_matrix(0, copy)
        engine.assemble()
        if "o" in word:
            hand_over(engine.step, sim.system.values)
        engine.solve()
        records.append(engine.records())
    return np.concatenate(records)


def replayed(sim: Simulation, records: NDArray[Any], path: Path, **scene: str) -> Any:
    """What a replay of the log with these records, and the state at their end, finds. scene: other fields of its
    message."""
    with Recorder(path) as recorder:
        message = messages.scene(sim)
        message.MergeFrom(pb.Scene(**scene))
        recorder.scene(message)
        recorder.topology(messages.topology(sim, sim.world.bodies[0]))
        for made in set(records["factor_step"].tolist()) - {-1}:
            recorder.factor(pb.FactorUse(header=pb.Header(object="bar", epoch=1), step=made, method="cholesky"))
        for step in messages.steps(sim, records):
            recorder.step(step)
        w, last = sim.fetch(), len(records)
        recorder.state(messages.state(sim.world.bodies[0], last, last * w.dt, w.x, w.v))
    with Recording(path) as recording:
        return Replay(recording).run()


def test_a_factor_that_comes_while_block_jacobi_is_tried(tmp_path: Path) -> None:
    """Before the factor is used another matrix is copied."""
    sim = beam()
    records = run(sim, "j jc fn f fc f jn jc f f f f jn f f")
    assert records["factor_step"].tolist() == [-1, -1, 1, 1, 1, 1, -1, -1, 4, 4, 4, 4, -1, 7, 7]
    assert np.ptp(records["iterations"]) > 5
    found = replayed(sim, records, tmp_path / "run.mcap")
    assert found.same, found.lines()
    assert (found.solves_compared, found.frames_compared) == (len(records), 1)


def test_a_factor_that_is_never_used(tmp_path: Path) -> None:
    """The next one comes before block Jacobi has been left."""
    sim = beam()
    records = run(sim, "jc fn f fc jn jc jn f f f")
    assert set(records["factor_step"].tolist()) == {-1, 0, 5}
    found = replayed(sim, records, tmp_path / "run.mcap")
    assert found.same, found.lines()


def test_a_step_that_makes_its_own_factor_begins_with_the_one_before(tmp_path: Path) -> None:
    """Though no solve has used it."""
    sim = beam(update="every-1")
    records = run(sim, "of f f oj of f oj oj of oj j f")
    assert records["factor_step"].tolist() == [0, 0, 0, -1, 4, 4, -1, -1, 8, -1, -1, 9]
    found = replayed(sim, records, tmp_path / "run.mcap")
    assert found.same, found.lines()


def test_a_log_whose_warp_was_switched_by_trials_is_repeated_with_the_warp(tmp_path: Path) -> None:
    """An earlier version had them; a run that made none, as here, is the same."""
    sim = beam()
    table = json.loads(messages.scene(sim).resolved)
    resolved = json.dumps(table | {"solver": table["solver"] | {"warp": "auto"}})
    found = replayed(sim, run(sim, "j j"), tmp_path / "run.mcap", resolved=resolved)
    assert found.same and 'recorded with warp = "auto"' in found.notes[0]
