# SPDX-License-Identifier: MIT
"""A server and workers on a GPU as separate processes. Runs where there is a GPU: pytest -m gpu."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from tests.system.link_helpers import ROOT
from tests.system.server_process import Stage, beam, run, until

pytestmark = pytest.mark.gpu


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    stage = Stage(tmp_path)
    yield stage
    stage.close()


def exported(log: Path, tmp_path: Path) -> dict[str, np.ndarray]:
    out = tmp_path / "out.npz"
    result = run("clients", "export", str(log), "--object", "beam", "--to", str(out))
    assert result.returncode == 0, result.stdout + result.stderr
    with np.load(out) as data:
        return {key: data[key] for key in data}


def alone(stage: Stage, bar: tuple[int, int, int], tmp_path: Path) -> np.ndarray:
    """Iterations of the first of these steps by block Jacobi, without a worker."""
    log, block_jacobi = tmp_path / "alone.mcap", ["--set", "solver.preconditioner=block_jacobi"]
    end = ["--device", "cpu", "--free-run", "--steps", "20", "--record", str(log)]
    server = stage.server(beam(tmp_path, bar), *block_jacobi, *end)
    assert server.wait(90) == 0, server.output()
    return exported(log, tmp_path)["scalars/iterations"]


@pytest.mark.parametrize("bar", [(3, 3, 10), (8, 8, 30)], ids=["540", "11520"])
def test_a_worker_on_the_gpu_serves_a_server_on_the_cpu(bar: tuple[int, int, int], stage: Stage, tmp_path: Path):
    log = tmp_path / "run.mcap"
    server = stage.server(beam(tmp_path, bar), "--device", "cpu", "--steps", "200", "--record", str(log))
    worker = stage.worker("w1", "--device", "gpu")
    with stage.client() as client:
        until(lambda: client.status().objects[0].factors_used > 3, "factors are taken up")
        status = client.status()
    assert status.workers[0].library.startswith("NVIDIA ") and status.workers[0].failures == 0
    assert status.refused == 0 and status.objects[0].factors_refused == 0
    assert server.wait(60) == 0, server.output()
    until(lambda: "is gone" in worker.output(), "the worker has seen its server go")
    assert "w1 ready: NVIDIA " in worker.output()
    data = exported(log, tmp_path)
    assert set(data["scalars/status"]) == {"converged"}
    assert (data["scalars/factor_step"] >= 0).sum() > 50
    assert data["scalars/iterations"].mean() < alone(stage, bar, tmp_path).mean() / 4


def test_factors_are_as_good_as_those_of_the_cpu(stage: Stage, tmp_path: Path):
    """In lockstep every solve has the same matrices and factors of the same age: equal iterations."""
    iterations = {}
    for device in ("cpu", "gpu"):
        log = tmp_path / f"{device}.mcap"
        scene = beam(tmp_path, (6, 6, 20), 'update = "lockstep-4"')
        arguments = ["--device", "cpu", "--steps", "60", "--free-run", "--record", str(log), "--workers", "1"]
        server = stage.server(scene, *arguments, "--worker-device", device)
        assert server.wait(90) == 0, server.output()
        data = exported(log, tmp_path)
        assert (data["scalars/factor_step"][8:] >= 0).all(), "every solve has a factor"
        iterations[device] = data["scalars/iterations"][8:]
    assert np.abs(iterations["cpu"] - iterations["gpu"]).max() <= 1


def test_workers_of_both_kinds_share_the_objects(stage: Stage):
    scene = ROOT / "deploy/scenes/four_beams.toml"
    cholesky = ["--set", "solver.preconditioner=cholesky"]
    stage.server(scene, "--device", "cpu", *cholesky, "--workers", "1", "--worker-device", "gpu")
    stage.worker("on-cpu")
    with stage.client() as client:
        until(lambda: len(client.status().workers) == 2, "both are there")
        until(lambda: all(w.jobs > 3 for w in client.status().workers), "both have work")
        status = client.status()
    assert {w.library.startswith("NVIDIA ") for w in status.workers} == {True, False}
    assert all(o.factors_refused == 0 and o.factors_used > 0 for o in status.objects) and status.refused == 0
