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
        server = stage.server(beam(tmp_path, (2, 2, 6)), "--record", str(log))
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
            assert client.reset().status.step == paused.step
            until(lambda: any(np.array_equal(f.x, start) for f in states.newest()), "the pause shows it")
            said = CliRunner().invoke(app, ["reset", "--connect", stage.endpoint]).output
            assert said.startswith(f"put back at step {paused.step} ")
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
