# SPDX-License-Identifier: MIT
"""`--record-rotate`: a server's log in several files is replayed, exported and refused as one."""

from pathlib import Path

import numpy as np
import pytest
from server_process import beam, run

from protocol.log_pieces import later_pieces
from tests.ports import free_endpoint

pytestmark = pytest.mark.system
STEPS = 1000  # 8 MB, of which a file has 3 at most, however much waits when it is to end


def test_a_log_in_pieces_is_repeated_to_the_bit_and_exported(tmp_path: Path) -> None:
    scene, log = beam(tmp_path), tmp_path / "run.mcap"
    with scene.open("a") as file:
        file.write("[record]\nevery = 1\n")
    arguments = ("--free-run", "--steps", str(STEPS), "--listen", free_endpoint(), "--device", "cpu", "--workers", "1")
    rotate = ("--record", str(log), "--record-rotate", "1MB")
    done = run("sim_server", str(scene), *arguments, *rotate, timeout=150)
    assert done.returncode == 0, done.stderr
    pieces = [piece for _, piece in later_pieces(log)]
    assert len(pieces) >= 2
    replayed = run("clients", "replay", str(log), "--simulate", timeout=150)
    assert replayed.returncode == 0 and str(STEPS) in replayed.stdout, replayed.stdout + replayed.stderr
    out = tmp_path / "all.npz"
    assert run("clients", "export", str(log), "--object", "beam", "--to", str(out)).returncode == 0
    assert np.array_equal(np.load(out)["step"], np.arange(STEPS + 1))
    alone = tmp_path / "later.npz"
    assert run("clients", "export", str(pieces[0]), "--object", "beam", "--to", str(alone)).returncode == 0
    steps = np.load(alone)["step"]
    assert 0 < steps[0] < steps[-1] < STEPS and np.array_equal(np.diff(steps), np.ones(len(steps) - 1))
    log.unlink()  # as a budget does
    refused = run("clients", "replay", str(log), "--simulate")
    assert refused.returncode == 2 and "the first file of this log is gone" in refused.stderr
    assert run("clients", "export", str(log), "--object", "beam", "--to", str(out)).returncode == 0
    assert np.load(out)["step"][-1] == STEPS
