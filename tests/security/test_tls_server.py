# SPDX-License-Identifier: MIT
"""A real server with certificates: what each role may, whose grab is whose, and what who is refused is told."""

import datetime
import logging
import shutil
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import zenoh
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization

from clients.client import Client
from clients.errors import BadInput, ClientError
from precond_worker.network.server_connection import ServerConnection
from precond_worker.worker import Worker
from protocol import messages_pb2 as pb
from protocol.access.client_name import new_client
from protocol.channels import PROTOCOL, key
from protocol.counters import Counters
from protocol.network.identity import identity_of
from protocol.network.session import open_session
from sim_server.certificates.in_use import Certificates
from sim_server.errors import InputError
from sim_server.network import job_sender
from sim_server.network.factor_fetch import FactorFetch
from sim_server.network.link import ServerLink
from tests.ports import free_endpoint
from tests.system.link_helpers import DenseAnalysis, Driver, chain, dense, matrix, product
from tests.system.server_process import PATIENCE, Stage, beam, run, until

pytestmark = pytest.mark.system
BLOCK = zenoh.CongestionControl.BLOCK


def certs(folder: Path, *arguments: str) -> None:
    done = run("sim_server", "certs", str(folder), *arguments)
    assert done.returncode == 0, done.stderr


class TlsStage(Stage):
    """A server with a worker of its own."""

    def __init__(self, folder: Path):
        super().__init__(folder)
        self.endpoint = self.endpoint.replace("tcp/", "tls/")
        self.certs = folder / "certs"
        certs(self.certs, "--host", "localhost", "--client", "alice:participant", "--client", "bob:operator",
              "--client", "late:operator", "--client", "mill:worker")  # fmt: skip
        roles = self.certs / "roles.toml"
        roles.write_text(roles.read_text().replace('late = "operator"\n', ""))
        everywhere = self.endpoint.replace("127.0.0.1", "0.0.0.0")
        self.start("sim_server", str(beam(folder)), "--tls", str(self.certs), "--listen", everywhere, "--workers", "1")

    def as_(self, name: str) -> Client:
        """A client with this certificate, once the server is there."""
        found: list[Client] = []

        def connected() -> bool:
            try:
                found.append(Client(connect=[self.endpoint], tls=self.certs / name, timeout=2.0))
            except ClientError as error:
                if "no server 'sim'" not in str(error) and "cannot connect" not in str(error):
                    raise
            return bool(found)

        until(connected, f"a client {name}")
        found[0].timeout = PATIENCE
        return found[0]


@pytest.fixture(scope="module")
def stage(tmp_path_factory: pytest.TempPathFactory) -> Iterator[TlsStage]:
    one = TlsStage(tmp_path_factory.mktemp("tls"))
    yield one
    one.close()


def test_workers_and_an_operator_do_all_that_there_is(stage: TlsStage) -> None:
    with stage.as_("bob") as bob:
        until(lambda: any(o.last.factor_step >= 0 for o in bob.status(fresh=True).objects), "a factor is used")
        assert [w.worker for w in bob.status().workers] == ["worker.local-1"]
        assert bob.push("beam", at="tip", force=(1, 0, 0), duration=0.02).nodes == 1
        states, steps = bob.states(), bob.steps()
        until(states.newest, "a state")
        until(steps.new, "steps")
        step = bob.pause().status.step
        assert bob.status(fresh=True).step == step and bob.status().refused == 0
        bob.resume()


def test_a_viewer_looks_and_does_nothing(stage: TlsStage) -> None:
    with stage.as_("viewer") as eve:
        assert eve.status(fresh=True).scene and list(eve.meshes()) == ["beam"] and eve.parameters()
        states = eve.states()
        until(states.newest, "a state")
        for verb, allowed in (("push", "participant or operator"), ("stop", "operator"), ("set", "operator")):
            with pytest.raises(BadInput, match=f"'viewer' is that of a viewer; {verb} is for {allowed}"):
                eve.command(verb)
        with pytest.raises(BadInput, match="is that of a viewer"):
            eve.send("move")
        assert eve.status(fresh=True).state == "running"


def test_a_participant_touches_and_does_not_rule(stage: TlsStage) -> None:
    with stage.as_("alice") as alice, stage.as_("bob") as bob:
        with alice.grab("beam", at="tip", stiffness=100.0) as held:
            held.move((0.1, 0.5, 4.0))
            assert alice.id in bob.status(fresh=True).clients and alice.id.startswith("alice.client-")
            with pytest.raises(BadInput, match=f"client '{bob.id}' has no interaction"):
                bob.command("release", pb.Interaction(id=held.interaction.id, object="beam", kind="grab"))
        with pytest.raises(BadInput, match="'alice' is that of a participant; pause is for operator"):
            alice.pause()


