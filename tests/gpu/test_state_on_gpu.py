# SPDX-License-Identifier: MIT
"""Resets, and runs that go on from a checkpoint, on a GPU: to the bit, as on the CPU."""

from pathlib import Path

import numpy as np
import pytest

from sim_server.state.start import Start
from tests.resets.going_on import check_that_it_goes_on
from tests.resets.state_scenes import made
from tests.system.server_process import Stage, beam, fresh, run, until

pytestmark = pytest.mark.gpu
DEVICE = "gpu"
SCENES = ("newton", "newmark", "generalized_alpha", "ros2", "central_difference", "friction", "attached", "held")


@pytest.mark.parametrize("name", SCENES)
def test_a_run_goes_on_to_the_bit(name: str) -> None:
    check_that_it_goes_on(name, "lockstep-4" if name in ("newmark", "friction") else "every-3", DEVICE)


@pytest.mark.parametrize("name", sorted({*SCENES} - {"ros2", "central_difference"}))
def test_a_scene_that_is_reset_does_the_same_again(name: str) -> None:
    sim = made(name, DEVICE, preconditioner="block_jacobi")
    start, courses = Start(sim), []
    for _ in range(2):
        sim.engine.run(20)
        records = sim.engine.records()
        columns = [records[n].tolist() for n in ("iterations", "residual", "kinetic", "work", "contacts")]
        courses.append((sim.fetch().x.copy(), columns))
        start.reset()
    np.testing.assert_array_equal(courses[0][0], courses[1][0])
    assert courses[0][1] == courses[1][1]


@pytest.mark.parametrize("name", ["newmark", "bdf2", "generalized_alpha"])
def test_a_reset_begins_with_the_parameters_that_were_set(name: str) -> None:
    """Without weight a body at rest stays so; changes that wait are made before the reset."""
    sim = made(name, DEVICE, preconditioner="block_jacobi")
    start, x0 = Start(sim), sim.world.x.copy()
    sim.engine.run(10)
    sim.parameters.set({"gravity.g": "[0, 0, 0]"})
    start.reset("beam")
    assert not sim.engine.withdraw_changes()
    sim.engine.records()
    sim.engine.run(5)
    assert (sim.engine.records()["status"] == 0).all()
    np.testing.assert_allclose(sim.fetch().x, x0, rtol=0, atol=1e-9)


@pytest.mark.parametrize("pace", ["--realtime", "--free-run"])
def test_single_steps_resets_and_saves_of_a_server(tmp_path: Path, pace: str) -> None:
    stage, log, file = Stage(tmp_path), tmp_path / "run.mcap", tmp_path / "beam.npz"
    scene = beam(tmp_path, (2, 2, 6), 'update = "every-7"')
    try:
        server = stage.server(scene, "--device", DEVICE, pace, "--record", str(log))
        with stage.client() as client:
            until(lambda: fresh(client).step > 10, "it runs")
            client.reset("beam")
            step = client.pause().status.step
            client.reset()
            assert client.step(5).status.step == step + 5
            client.save(file)
            client.step(20)
            low = fresh(client).objects[0].low
            client.stop()
        assert server.wait() == 0, server.output()
        server = stage.server(scene, "--device", DEVICE, "--resume", str(file))
        with stage.client() as client:
            client.pause()
            client.step(max(step + 25 - fresh(client).step, 1))
            if fresh(client).step == step + 25:
                assert fresh(client).objects[0].low == low
            client.stop()
        assert server.wait() == 0, server.output()
    finally:
        stage.close()
    done = run("clients", "replay", str(log), "--simulate")
    assert done.returncode == 0 and "the same bit for bit" in done.stdout, done.stdout + done.stderr
