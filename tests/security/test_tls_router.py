# SPDX-License-Identifier: MIT
"""A router with certificates, as docs/security.md says: server and worker meet in it, and clients have their roles."""

import json
import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh

from clients.client import Client
from clients.errors import BadInput, ClientError
from protocol import messages_pb2 as pb
from protocol.channels import PROTOCOL, key
from protocol.network.identity import identity_of
from protocol.network.session import open_session
from tests.ports import free_endpoint
from tests.system.server_process import PATIENCE, Stage, beam, run, until

pytestmark = pytest.mark.system
ROOT = Path(__file__).parents[2]
ROUTER = """
import json, sys, zenoh
settings = json.loads(sys.argv[2])
config = zenoh.Config.from_file(sys.argv[1])
for name, value in settings.items():
    config.insert_json5(name, json.dumps(value))
with zenoh.open(config):
    print("open", flush=True)
    sys.stdin.read()
"""


class RouterStage(Stage):
    """A router, a server and a worker, each a process; server and worker know the router alone."""

    def __init__(self, folder: Path):
        super().__init__(folder)
        self.router, self.certs = free_endpoint(protocol="tls"), folder / "certs"
        for words in (["--host", "localhost", "--client", "bob:operator"],
                      ["--client", "meeting:router", "--host", "localhost"]):  # fmt: skip
            done = run("sim_server", "certs", str(self.certs), *words)
            assert done.returncode == 0, done.stderr
        rules = run("sim_server", "certs", str(self.certs), "--rules", "--server", "sim")
        assert rules.returncode == 0, rules.stderr
        own = self.certs / "meeting"
        settings = json.loads(rules.stdout) | {
            "listen/endpoints": [self.router],
            "transport/link/tls": {
                "enable_mtls": True, "root_ca_certificate": str(own / "ca.pem"),
                "listen_certificate": str(own / "cert.pem"), "listen_private_key": str(own / "key.pem"),
            },
        }  # fmt: skip
        command = [sys.executable, "-c", ROUTER, str(ROOT / "deploy/zenoh/router.json5"), json.dumps(settings)]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, env=dict(os.environ))
        assert self.process.stdout is not None and self.process.stdout.readline() == b"open\n"
        listen = self.endpoint.replace("tcp/", "tls/")
        self.start("sim_server", str(beam(folder)), "--tls", str(self.certs), "--listen", listen,
                   "--connect", self.router)  # fmt: skip
        self.start("precond_worker", "--connect", self.router, "--tls", str(self.certs / "worker"), "--name", "w")

    def as_(self, name: str) -> Client:
        """A client with this certificate, at the router, once the server is there."""
        found: list[Client] = []

        def connected() -> bool:
            try:
                found.append(Client(connect=[self.router], tls=self.certs / name, timeout=2.0))
            except ClientError as error:
                if "no server 'sim'" not in str(error) and "in time" not in str(error):
                    raise
            return bool(found)

        until(connected, f"a client {name}")
        found[0].timeout = PATIENCE
        return found[0]

    def close(self) -> None:
        super().close()
        self.process.communicate(timeout=PATIENCE)


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RouterStage]:
    one = RouterStage(tmp_path_factory.mktemp("router"))
    yield one
    one.close()


def test_factors_come_through_it_and_an_operator_rules(stage: RouterStage) -> None:
    with stage.as_("bob") as bob:
        until(lambda: bob.status(fresh=True).objects[0].last.factor_step >= 0, "a factor is used")
        assert [w.worker for w in bob.status().workers] == ["worker.w"]
        assert bob.push("beam", at="tip", force=(1, 0, 0), duration=0.02).nodes == 1
        states = bob.states()
        until(states.newest, "a state")
        assert bob.pause().status.state == "paused"
        assert not bob.resume().unchanged


def test_a_viewer_looks_and_does_nothing(stage: RouterStage) -> None:
    with stage.as_("viewer") as eve:
        assert eve.status(fresh=True).scene and list(eve.meshes()) == ["beam"]
        states = eve.states()
        until(states.newest, "a state")
        with pytest.raises(BadInput, match="'viewer' is that of a viewer; stop is for operator"):
            eve.stop()
        viewer = identity_of(stage.certs / "viewer", ())
        with open_session("client", connect=[stage.router], shared_memory=False, tls=viewer) as session:
            for name in (eve.id, "bob.client-1"):  # its own, and one of who may
                command = pb.Command(header=pb.Header(protocol=PROTOCOL), verb="stop", client=name, secret=eve.secret)
                asked = key("command", verb="stop", client=name)
                replies = session.zenoh.get(asked, payload=command.SerializeToString(), timeout=2.0)
                assert [reply.ok for reply in replies if reply.ok is not None] == [], "denied by the router"
            answer = pb.Factor(header=pb.Header(protocol=PROTOCOL), worker="worker.w", failure="no").SerializeToString()
            session.zenoh.put(key("factor", worker="worker.w", object="beam"), b"", attachment=answer,
                              congestion_control=zenoh.CongestionControl.BLOCK)  # fmt: skip
            assert list(session.zenoh.liveliness().get(key("alive_server"), timeout=PATIENCE))
        status = eve.status(fresh=True)
        assert (status.state, status.refused) == ("running", 0)


def test_without_a_certificate_there_is_no_session(stage: RouterStage) -> None:
    stage.as_("bob").close()
    with pytest.raises(ClientError, match="it asks for a certificate: --tls DIR"):
        Client(connect=[stage.router], timeout=0.5)
    plain = stage.start("precond_worker", "--connect", stage.router, "--name", "plain")
    until(lambda: "it asks for a certificate: --tls DIR" in plain.output(), "it says so")
    assert plain.end() == 0
