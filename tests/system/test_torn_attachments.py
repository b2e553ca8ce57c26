# SPDX-License-Identifier: MIT
"""Attachments that tear while a holder pulls, with a real server: told, logged, and repeated bit for bit."""

from pathlib import Path

import pytest

from clients.log.reader import Log
from tests.ports import free_endpoint
from tests.system.server_process import run
from tests.system.test_replay_of_a_server import CPU, replayed

pytestmark = pytest.mark.system


@pytest.mark.parametrize("update", ["lockstep-3", "every-7"])
def test_what_tore_is_told_and_tears_again(tmp_path: Path, update: str) -> None:
    log = tmp_path / "run.mcap"
    options = ("--free-run", "--steps", "100", "--record", str(log), "--set", f"solver.update={update}", *CPU)
    result = run("sim_server", "deploy/scenes/graft.toml", *options, "--listen", free_endpoint())
    said = result.stdout + result.stderr
    assert result.returncode == 0, said
    assert "'glue' breaks, at step" in said and said.count("breaks, at step") == 1
    assert replayed(log, 0)["same"]
    with Log(log) as opened:
        scalars = opened.scalars("graft")
        pull = scalars["reaction/glue/force_x"]
        assert abs(pull).max() > 0.1 and abs(pull[-1]) < 0.9 * abs(pull).max()
        assert abs(scalars["reaction/band/force_x"][-1]) > 0.1
        assert abs(scalars["reaction/forceps/force_x"]).max() > 0.1
