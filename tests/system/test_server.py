# SPDX-License-Identifier: MIT
"""The whole service with real processes: server, workers, clients, log; and what happens when some of them die."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

from clients.errors import BadInput
from clients.export.export import export
from clients.log.reader import Log
from protocol import messages_pb2 as pb
from tests.ports import free_endpoint
from tests.support.commands import in_turn
from tests.system.link_helpers import ROOT
from tests.system.server_process import Stage, alive, beam, fresh, run, until

pytestmark = pytest.mark.system


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    stage = Stage(tmp_path)
    yield stage
    stage.close()


def exported(log: Path, tmp_path: Path) -> dict[str, np.ndarray]:
    """Arrays of the beam as `sim-client export` writes them."""
    out = tmp_path / "out.npz"
    with Log(log) as opened:
        export(opened, "beam", out)
    with np.load(out) as data:
        return {key: data[key] for key in data}


def logged(log: Path, topic: str) -> list[Any]:
    """Messages of a topic, by the schema that the log itself carries."""
    with log.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        return [message for _, _, _, message in reader.iter_decoded_messages(topics=[topic])]


def test_server_worker_client_and_log(stage: Stage, tmp_path: Path) -> None:
    """A run with a factor from another process, through shared memory, touched by a client, logged completely."""
    log = tmp_path / "run.mcap"
    server = stage.server(beam(tmp_path), "--steps", "150", "--record", str(log), "--workers", "1")
    with stage.client() as client:
        client.pause()
        until(lambda: fresh(client).workers, "the worker has joined")
        client.resume()
        taken = client.push("beam", at=(0.5, 0.5, 4), force=(500, 0, 0), duration=0.2)
        assert taken.nodes == 1, "radius 0 takes the nearest free node"
        until(lambda: client.status().objects[0].factors_used > 5, "factors are taken up")
        status = client.status()
        assert status.bulk_shared > 0 and status.bulk_copied <= 2, "bulk data goes through shared memory"
        assert status.refused == 0
    assert server.wait() == 0, server.output()

    result = run("clients", "export", str(log), "--object", "beam", "--to", str(tmp_path / "beam.npz"))
    assert result.returncode == 0, result.stdout + result.stderr
    with np.load(tmp_path / "beam.npz") as file:
        data = dict(file)
    assert data["x"].shape == (151, 176, 3) and data["step"].tolist() == list(range(151))
    assert data["scalars/step"].tolist() == list(range(1, 151))
    assert np.allclose(data["time"], 0.02 * data["step"])
    assert set(data["scalars/status"]) == {"converged"} and data["scalars/residual"].max() <= 1e-6
    ages = data["scalars/factor_age"]
    assert ages[0] == 0 and (ages[1:] >= 1).all(), "the first step has waited for its own factor, the others for none"
    assert data["scalars/iterations"].max() < 15, "without a factor it takes several times as many"
    pushed = [step.step for step in logged(log, "/step/beam") if step.interactions]
    assert len(logged(log, "/interaction/beam")) == 1 and len(pushed) == 10, "0.2 s of push are ten steps"


def test_a_healthy_run_says_nothing_alarming(stage: Stage) -> None:
    """With `auto`, whose factors are of several methods and sizes."""
    scene = ROOT / "deploy" / "scenes" / "beam.toml"
    server = stage.server(scene, "--steps", "200", "--workers", "1", "--device", "cpu")
    with stage.client() as client:
        until(lambda: client.status().objects[0].factors_used > 5, "factors are taken up")
    assert server.wait() == 0
    alarming = ("a slot", "as bytes", "lease", "no factor", "refused", "counted from now on", "lost")
    assert not [line for line in server.output().splitlines() if any(words in line for words in alarming)]


def test_a_killed_worker_costs_no_step(stage: Stage, tmp_path: Path) -> None:
    """kill -9 with a matrix in its hands; the run goes on without one, and with another as soon as it is there."""
    log = tmp_path / "run.mcap"
    server = stage.server(beam(tmp_path), "--record", str(log), "--set", "record.every=100")
    worker = stage.worker()
    with stage.client() as client:

        def state() -> tuple[int, pb.ObjectStatus]:
            status = fresh(client)
            return status.step, status.objects[0]

        until(lambda: state()[1].factors_used > 2, "the worker is used")
        refused = state()[1].factors_refused
        os.kill(worker.process.pid, signal.SIGSTOP)  # what it has now, or gets, it will not answer
        stopped = state()[0]
        steps_of_a_job: dict[tuple[int, int], list[int]] = {}

        def goes_on() -> bool:
            step, found = state()
            if found.in_flight:
                steps_of_a_job.setdefault((found.factors_used, found.factors_refused), []).append(step)
            return any(steps[-1] > steps[0] + 10 for steps in steps_of_a_job.values())

        until(goes_on, "steps go on while nobody answers the job in flight")
        until(lambda: state()[0] > stopped + 10, "what was on the way has come")
        until(lambda: state()[1].in_flight or state()[1].factors_refused > refused, "it has a matrix, or had one")
        worker.kill()
        until(lambda: state()[1].factors_refused > refused, "nothing came of that")
        killed, before = state()
        until(lambda: state()[0] > killed + 20, "steps go on without a worker")
        assert state()[1].factors_used == before.factors_used
        stage.worker("w2")
        until(lambda: state()[1].factors_used > before.factors_used, "the second worker is used")
        seen = state()[0]
        client.stop()
    assert server.wait() == 0, server.output()
    data = exported(log, tmp_path)
    steps = data["scalars/step"].tolist()
    assert steps == list(range(1, len(steps) + 1)) and len(steps) >= seen, "no step is lost"
    assert set(data["scalars/status"]) == {"converged"}


def test_a_supervised_worker_is_started_again(stage: Stage, tmp_path: Path) -> None:
    server = stage.server(beam(tmp_path), "--workers", "1")
    with stage.client() as client:
        until(lambda: client.status().workers, "the worker has joined")
        first = client.status().workers[0].pid
        os.kill(first, signal.SIGKILL)
        until(lambda: [w.pid for w in client.status().workers] not in ([], [first]), "another worker has joined")
        second = client.status().workers[0].pid
        used = client.status().objects[0].factors_used
        until(lambda: client.status().objects[0].factors_used > used, "and is used")
        # A client adds one and kills it, and the server starts it again
        assert client.add_worker() == "local-2"
        until(lambda: len(client.status().workers) == 2, "the added worker has joined")
        (added,) = (w.pid for w in client.status().workers if w.worker == "local-2")
        done = run("clients", "worker", "kill", "local-2", "--connect", stage.endpoint)
        assert (done.stdout, done.stderr) == ("killed local-2\n", "")
        until(lambda: client.status().local_workers[1].restarts == 1, "it is started again")
        assert not alive(added) and client.status().local_workers[1].exit_code == -signal.SIGKILL
    assert server.end() == 0
    until(lambda: not alive(second), "the worker ends with its server")


def test_a_killed_server_leaves_its_log_and_its_worker(stage: Stage, tmp_path: Path) -> None:
    """The worker serves the next server; the log is readable up to the last flush."""
    scene, log = beam(tmp_path), tmp_path / "killed.mcap"
    first, worker = stage.server(scene, "--record", str(log)), stage.worker()
    with stage.client() as client:
        until(lambda: client.status().objects[0].factors_used > 2, "the worker is used")
        until(lambda: client.status().step > 120, "there is something in the log")
        done = client.status().step
    first.kill()
    stage.server(scene)
    with stage.client() as client:
        until(lambda: client.status().objects[0].factors_used > 2, "the worker serves the new server")
    assert worker.process.poll() is None
    data = exported(log, tmp_path)
    kept = len(data["scalars/step"])
    assert data["scalars/step"].tolist() == list(range(1, kept + 1)) and kept > done - 110


def test_pause_resume_stop_and_refusals(stage: Stage, tmp_path: Path) -> None:
    server = stage.server(beam(tmp_path))
    with stage.client() as client:
        client.pause()
        until(lambda: client.status().state == "paused", "it is paused")
        step = client.status().step
        with pytest.raises(BadInput, match=r"at most max_force = 10000 N"):
            client.push("beam", at=(0, 0, 0), force=(1e6, 0, 0))
        with pytest.raises(BadInput, match=r"no object 'liver'|'liver' does not list"):
            client.push("liver", at=(0, 0, 0), force=(1, 0, 0))
        assert client.status().step == step
        client.resume()
        until(lambda: client.status().step > step, "it runs again")
        client.stop()
    assert server.wait() == 0


def test_what_a_dead_client_held_is_released(stage: Stage, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    server = stage.server(beam(tmp_path), "--record", str(log))
    with stage.client() as client:
        client.grab("beam", at=(0.5, 0.5, 4), target=(0.5, 2, 4), stiffness=1e5, max_force=5e3)
        until(lambda: fresh(client).step > 15, "it holds for a while")
    with stage.client() as client:
        step = fresh(client).step
        until(lambda: fresh(client).step > step + 30, "it runs on")
        client.stop()
    assert server.wait() == 0
    held = [step.step for step in logged(log, "/step/beam") if step.interactions]
    assert held and held[-1] < step + 10, "the grab ends with its client"


def test_four_beams_share_one_worker(stage: Stage) -> None:
    """Everybody gets factors. Who gets most: tests/updates/test_policies.py."""
    scene = Path(__file__).parents[2] / "deploy" / "scenes" / "four_beams.toml"
    server = stage.server(scene, "--workers", "1")
    with stage.client() as client:
        until(lambda: min(o.factors_used for o in client.status().objects) >= 1, "each has a factor")
        client.stop()
    assert server.wait() == 0


@pytest.mark.parametrize(("how", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 0)])
def test_signals_end_it_in_good_order(stage: Stage, tmp_path: Path, how: signal.Signals, code: int) -> None:
    log = tmp_path / "run.mcap"
    server = stage.server(beam(tmp_path), "--record", str(log), "--workers", "1")
    with stage.client() as client:
        until(lambda: client.status().step > 20, "it runs")
    assert server.end(how) == code, server.output()
    assert "Traceback" not in server.output() and "FATAL" not in server.output()
    with Log(log) as written:
        assert not written.notes, "the log is complete"


@pytest.mark.parametrize("update", ["every-5", "lockstep-4", "async"])
def test_every_policy_runs_free_with_a_log(stage: Stage, tmp_path: Path, update: str) -> None:
    log = tmp_path / "run.mcap"
    scene = beam(tmp_path, solver=f'update = "{update}"')
    server = stage.server(scene, "--free-run", "--steps", "60", "--record", str(log), "--workers", "1")
    assert server.wait() == 0, server.output()
    data = exported(log, tmp_path)
    assert len(data["x"]) == 61 and set(data["scalars/status"]) == {"converged"}
    if update == "lockstep-4":
        assert data["scalars/factor_step"].tolist()[:12] == [-1] * 4 + [0] * 4 + [4] * 4
    if update == "every-5":
        assert data["scalars/factor_step"].tolist()[:12] == [0] * 5 + [5] * 5 + [10] * 2


def test_bad_input_gives_one_line_and_code_2(tmp_path: Path) -> None:
    bad = tmp_path / "bad.toml"
    bad.write_text("dt = 0\n")
    cases = [
        ([str(bad)], "dt = 0"),
        ([str(tmp_path / "none.toml")], "none.toml"),
        ([str(beam(tmp_path)), "--device", "tpu"], "allowed are auto, cpu, gpu"),
        ([str(beam(tmp_path)), "--listen", "nonsense"], "nonsense"),
        ([str(beam(tmp_path)), "--set", "solver.tolerence=1"], "did you mean 'tolerance'"),
        ([str(beam(tmp_path)), "--set", "@gone.toml"], "overlay 'gone.toml': cannot be read"),
        ([str(beam(tmp_path)), "--record", "/no/such/folder/a.mcap"], "/no/such/folder"),
    ]
    ended = in_turn("sim_server", [[*arguments, "--steps", "1"] for arguments, _ in cases])
    for (code, out, err), (arguments, words) in zip(ended.values(), cases, strict=True):
        assert code == 2, (arguments, out, err)
        assert words in err and "Traceback" not in err, err
    assert run("sim_server", str(bad), "--steps", "1").returncode == 2


def test_a_taken_port_is_told(stage: Stage, tmp_path: Path) -> None:
    stage.server(beam(tmp_path))
    with stage.client():
        result = run("sim_server", str(beam(tmp_path)), "--listen", stage.endpoint, "--steps", "1")
    assert result.returncode == 2 and stage.endpoint in result.stderr, result.stderr


def test_it_says_what_did_not_converge_and_writes_over_nothing_but_logs(tmp_path: Path) -> None:
    scene = beam(tmp_path)
    arguments = ["--steps", "3", "--free-run", "--listen", free_endpoint()]
    result = run("sim_server", str(scene), *arguments, "--set", "solver.max_iterations=2")
    assert result.returncode == 0 and "3 of 3 solves not converged (3 max_iterations)" in result.stdout
    assert "step 1: not converged (max_iterations, residual" in result.stderr
    before = scene.read_text()
    result = run("sim_server", str(scene), *arguments, "--record", str(scene))
    assert result.returncode == 2 and "is no MCAP log" in result.stderr
    assert scene.read_text() == before


@pytest.mark.parametrize(
    ("settings", "told"),
    [(["update=async"], True), (["update=lockstep-2"], False), (["preconditioner=block_jacobi"], False)],
)  # fmt: skip
def test_without_a_worker_it_says_once_that_nothing_makes_factors(
    tmp_path: Path, settings: list[str], told: bool
) -> None:
    endpoint = free_endpoint()
    options = [word for setting in settings for word in ("--set", f"solver.{setting}")]
    done = run(
        "sim_server",
        str(beam(tmp_path)),
        "--listen",
        endpoint,
        "--name",
        "mine",
        "--steps",
        "3",
        "--free-run",
        *options,
    )
    assert done.returncode == 0, done.stderr
    lines = [line for line in done.stdout.splitlines() if "nothing makes factors" in line]
    assert len(lines) == told
    if told:
        assert f"precond-worker --connect {endpoint} --server mine, or this server with --workers 1" in lines[0]


def test_the_first_status_waits_for_no_import(tmp_path: Path) -> None:
    """On a busy machine a large library takes longer to load than a client waits."""
    code = """
import sys
from pathlib import Path
from sim_server.network.link import ServerLink
from sim_server.service.service import Service
from sim_server.simulation import Simulation
with ServerLink(listen=[sys.argv[2]]) as link:
    service = Service(Simulation.load(Path(sys.argv[1])), link, steps=1)
    before = set(sys.modules)
    service.telemetry.publish_status("running", where=True)
    print(sorted(set(sys.modules) - before))
"""
    command = [sys.executable, "-c", code, str(beam(tmp_path)), free_endpoint()]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
