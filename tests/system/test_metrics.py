# SPDX-License-Identifier: MIT
"""`--metrics` of server and worker: what a scrape finds is what the log and the status have."""

import socket
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families
from server_process import Stage, beam, fresh, run, until

from protocol import messages_pb2 as pb
from protocol.log_file import LogFile
from tests.ports import free_port

pytestmark = pytest.mark.system

Found = dict[tuple[str, tuple[tuple[str, str], ...]], float]


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    stage = Stage(tmp_path)
    yield stage
    stage.close()


def get(port: int, path: str = "/metrics") -> str:
    with urllib.request.urlopen(f"http://127.0.0.1:{port}{path}", timeout=20) as answer:
        return str(answer.read().decode())


def serves(port: int) -> bool:
    """True once somebody listens: a server takes clients a moment before."""
    try:
        return bool(get(port))
    except urllib.error.URLError:
        return False


def scrape(port: int) -> Found:
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(get(port))
        for sample in family.samples
    }


def test_a_scrape_counts_what_the_log_has(stage: Stage, tmp_path: Path) -> None:
    at_server, at_worker = free_port(), free_port()
    record = tmp_path / "run.mcap"
    server = stage.server(beam(tmp_path), "--record", str(record), "--metrics", str(at_server))
    with stage.client() as client:
        until(lambda: serves(at_server), "the metrics are there")
        until(lambda: scrape(at_server)["warpfactor_need_seconds", ()] > 0, "a need of factors, without a worker")
        stage.worker("w1", "--metrics", f"127.0.0.1:{at_worker}")
        until(lambda: fresh(client).objects[0].factors_used >= 5, "factors")
        client.push("beam", "tip", (0, 5, 0), duration=0.05)
        assert get(at_server, "/healthy") == "ok\n"
        client.pause()
        until(lambda: not fresh(client).objects[0].in_flight, "the last factor")
        status = fresh(client)
        until(lambda: scrape(at_server)["warpfactor_steps_total", ()] == status.step, "a status of the pause")
        written = [-1.0, -2.0]
        while written[-1] != written[-2]:  # the thread of the log is done with what came before the pause
            time.sleep(0.5)
            written.append(scrape(at_server)["warpfactor_log_records_total", ()])
        found, worker = scrape(at_server), scrape(at_worker)
        with pytest.raises(urllib.error.HTTPError):
            get(at_server, "/anything")
        client.stop()
    assert server.wait() == 0
    with LogFile.open(record) as log:
        messages = list(log.messages())
    steps = [pb.ObjectStep.FromString(m.data) for m in messages if m.kind == "step"]
    beam_label = (("object", "beam"),)
    assert found["warpfactor_steps_total", ()] == max(s.step for s in steps) == len(steps)
    assert found["warpfactor_object_steps_total", beam_label] == len(steps)
    assert found["warpfactor_iterations_total", beam_label] == sum(s.iterations for s in steps) > 0
    assert found["warpfactor_step_seconds_count", ()] == len(steps)
    assert found["warpfactor_step_seconds_sum", ()] == pytest.approx(sum(s.step_seconds for s in steps))
    for bound in ("0.001", "0.01", "0.1"):
        below = sum(s.step_seconds <= float(bound) for s in steps)
        assert found["warpfactor_step_seconds_bucket", (("le", bound),)] == below
    assert found["warpfactor_late_steps_total", ()] == status.late_steps
    assert found["warpfactor_factors_used_total", beam_label] == status.objects[0].factors_used
    assert found["warpfactor_factor_age_steps", beam_label] == status.objects[0].factor_age
    assert found["warpfactor_server_state", (("state", "paused"),)] == 1
    assert found["warpfactor_workers", ()] == found["warpfactor_clients", ()] == 1
    assert found["warpfactor_log_records_total", ()] == len(messages)
    assert found["warpfactor_log_broken", ()] == 0
    assert 0 < found["warpfactor_log_bytes_total", ()] <= record.stat().st_size
    # What the server sent is what the worker did.
    jobs = found["warpfactor_jobs_total", ()]
    assert jobs == found["warpfactor_factors_total", ()] == worker["warpfactor_worker_jobs_total", (("server", "sim"),)]
    assert jobs == worker["warpfactor_worker_factorization_seconds_count", ()]
    assert worker["warpfactor_worker_serving", (("server", "sim"),)] == 1


def test_a_server_that_makes_no_steps_is_not_healthy(tmp_path: Path) -> None:
    from protocol.network.metrics_server import MetricsServer
    from protocol.process.notify import Notifier
    from sim_server.service.health import STUCK, Health

    class Nothing:
        def collect(self) -> list[object]:
            return []

    now = [0.0]
    health, port = Health(Notifier(), lambda: now[0]), free_port()
    with MetricsServer("127.0.0.1", port, Nothing(), health.why_not):
        health.look(5, False)
        now[0] = STUCK + 1
        health.look(5, False)
        with pytest.raises(urllib.error.HTTPError) as answer:
            get(port, "/healthy")
        assert answer.value.code == 503 and b"no step was completed for 61 s" in answer.value.read()
        health.look(5, True)  # it was paused
        assert get(port, "/healthy") == "ok\n"


def test_an_idle_connection_does_not_keep_others_waiting_for_long(tmp_path: Path) -> None:
    from protocol.network.metrics_server import MetricsServer

    class Nothing:
        def collect(self) -> list[object]:
            return []

    port = free_port()
    with MetricsServer("127.0.0.1", port, Nothing()), socket.create_connection(("127.0.0.1", port)):
        assert get(port, "/healthy") == "ok\n"


@pytest.mark.parametrize(
    ("address", "said"),
    [
        ("nonsense", "--metrics nonsense: allowed is HOST:PORT or PORT"),
        ("127.0.0.1:70000", "PORT from 1 to 65535"),
        ("192.0.2.1:9464", "metrics cannot be served at 192.0.2.1:9464"),
    ],
)
def test_an_address_that_cannot_be_used_is_named(tmp_path: Path, address: str, said: str) -> None:
    ended = run("precond_worker", "--metrics", address)
    assert ended.returncode == 2 and said in ended.stderr


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    from protocol.network.metrics_server import metrics_address
    from protocol.refused import Refused

    monkeypatch.setattr("protocol.network.metrics_server.find_spec", lambda name: None)
    with pytest.raises(Refused, match=r"of the extra metrics: .*pip install"):
        metrics_address("9464")
