# SPDX-License-Identifier: MIT
"""What whoever reaches the port can try: sixty attacks, each on a session of its own, and some that only rights stop.

An attack gets an Attacker and returns; what it declared is gone when its session closes. Without certificates all of
ATTACKS may come from anybody on the machine, and RULING is what everybody may do there; with them a viewer tries both.
"""

import contextlib
import os
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import zenoh

from protocol import messages_pb2 as pb
from protocol.channels import CHANNELS, PROTOCOL, ROOT, key
from protocol.network.endpoints import host_of, port_of
from protocol.network.identity import Identity
from protocol.network.session import Session, open_session

EVIL = 0xDEADBEEF
ESCAPES = "\x1b]0;PWNED\a\x1b[31m\r\nsim-server: all is well"
BLOCK = zenoh.CongestionControl.BLOCK


@dataclass(frozen=True)
class Victim:
    """What anybody can read in the status, of who uses the server honestly. incarnation: of the server.

    beside: a second endpoint at which it listens
    """

    incarnation: int
    client: str
    grab: int
    worker: str
    pid: int
    host: str
    beside: str


class Attacker:
    """A session with what attacks need. identity: of a certificate; None: bare."""

    def __init__(self, endpoint: str, victim: Victim, identity: Identity | None = None):
        self.endpoint, self.victim, self.identity = endpoint, victim, identity
        self.name = f"{identity.name}.mallory" if identity else "mallory"
        self._own: Session = open_session("client", connect=[endpoint], shared_memory=False, tls=identity)
        self.zenoh = self._own.zenoh
        self.kept: list[Any] = []

    def session(self) -> Session:
        """One more session."""
        return open_session("client", connect=[self.endpoint], shared_memory=False, tls=self.identity)

    def tokens(self, channel: str, names: Sequence[str]) -> list[zenoh.LivelinessToken]:
        field = {"alive_worker": "worker", "alive_server": "incarnation", "alive_client": "client"}[channel]
        found = [self.zenoh.liveliness().declare_token(key(channel, **{field: name})) for name in names]
        self.kept += found
        return found

    def put(self, where: str, payload: bytes = b"", attachment: bytes | None = None) -> None:
        self.zenoh.put(f"{ROOT}/sim/{where}", payload, attachment=attachment)

    def ask(self, where: str, payload: bytes | None = None, timeout: float = 1.0) -> list[bytes]:
        """Payloads of the answers."""
        replies = self.zenoh.get(f"{ROOT}/sim/{where}", payload=payload, timeout=timeout)
        return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

    def flood(self, where: str, payload: bytes | None, count: int) -> None:
        """Queries whose answers nobody reads."""
        for _ in range(count):
            self.zenoh.get(f"{ROOT}/sim/{where}", lambda reply: None, payload=payload, timeout=1.0)

    def command(self, verb: str, client: str = "", where: str = "", **fields: Any) -> bytes:
        """A Command under its own key; returns the answer, b"" without one."""
        client = client or self.name
        header = fields.pop("header", pb.Header(protocol=PROTOCOL))
        message = pb.Command(header=header, verb=verb, client=client, **fields)
        found = self.ask(where or f"command/{verb}/{client}", message.SerializeToString())
        return found[0] if found else b""

    def heartbeat(self, name: str, sequence: int = 1, **fields: Any) -> None:
        header = pb.Header(protocol=PROTOCOL, incarnation=self.victim.incarnation, sequence=sequence)
        info = pb.WorkerInfo(header=header, worker=name, **{"pid": 1, "host": "here", **fields})
        self.zenoh.put(key("worker", worker=name), info.SerializeToString(), congestion_control=BLOCK)

    def factor(self, worker: str, job: int = 1, values: bytes = b"\0" * 64, **fields: Any) -> None:
        header = pb.Header(protocol=PROTOCOL, incarnation=self.victim.incarnation, object="beam", epoch=1, sequence=job)
        message = pb.Factor(header=header, worker=worker, job=job, step=job, warp=True, dtype="float32",
                            nonzeros=len(values) // 4, **fields)  # fmt: skip
        self.put(f"factor/{worker}/beam", values, message.SerializeToString())

    @contextlib.contextmanager
    def fake_workers(self, count: int, answer: Callable[[str, zenoh.Sample], None]) -> Iterator[None]:
        """Workers that take jobs. answer: called with name and job."""
        names = [f"{self.name}-{k}" for k in range(count)]
        for name in names:
            self.kept.append(self.zenoh.declare_subscriber(key("matrix", worker=name),
                                                           lambda sample, name=name: answer(name, sample)))  # fmt: skip
        self.tokens("alive_worker", names)
        for beat in range(1, 13):
            for name in names:
                self.heartbeat(name, beat, library="supernodal", threads=1, idle=beat < 3)
            time.sleep(0.2)
        yield

    def close(self) -> None:
        self._own.close()
        self.kept.clear()


Attack = Callable[[Attacker], object]
ATTACKS: dict[str, Attack] = {}
RULING: dict[str, Attack] = {}


def attack(what: str, where: dict[str, Attack] = ATTACKS) -> Callable[[Attack], Attack]:
    def noted(run: Attack) -> Attack:
        assert what not in where
        where[what] = run
        return run

    return noted


def each(what: str, cases: dict[str, Attack], where: dict[str, Attack] = ATTACKS) -> None:
    for name, run in cases.items():
        attack(f"{what}: {name}", where)(run)


# --- tokens -------------------------------------------------------------------------------------------------------


def come_and_go(a: Attacker, channel: str, name: str, times: int = 1) -> None:
    for _ in range(times):
        (token,) = a.tokens(channel, [name])
        time.sleep(0.3 / times)
        token.undeclare()


each("token", {
    "of a server": lambda a: (a.tokens("alive_server", [f"{EVIL:016x}"]), time.sleep(1.0)),
    "of 300 servers": lambda a: (a.tokens("alive_server", [f"{k:016x}" for k in range(1, 300)]), time.sleep(1.0)),
    "of the very server, and gone": lambda a: come_and_go(a, "alive_server", f"{a.victim.incarnation:016x}"),
    "of servers without a number": lambda a: a.tokens("alive_server", ["zz", "0", "-1", "f" * 64]),
    "of a server, 200 times": lambda a: come_and_go(a, "alive_server", f"{EVIL:016x}", 200),
    "of 1100 workers": lambda a: (a.tokens("alive_worker", [f"fake{k}" for k in range(1100)]), time.sleep(0.5)),
    "of the worker, and gone": lambda a: come_and_go(a, "alive_worker", a.victim.worker),
    "of the client, and gone": lambda a: come_and_go(a, "alive_client", a.victim.client),
    "of 1000 clients": lambda a: (a.tokens("alive_client", [f"client{k}" for k in range(1000)]), time.sleep(0.5)),
})  # fmt: skip

# --- heartbeats ---------------------------------------------------------------------------------------------------

each("heartbeat", {
    "without a token, 300 names": lambda a: [a.heartbeat(f"ghost{k}") for k in range(300)],
    "of the worker, with a huge number": lambda a: a.heartbeat(a.victim.worker, 2**63, pid=a.victim.pid,
                                                               host=a.victim.host),
    "of the worker, of another process": lambda a: [a.heartbeat(a.victim.worker, k + 1) for k in range(20)],
    "with texts that move the cursor": lambda a: a.heartbeat(a.name, library=ESCAPES, host=ESCAPES),
    "under another's key": lambda a: a.put(f"worker/{a.name}", pb.WorkerInfo(worker="other").SerializeToString()),
    "of 100 MB": lambda a: a.put(f"worker/{a.name}", bytes(100_000_000)),
    "no message at all": lambda a: [a.put(f"worker/{a.name}", os.urandom(50)) for _ in range(50)],
})  # fmt: skip


# --- workers and factors ------------------------------------------------------------------------------------------


@attack("20 workers that take jobs and never answer")
def _keep(a: Attacker) -> None:
    with a.fake_workers(20, lambda name, sample: None):
        pass


def job_of(sample: zenoh.Sample) -> pb.Matrix:
    assert sample.attachment is not None
    return pb.Matrix.FromString(sample.attachment.to_bytes())


@attack("a worker whose jobs all fail, with texts that move the cursor")
def _fail(a: Attacker) -> None:
    def answer(name: str, sample: zenoh.Sample) -> None:
        a.factor(name, job_of(sample).header.sequence, b"", failure=ESCAPES)

    with a.fake_workers(1, answer):
        pass


@attack("a worker that answers with garbage")
def _garbage(a: Attacker) -> None:
    def answer(name: str, sample: zenoh.Sample) -> None:
        a.factor(name, job_of(sample).header.sequence, os.urandom(4096), pattern=1, checksum=1)

    with a.fake_workers(3, answer):
        pass


each("factor", {
    "in the worker's name, 200 numbers": lambda a: [a.factor(a.victim.worker, k) for k in range(200)],
    "that failed, in the worker's name": lambda a: [
        a.factor(a.victim.worker, k, b"", failure="no") for k in range(200)],
    "not a number": lambda a: a.factor(a.victim.worker, 1, b"\xff" * 4096, pattern=1),
    "with 2^40 values": lambda a: a.factor(a.victim.worker, 1, b"", pattern=1, seconds=1e308),
    "of 100 MB": lambda a: a.factor(a.victim.worker, 1, bytes(100_000_000)),
    "of an object that is none": lambda a: a.put(
        f"factor/w/{'x' * 64}", b"1", pb.Factor(worker="w").SerializeToString()),
    "without attachment": lambda a: [a.put("factor/w/beam", b"1") for _ in range(100)],
    "deleted": lambda a: [a.zenoh.delete(key(c, object="beam").replace("*", a.victim.worker))
                         for c in ("factor", "pattern", "topology", "state")],
    "pattern with indices out of range": lambda a: a.put(f"pattern/{a.victim.worker}/beam", pb.FactorPattern(
        header=pb.Header(protocol=PROTOCOL, incarnation=a.victim.incarnation, object="beam", epoch=1, sequence=1),
        rows=b"\xff" * 4000, permutation=b"\x7f" * 4000).SerializeToString()),
    "patterns, 300 of garbage": lambda a: [a.put("pattern/w/beam", os.urandom(3000)) for _ in range(300)],
})  # fmt: skip

# --- answers and messages in the server's name ----------------------------------------------------------------------


def shadow(a: Attacker, reply: Callable[[zenoh.Query], None], where: str = f"{ROOT}/sim/**") -> None:
    held: list[zenoh.Query] = []

    def answer(query: zenoh.Query) -> None:
        held.append(query)
        with suppress(zenoh.ZError):
            reply(query)

    a.kept += [a.zenoh.declare_queryable(where, answer), held]
    time.sleep(1.0)  # in which the honest ask
    for query in held:
        query.drop()


def forged(query: zenoh.Query) -> None:
    head = pb.Header(protocol=PROTOCOL, incarnation=EVIL)
    query.reply(query.key_expr, pb.Status(header=head, scene="EVIL", step=666).SerializeToString())


each("answers to all questions", {
    "silence": lambda a: shadow(a, lambda query: None),
    "garbage": lambda a: shadow(a, lambda query: query.reply(query.key_expr, b"\xff" * 40)),
    "forged ones": lambda a: shadow(a, forged),
    "forged ones, with a token": lambda a: (a.tokens("alive_server", [f"{EVIL:016x}"]), shadow(a, lambda q: None)),
    "of probes": lambda a: shadow(a, lambda query: query.reply(query.key_expr, b"", attachment=b"\xff"),
                                  f"{ROOT}/sim/echo/*"),
})  # fmt: skip


def in_its_name(a: Attacker, channel: str, message: Any, incarnation: int = EVIL) -> None:
    message.header.protocol, message.header.incarnation = PROTOCOL, incarnation
    for _ in range(20):
        a.put(channel, message.SerializeToString())
        time.sleep(0.01)


each("in the server's name", {
    "status": lambda a: in_its_name(a, "status", pb.Status(scene="EVIL", step=666)),
    "steps": lambda a: in_its_name(a, "steps", pb.Steps(steps=[pb.ObjectStep(step=10**9)])),
    "state": lambda a: in_its_name(a, "state/beam", pb.State(step=10**9, nodes=1, x=bytes(24), v=bytes(24))),
    "topology": lambda a: in_its_name(a, "topology/beam", pb.Topology(nodes=1)),
    "jobs": lambda a: [a.put(f"matrix/{a.victim.worker}/beam", os.urandom(100), os.urandom(100)) for _ in range(50)],
    "need": lambda a: in_its_name(a, "need", pb.Need()),
})  # fmt: skip

# --- commands -----------------------------------------------------------------------------------------------------


def of_grab(a: Attacker, **more: Any) -> pb.Interaction:
    return pb.Interaction(id=a.victim.grab, object="beam", kind="grab", client=a.victim.client, **more)


def push(force: float = 1e-9, **more: Any) -> pb.Interaction:
    return pb.Interaction(object="beam", kind="push", at="tip", force=pb.Vector(x=force), **more)


each("command", {
    "release of another's grab": lambda a: a.command("release", a.victim.client, interaction=of_grab(a)),
    "move of another's grab, with a secret": lambda a: a.command(
        "move", a.victim.client, secret=bytes(16), interaction=of_grab(a, target=pb.Vector(x=9))),
    "release of another's grab, in one's own name": lambda a: a.command("release", interaction=of_grab(a)),
    "another's rate used up": lambda a: a.flood(
        f"command/push/{a.victim.client}", pb.Command(
            header=pb.Header(protocol=PROTOCOL), verb="push", client=a.victim.client).SerializeToString(), 500),
    "under another key": lambda a: a.command("stop", where=f"command/push/{a.name}"),
    "under all keys": lambda a: [a.command("stop", where=w) for w in ("command/*/*", "command/**", "**", "command")],
    "2000 pushes at once": lambda a: a.flood(f"command/push/{a.name}", pb.Command(
        header=pb.Header(protocol=PROTOCOL), verb="push", client=a.name, interaction=push()).SerializeToString(), 2000),
    "pushes of 200 invented clients": lambda a: [
        a.flood(f"command/push/{a.name}{k}", pb.Command(header=pb.Header(protocol=PROTOCOL), verb="push",
                client=f"{a.name}{k}", interaction=push(duration=0.02)).SerializeToString(), 1) for k in range(200)],
    "pushes that last for ever": lambda a: [a.command("push", interaction=push(duration=1e308)) for _ in range(16)],
    "forces that are no numbers": lambda a: [
        a.command("push", interaction=push(force)) for force in (float("nan"), float("inf"), 1e308, -1e300)],
    "grabs with targets out of this world": lambda a: [a.command("grab", interaction=pb.Interaction(
        object="beam", kind="grab", at="tip", target=pb.Vector(x=x), stiffness=s, max_force=1e308))
        for x, s in ((1e308, 1.0), (1e200, 1e308), (-1e300, 5e-324))],
    "names of 60,000 characters": lambda a: [
        a.command("push", interaction=pb.Interaction(object="x" * 60_000)),
        a.command("x" * 60_000, where="command/x/y")],
    "texts that move the cursor": lambda a: a.command("push", interaction=pb.Interaction(object=ESCAPES)),
    "of 1 MB": lambda a: a.ask(f"command/push/{a.name}", bytes(1_000_000)),
    "500 of garbage": lambda a: [a.flood(f"command/push/{a.name}", os.urandom(60), 1) for _ in range(500)],
    "of another version, and of another life": lambda a: [
        a.command("pause", header=pb.Header(protocol=PROTOCOL + 1)),
        a.command("pause", header=pb.Header(protocol=PROTOCOL, incarnation=EVIL))],
    "unknown verbs": lambda a: [a.command(v) for v in ("__class__", "exec", "STOP")],
    "parameters that are code": lambda a: [a.command("set", parameters=[pb.Parameter(key=k, value=v)]) for k, v in (
        ("beam.corotational.young", "__import__('os').abort()"), ("object.beam.mesh.file", '"/dev/zero"'),
        ("dt", "1e-300"), ("beam.corotational.young", "nan"), ("x" * 300, "[" * 8000))],
})  # fmt: skip

# --- questions and subscriptions ------------------------------------------------------------------------------------

each("questions", {
    "3000 for the status": lambda a: a.flood("status", None, 3000),
    "500 for meshes": lambda a: a.flood("topology/*", None, 500),
    "500 for everything": lambda a: a.flood("**", None, 500),
    "500 probes of shared memory": lambda a: a.flood(f"echo/{a.name}", pb.Echo(
        header=pb.Header(protocol=PROTOCOL, sequence=3), nonce=5).SerializeToString(), 500),
    "300 probes of another version": lambda a: a.flood(f"echo/{a.name}", pb.Echo(
        header=pb.Header(protocol=PROTOCOL + 1)).SerializeToString(), 300),
})  # fmt: skip


@attack("subscriptions: 1000, and gone")
def _subscribe(a: Attacker) -> None:
    found = [a.zenoh.declare_subscriber(f"{ROOT}/sim/state/{k}", lambda sample: None) for k in range(1000)]
    for each_of_them in found:
        each_of_them.undeclare()  # type: ignore[no-untyped-call]


@attack("a reader of everything that sleeps")
def _sleep(a: Attacker) -> None:
    a.kept.append(a.zenoh.declare_subscriber("**", lambda sample: time.sleep(0.2)))
    time.sleep(2.0)


# --- connections ----------------------------------------------------------------------------------------------------


def connections(a: Attacker, count: int, data: bytes = b"", beside: bool = False) -> None:
    """With TLS fewer: zenoh takes no other connection for 0.1 s after each handshake that fails. beside: to the second
    endpoint of the server."""
    found = []
    endpoint = a.victim.beside if beside else a.endpoint
    with suppress(OSError):
        for _ in range(count if a.identity is None or beside else 100):
            one = socket.create_connection((host_of(endpoint), port_of(endpoint)), timeout=1.0)
            found.append(one)
            if data:
                one.sendall(data)
    for one in found:
        one.close()


def garbage(a: Attacker) -> None:
    for channel in CHANNELS.values():
        where = channel.key.format(worker=a.name, object="beam", client=a.name, incarnation=f"{EVIL:016x}", verb="push")
        for _ in range(30):
            a.put(where, os.urandom(200), os.urandom(50))


each("connections", {
    "1500 that say nothing, with TLS 100": lambda a: connections(a, 1500),
    "300 of random bytes, with TLS 100": lambda a: connections(a, 300, os.urandom(2000)),
    "1500 of random bytes, at another endpoint": lambda a: connections(a, 1500, os.urandom(500), beside=True),
    "30 sessions, one after another": lambda a: [a.session().close() for _ in range(30)],
})  # fmt: skip
attack("garbage on every channel")(garbage)

# --- what without certificates everybody may ------------------------------------------------------------------------

each("command", {
    **{verb: lambda a, verb=verb: a.command(verb) for verb in ("stop", "pause", "save", "reset", "add_worker")},
    "kill_worker": lambda a: a.command("kill_worker", worker=a.victim.worker.rpartition(".")[2]),
    "set": lambda a: a.command("set", parameters=[pb.Parameter(key="beam.corotational.young", value="1")]),
    "push of 1e5 N": lambda a: a.command("push", interaction=push(1e5, duration=10)),
}, RULING)  # fmt: skip
each("in the server's name, with its number", {
    "status": lambda a: in_its_name(a, "status", pb.Status(scene="EVIL"), a.victim.incarnation),
    "steps": lambda a: in_its_name(
        a, "steps", pb.Steps(steps=[pb.ObjectStep(step=10**9)]), a.victim.incarnation),
    "answers": lambda a: shadow(a, lambda query: query.reply(query.key_expr, pb.Status(header=pb.Header(
        protocol=PROTOCOL, incarnation=a.victim.incarnation), scene="EVIL").SerializeToString())),
}, RULING)  # fmt: skip
