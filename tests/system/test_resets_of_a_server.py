# SPDX-License-Identifier: MIT
"""A server whose object is put back to the start while it runs and in a pause; its log is repeated to the bit."""

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from clients.__main__ import app
from clients.errors import BadInput
from protocol import messages_pb2 as pb
from protocol.log_file import LogFile
from tests.system.server_process import Stage, beam, fresh, run, until

pytestmark = pytest.mark.system


def test_resets_are_seen_and_replay_to_the_bit(tmp_path: Path) -> None:
    stage, log = Stage(tmp_path), tmp_path / "run.mcap"
    try:
        scene = beam(tmp_path, (2, 2, 6), '[integrator]\nscheme = "newmark"')
        server = stage.server(scene, "--record", str(log))
        with stage.client() as client:
            start = client.meshes()["beam"].rest
            held = client.grab("beam", at="tip", target=(0.9, 0.5, 4), stiffness=1e5, max_force=9000)
            until(lambda: fresh(client).step > 10, "it is pulled")
            with pytest.raises(BadInput, match="reset: no object 'bean'"):
                client.reset("bean")
            running = client.reset("beam").status
            assert running.state == "running"
            with pytest.raises(BadInput, match="it may be over"):
                held.move((0, 0, 4))
            until(lambda: fresh(client).step > running.step + 10, "it goes on")
            states = client.states()
            until(lambda: bool(states.newest()), "frames come")
            paused = client.pause().status
            client.set("gravity.g", [0, -1, 0])  # which the scheme begins with
            assert client.reset().status.step == paused.step
            until(lambda: any(np.array_equal(f.x, start) for f in states.newest()), "the pause shows it")
            said = CliRunner().invoke(app, ["reset", "--connect", stage.endpoint]).output
            assert said.startswith(f"put back at step {paused.step} ")
            client.set("gravity.g", [0, -2, 0])
            client.step(5)
            client.stop()
        assert server.wait() == 0, server.output()
    finally:
        stage.close()
    done = run("clients", "replay", str(log), "--simulate")
    assert done.returncode == 0 and "the same bit for bit" in done.stdout, done.stdout + done.stderr
    with_resets = [m for m in LogFile.open(log).messages() if m.topic == "/resets"]
    found = [pb.Reset.FromString(m.data) for m in with_resets]
    assert [(r.header.object, r.step) for r in found] == [("beam", running.step), ("", paused.step), ("", paused.step)]


@pytest.mark.parametrize("cut", [False, True])
def test_a_saved_run_goes_on_and_its_log_replays_to_the_bit(tmp_path: Path, cut: bool) -> None:
    """A factor is in use and a grab held when it is saved, and both are when it goes on; also where nodes have come to
    rest, as they have no elements any more."""
    stage, log, file = Stage(tmp_path), tmp_path / "run.mcap", tmp_path / "beam.npz"
    scene = beam(tmp_path, (2, 2, 6), 'update = "every-7"')
    scene.write_text(scene.read_text() + f"cutting = {str(cut).lower()}\n")
    try:
        server = stage.server(scene)
        with stage.client() as client:
            if cut:
                assert client.cut("beam", where="Z > 3.4 and X > 0.5").removed
            client.grab("beam", at="tip", target=(0.9, 0.5, 4), stiffness=1e5, max_force=9000)
            until(lambda: fresh(client).step > 10, "it is pulled")
            client.pause()
            step = client.step(3).status.step
            said = CliRunner().invoke(app, ["save", str(file), "--connect", stage.endpoint]).output
            assert said.startswith(f"saved at step {step} ") and file.stat().st_size > 1000
            low = [fresh(client).objects[0].low]
            client.step(20)
            low.append(fresh(client).objects[0].low)
            client.stop()
        assert server.wait() == 0, server.output()
        server = stage.server(scene, "--resume", str(file), "--record", str(log), "--steps", "40", "--free-run")
        assert server.wait() == 0, server.output()
    finally:
        stage.close()
    done = run("clients", "replay", str(log), "--simulate")
    assert done.returncode == 0 and "the same bit for bit" in done.stdout, done.stdout + done.stderr
    assert "40 steps repeated" in done.stdout
    assert f"it went on from a checkpoint of step {step}, which the log holds" in done.stdout + done.stderr
    frames = [pb.State.FromString(m.data) for m in LogFile.open(log).messages() if m.topic == "/state/beam"]
    found = {f.step: np.frombuffer(f.x).reshape(-1, 3).min(axis=0).tolist() for f in frames}
    assert found[step] == [low[0].x, low[0].y, low[0].z]
    assert found[step + 20] == [low[1].x, low[1].y, low[1].z], "as if it had not been interrupted"
