# SPDX-License-Identifier: MIT
"""Many clients on one real server: more commands than it can take, clients that die while they hold."""

import os
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from clients.client import Client
from clients.errors import BadInput
from clients.load_test.processes import ClientProcesses
from clients.load_test.run import plan
from clients.log.reader import Log
from protocol import messages_pb2 as pb
from tests.system.link_helpers import ROOT
from tests.system.server_process import Stage, beam, fresh, until

pytestmark = pytest.mark.system
HOLDER = Path(__file__).parent / "many_clients.py"


@pytest.fixture
def stage(tmp_path: Path) -> Iterator[Stage]:
    stage = Stage(tmp_path)
    yield stage
    stage.close()


def flood(stage: Stage, client: Client, clients: int, rate: float, seconds: float) -> list[dict[str, Any]]:
    """What became of the commands of each of so many clients."""
    plans = plan(client.scene(), client.meshes(), clients, rate, seed=1)
    with ClientProcesses(plans, "sim", [stage.endpoint], seconds) as processes:
        processes.begin()
        return processes.reports()


def test_twenty_clients_that_send_too_much(stage: Stage, tmp_path: Path) -> None:
    """Steps go on and converge, what is too much is refused, nothing of it stays behind."""
    log = tmp_path / "run.mcap"
    server = stage.server(beam(tmp_path), "--record", str(log))
    with stage.client() as client:
        until(lambda: client.status().step > 10, "it runs")
        begun = fresh(client)
        reports = flood(stage, client, 20, 1000.0, 3.0)
        done, refused = (sum(r[key] for r in reports) for key in ("done", "refused"))
        assert done > 0 and refused > 0, reports
        until(lambda: len(client.status().clients) == 1, "they have gone")
        assert fresh(client).refused == 0, "none of it was malformed"
        until(lambda: client.status().step > begun.step + 30, "steps went on")
        at_rest = client.status().step
        until(lambda: client.status().step > at_rest + 20, "and do so")
        client.stop()
    assert server.wait() == 0, server.output()
    with Log(log) as found:
        steps = found.scalars("beam")
        assert set(steps["status"]) == {"converged"}
        assert steps["step"].tolist() == list(range(1, len(steps["step"]) + 1)), "none is missing"


@contextmanager
def flooding(client: Client, held: int, open: int = 200) -> Iterator[None]:
    """Moves of a grab and pushes that are too strong, `open` of them unanswered at any time, until the block ends.

    So many fit into the server's ring: none is lost there, nor anything of another client's.
    """
    room, ended = threading.Semaphore(open), threading.Event()
    move = pb.Interaction(object="beam", id=held, target=pb.Vector(x=0.5, y=0.6, z=4))
    push = pb.Interaction(object="beam", kind="push", force=pb.Vector(x=1e9), duration=0.02)

    def send() -> None:
        while not ended.is_set():
            for verb, wanted in (("move", move), ("push", push)):
                room.acquire()
                client.send(verb, wanted, lambda reply: room.release())

    sender = threading.Thread(target=send)
    sender.start()
    try:
        yield
    finally:
        ended.set()
        sender.join()


def test_one_that_floods_does_not_shut_out_another(stage: Stage, tmp_path: Path) -> None:
    """What the one sends over its rate is refused or replaced, and meanwhile every push of the other is taken."""
    stage.server(beam(tmp_path))
    with stage.client() as client, stage.client() as other:
        held = other.grab("beam", at=(0.5, 0.5, 4), stiffness=1e4, max_force=10).interaction.id
        with flooding(other, held):
            until(lambda: min(fresh(client).commands_refused, fresh(client).moves_replaced) > 0, "it sends too much")
            for _ in range(10):
                pushed = client.push("beam", at=(0.5, 0.5, 4), force=(1, 0, 0), duration=0.02)
                assert pushed.nodes == 1


def test_grabs_of_killed_clients_vanish(stage: Stage, tmp_path: Path) -> None:
    """kill -9 in the middle of moves at 1 kHz, three at once; the one that lives keeps its grab."""
    log = tmp_path / "run.mcap"
    server = stage.server(beam(tmp_path), "--record", str(log))
    with stage.client() as client:
        mine = client.grab("beam", at=(0.5, 0.5, 4), stiffness=1e4, max_force=2e3)
        holders = [holder(stage.endpoint) for _ in range(3)]
        try:
            names = [h.stdout.readline().strip() for h in holders if h.stdout]
            assert len(set(names)) == 3 and all(names)
            until(lambda: set(names) < set(client.status().clients), "the server knows them")
            step = fresh(client).step
            until(lambda: client.status().step > step + 20, "they hold for a while")
            for each in holders:
                os.kill(each.pid, signal.SIGKILL)
            until(lambda: not set(names) & set(client.status().clients), "the server knows that they are dead")
            step = fresh(client).step
            until(lambda: client.status().step > step + 30, "it runs on")
            mine.move((0.5, 1.0, 4.0))  # still there
            mine.release()
        finally:
            for each in holders:
                each.kill()
                each.communicate()
        client.stop()
    assert server.wait() == 0, server.output()
    with log.open("rb") as stream:
        held = held_by(stream)
    for name in names:
        assert held[name], "it did hold"
        assert max(held[name]) <= step + 1 < max(held[mine.interaction.client])


def holder(endpoint: str) -> "subprocess.Popen[str]":
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, str(HOLDER), endpoint, "beam"]
    return subprocess.Popen(command, cwd=ROOT, env=environment, stdout=subprocess.PIPE, text=True)


def held_by(stream: Any) -> dict[str, list[int]]:
    """Steps in which each client's interactions acted, from the log."""
    from mcap.reader import make_reader
    from mcap_protobuf.decoder import DecoderFactory

    found: dict[str, list[int]] = {}
    reader = make_reader(stream, decoder_factories=[DecoderFactory()])
    for _, _, _, step in reader.iter_decoded_messages(topics=["/step/beam"]):
        for interaction in step.interactions:
            found.setdefault(interaction.client, []).append(step.step)
    return found


def test_a_client_without_a_token_holds_nothing(stage: Stage, tmp_path: Path) -> None:
    """The token is what tells the server that a client lives; a name without one is nobody's."""
    stage.server(beam(tmp_path))
    with stage.client() as client:
        client.id = "somebody-else"
        held = client.grab("beam", at=(0.5, 0.5, 4), stiffness=1e4, max_force=2e3)
        with pytest.raises(BadInput, match="client 'somebody-else' has no interaction"):
            until(lambda: held.move((0.5, 1.0, 4.0)), "it is let go")