def test_nobody_acts_in_the_name_of_another_even_with_its_secret(stage: TlsStage) -> None:
    """The key must have the name, and access rules know whose names it may be."""
    with stage.as_("alice") as alice, alice.grab("beam", at="tip", stiffness=100.0) as held:
        bob = identity_of(stage.certs / "bob", ())
        with open_session("client", connect=[stage.endpoint], shared_memory=False, tls=bob) as session:

            def said(client: str, secret: bytes, where: str) -> list[str]:
                ids = pb.Interaction(id=held.interaction.id, object="beam", kind="grab", client=client)
                command = pb.Command(header=pb.Header(protocol=PROTOCOL), client=client, verb="release",
                                     secret=secret, interaction=ids)  # fmt: skip
                replies = session.zenoh.get(key("command", verb="release", client=where),
                                            payload=command.SerializeToString(), timeout=30.0)  # fmt: skip
                return [pb.Reply.FromString(bytes(r.ok.payload)).error for r in replies if r.ok is not None]

            name, secret = new_client("bob")
            assert said(alice.id, alice.secret, alice.id) == [], "denied on its way"
            assert "came under the key" in said(alice.id, alice.secret, name)[0]
            assert said(name, secret, name) == [
                f"client '{name}' has no interaction {held.interaction.id}; it may be over"
            ]
        held.move((0.1, 0.2, 4.0))


def test_who_is_refused_is_told_why(stage: TlsStage, tmp_path: Path) -> None:
    def told(tls: Path | None, endpoint: str = stage.endpoint) -> str:
        with pytest.raises(ClientError) as refused:
            Client(connect=[endpoint], tls=tls, timeout=0.5)
        return str(refused.value)

    port = stage.endpoint.rpartition(":")[2]
    stage.as_("bob").close()
    assert "it asks for a certificate: --tls DIR" in told(None)
    assert f"it speaks TLS: --connect tls/127.0.0.1:{port} --tls DIR" in told(None, f"tcp/127.0.0.1:{port}")
    assert "its certificate is not for 127.0.0.2; `sim-server certs DIR --host 127.0.0.2`" in told(
        stage.certs / "bob", f"tls/127.0.0.2:{port}"
    )
    other = tmp_path / "other"
    certs(other, "--host", "localhost")
    assert f"its certificate is not signed by the authority of {other / 'viewer'}" in told(other / "viewer")
    shutil.copy(stage.certs / "ca.pem", other / "viewer" / "ca.pem")
    assert "it does not know the authority that signed this certificate" in told(other / "viewer")
    assert "this certificate has expired" in told(expired(stage.certs, tmp_path / "old"))
    for name in ("late", "worker"):
        assert f"that answers the certificate '{name}': does roles.toml of the server have it" in told(
            stage.certs / name
        )
    found = run("clients", "stop", "--connect", stage.endpoint, "--tls", str(stage.certs / "viewer"))
    assert (found.returncode, found.stderr) == (
        2, "sim-client: stop: the certificate 'viewer' is that of a viewer; stop is for operator\n"
    )  # fmt: skip
    found = run("clients", "status", "--connect", f"tcp/127.0.0.1:{port}", "--tls", str(stage.certs))
    assert found.returncode == 2 and "cannot be used with --tls; allowed: tls/HOST:PORT" in found.stderr


def expired(authority: Path, folder: Path) -> Path:
    """A copy of the viewer's folder with a certificate that was valid until yesterday."""
    shutil.copytree(authority / "viewer", folder)
    old = x509.load_pem_x509_certificate((folder / "cert.pem").read_bytes())
    now, day = datetime.datetime.now(datetime.UTC), datetime.timedelta(days=1)
    new = x509.CertificateBuilder(old.issuer, old.subject, old.public_key(), x509.random_serial_number(),
                                  now - 2 * day, now - day, list(old.extensions))  # fmt: skip
    signer = serialization.load_pem_private_key((authority / "ca.key").read_bytes(), None)
    pem = new.sign(signer, hashes.SHA256()).public_bytes(serialization.Encoding.PEM)  # type: ignore[arg-type]
    (folder / "cert.pem").write_bytes(pem)
    return folder


def test_who_has_no_certificate_of_a_worker_is_none(stage: TlsStage) -> None:
    """Neither is one without a certificate; both wait, as for a server that is not there."""
    plain = stage.start("precond_worker", "--connect", stage.endpoint, "--name", "w")
    until(lambda: "it asks for a certificate: --tls DIR" in plain.output(), "it says so")
    wrong = stage.start("precond_worker", "--connect", stage.endpoint, "--tls", str(stage.certs / "viewer"))
    with stage.as_("bob") as bob:
        now = bob.status(fresh=True).step
        until(lambda: bob.status(fresh=True).step > now + 20, "steps")
        assert [w.worker for w in bob.status().workers] == ["worker.local-1"]
    until(lambda: "'viewer' was made for a viewer: a server that has it as one" in wrong.output(), "it says so")
    assert (plain.end(), wrong.end()) == (0, 0)


