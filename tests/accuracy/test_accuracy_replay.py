# SPDX-License-Identifier: MIT
"""A run whose solves end by errors in metres, recorded and made again from its log: decisions repeat to the bit."""

from pathlib import Path

import numpy as np

from clients.log.reader import Log
from sim_server.recording import messages
from sim_server.recording.recorder import Recorder
from sim_server.replay.log import Recording
from sim_server.replay.run import Replay
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.accuracy.effectivity import beam

STEPS = 12


def test_a_run_with_a_bound_of_positions_repeats_to_the_bit(tmp_path: Path) -> None:
    table = {"name": "test", "dt": 0.02, "accuracy": {"position": "0.01 %"}, "object": [beam()]}
    table |= {"effects": {"gravity": True}, "integrator": {"linearizations": 1}}
    sim = Simulation(Scene.model_validate(table | {"solver": {"preconditioner": "block_jacobi"}}))
    sim.engine.run(STEPS)
    records = sim.engine.records()
    assert (records["solve_error"] <= 1e-3 / 2).all() and records["residual"].max() > 1e-6
    with Recorder(tmp_path / "run.mcap") as recorder:
        recorder.scene(messages.scene(sim))
        recorder.topology(messages.topology(sim, sim.world.bodies[0]))
        for step in messages.steps(sim, records):
            recorder.step(step)
        w = sim.fetch()
        recorder.state(messages.state(sim.world.bodies[0], STEPS, STEPS * w.dt, w.x, w.v))
    with Log(tmp_path / "run.mcap") as log:
        scalars = log.scalars("bar")
    assert np.array_equal(scalars["solve_error"], records["solve_error"]) and np.isnan(scalars["step_error"]).all()
    with Recording(tmp_path / "run.mcap") as recording:
        found = Replay(recording).run()
    assert found.same and found.solves_compared == STEPS, found.lines()