def test_a_worker_sends_factors_in_its_own_name_alone(stage: TlsStage) -> None:
    """Access rules go by the worker in the key; the server compares it with that of the message."""
    mill, count = identity_of(stage.certs / "mill", ()), 20
    with stage.as_("bob") as bob, open_session("client", connect=[stage.endpoint], shared_memory=False,
                                               tls=mill) as session:  # fmt: skip

        def used() -> int:
            return bob.status(fresh=True).objects[0].last.factor_step

        until(lambda: used() >= 0, "a factor is used")
        before = bob.status(fresh=True)
        header = pb.Header(protocol=PROTOCOL, incarnation=before.header.incarnation, object="beam", epoch=1)
        answer = pb.Factor(header=header, worker="worker.local-1", failure="no")
        pattern = pb.FactorPattern(header=header)
        for where in ("worker.local-1", "mill.w"):  # the second ones come last: then the first ones never will
            for answer.job in range(1, count + 1):
                names = {"worker": where, "object": "beam"}
                session.zenoh.put(key("factor", **names), b"", attachment=answer.SerializeToString(),
                                  congestion_control=BLOCK)  # fmt: skip
                session.zenoh.put(key("pattern", **names), pattern.SerializeToString(), congestion_control=BLOCK)
        until(lambda: bob.status(fresh=True).refused >= before.refused + 2 * count, "what has its own name comes")
        last = used()
        until(lambda: used() > last, "factors of the other one")
        assert bob.status(fresh=True).refused == before.refused + 2 * count


def test_an_open_server_does_not_start_and_insecure_overrides_it_with_a_warning(tmp_path: Path) -> None:
    words = [str(beam(tmp_path)), "--listen", "tcp/0.0.0.0:0", "--steps", "1"]
    done = run("sim_server", *words)
    assert done.returncode == 2 and "Two ways on: `sim-server certs DIR --host NAME`" in done.stderr
    assert "--insecure" in done.stderr and not done.stdout
    done = run("sim_server", *words, "--insecure")
    assert done.returncode == 0, done.stderr
    assert "sim-server: --insecure: tcp/0.0.0.0:0: anybody who reaches it may stop this server" in done.stderr


@pytest.mark.parametrize("name", ["worker", "viewer"])
def test_certificates_of_others_do_not_serve(stage: TlsStage, name: str) -> None:
    def used(tls: str, **own: bool) -> Certificates:
        return Certificates(tls, None, None, False, **{"workers": False, "web": False, **own})

    with pytest.raises(InputError, match=f"this certificate is that of a {name}, not of a server"):
        used(str(stage.certs / name))
    assert used(str(stage.certs), workers=True).for_worker == ["--tls", str(stage.certs / "worker")]
    shutil.move(stage.certs / "operator", stage.certs / "elsewhere")
    with pytest.raises(InputError, match=f"{stage.certs / 'operator'}: is missing"):
        used(str(stage.certs), web=True)
    shutil.move(stage.certs / "elsewhere", stage.certs / "operator")


def test_parts_of_a_factor_pass_the_rules(stage: TlsStage, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(job_sender, "PART_BYTES", 64)
    where, topology, ended = free_endpoint().replace("tcp/", "tls/"), chain(), threading.Event()
    with (
        ServerLink(listen=[where], shared_memory=False, tls=identity_of(stage.certs, ("server",))) as link,
        open_session("client", connect=[where], shared_memory=False, tls=identity_of(stage.certs / "worker", ())) as to,
        ServerConnection(to, "sim", "worker.w", 1, "dense", Counters(logging.getLogger("worker"))) as connection,
    ):
        worker = Worker(connection, DenseAnalysis)

        def work() -> None:
            while not ended.is_set():
                worker.step(0.05)

        thread = threading.Thread(target=work)
        thread.start()
        try:
            link.announce(topology)
            fetches = counted_fetches(monkeypatch)
            factor = Driver(link).factor(topology, 1)
        finally:
            ended.set()
            thread.join()
        assert np.allclose(product(factor), dense(topology, matrix(topology)), atol=1e-5)
        assert fetches == [19], "it came in parts"


def counted_fetches(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """Numbers of parts of the factors that are fetched from now on."""
    found: list[int] = []
    run_fetch = FactorFetch.run

    def noted(fetch: FactorFetch) -> object:
        found.append(len(fetch.parts))
        return run_fetch(fetch)

    monkeypatch.setattr(FactorFetch, "run", noted)
    return found


def test_a_worker_cannot_pose_as_the_server(stage: TlsStage) -> None:
    """It listens with its own certificate: no client believes that it is a server."""
    where = free_endpoint().replace("tcp/", "tls/")
    worker = identity_of(stage.certs / "worker", ())
    told = pytest.raises(ClientError, match=r"its certificate is not (that of a server|for 127)")
    with open_session("server", listen=[where], shared_memory=False, tls=worker), told:
        Client(connect=[where], tls=stage.certs / "bob", timeout=0.5)
