# SPDX-License-Identifier: MIT
"""The worker's side of the network: which server lives, matrices in, patterns and factors out."""

import os
import socket
import threading
import time
from collections import Counter
from typing import Self

import zenoh

from precond_worker.again import Again
from precond_worker.builders import can_build
from precond_worker.errors import NameTaken
from precond_worker.heartbeat import Heartbeat
from precond_worker.mailbox import Mailbox
from precond_worker.presence import Presence, ServerGone, ServersThere
from protocol import FactorPattern, echo
from protocol.channels import CHANNELS, PROTOCOL, check_name, key
from protocol.check import check_header, parse
from protocol.counters import Counters
from protocol.messages_pb2 import Factor, Header, Scene, Topology, WorkerInfo
from protocol.refused import Refused
from protocol.session import LINK_LEASE, Session
from protocol.slotmap import SlotMap

BLOCK = zenoh.CongestionControl.BLOCK
TIMEOUT = 5.0  # s for a topology
SETTLED = 3.0  # s after the first hello in which a worker gives way to another of its name that joins too


class Uplink:
    """One worker of one server. mailbox holds what came: a sample with a matrix, or what was heard of the
    server; it rings the bell.

    Raises NameTaken if another worker has that name. Two that join at the same instant see neither's token: of these
    one finds a NameTaken in its mailbox.
    """

    def __init__(
        self, session: Session, server: str, name: str, threads: int, library: str, counters: Counters,
        bell: threading.Event | None = None,
    ):  # fmt: skip
        self.server, self.name = check_name(server, "server name"), check_name(name, "worker name")
        self.library = library
        self.counters = counters
        self.mailbox: Mailbox[ServerGone | ServersThere | zenoh.Sample | NameTaken] = Mailbox(256, bell)
        self.slots = SlotMap()
        self.incarnation = 0  # of the server that this worker works for; 0: none
        self.shared_memory = False
        self._session, self._threads, self._builds = session, threads, can_build()
        self._sequence: Counter[str] = Counter()
        self._saying = threading.Lock()
        zs = session.zenoh
        own = key("alive_worker", server, worker=name)
        self._claim(zs, own)
        # Subscribed first, announced last: the server sends as soon as it has heard of us.
        self._matrices = zs.declare_subscriber(key("matrix", server, worker=name), self.mailbox.put)
        self._token = zs.liveliness().declare_token(own)
        self._again = Again()
        self._settled = float("inf")  # when it is too late for another of this name [s, monotonic]
        self._others = zs.declare_subscriber(key("worker", server, worker=name), self._heard)
        self._presence = Presence(zs, server, name, counters, self.mailbox.put, lambda: self._heartbeat.wake())
        self._heartbeat = Heartbeat(self._beat)
        self._presence.begin()

    def _claim(self, session: zenoh.Session, token: str) -> None:
        """Wait until a process that died with this name is forgotten, which takes as long as the lease of its link."""
        end = time.monotonic() + LINK_LEASE / 1000 + 0.5
        while any(reply.ok is not None for reply in session.liveliness().get(token, timeout=1.0)):
            if time.monotonic() > end:
                raise self._taken("another worker")
            time.sleep(0.1)

    def _taken(self, who: str) -> NameTaken:
        return NameTaken(f"{who} of server {self.server} is called {self.name}; --name gives this one its own")

    def _heard(self, sample: zenoh.Sample) -> None:
        """A hello of this name: of ours, or of another that joined just now; the larger process number gives way."""
        try:
            info = parse(WorkerInfo, sample.payload, CHANNELS["worker"].limit)
        except Refused as refusal:
            self.counters.refuse(refusal)
            return
        if (info.host, info.pid) < (_host(), os.getpid()) and time.monotonic() < self._settled:
            self.mailbox.put(self._taken(f"another worker, process {info.pid} on {info.host},"))

    def has_token(self, incarnation: int) -> bool:
        """That life of the server is there. May wait for the answer of a router."""
        return self._presence.has_token(incarnation)

    def follow(self, incarnation: int) -> None:
        """Work for this life of the server from now on; 0: for none. Tries its shared memory and says hello."""
        self._again.stop()
        self.incarnation = self._presence.serving = 0
        self.slots.clear()
        self.shared_memory = False
        if incarnation:
            obstacle = "switched off here"
            if self._session.shared_memory:
                obstacle = echo.obstacle(self._session.zenoh, self.server, incarnation, self.name, self.slots)
            self.shared_memory = not obstacle
            if obstacle and self._session.shared_memory:
                self.counters.warn("no_shared_memory", f"arrays travel as bytes: {obstacle}")
                self._again.ask(lambda: self._memory_works(incarnation), self._share_memory)
            self.incarnation = incarnation
            self._presence.serving = incarnation
            self._settled = min(self._settled, time.monotonic() + SETTLED)
            self._heartbeat.wake()

    def _beat(self) -> None:
        self._presence.look()
        self._say()

    def _memory_works(self, incarnation: int) -> bool:
        slots = SlotMap()
        return not echo.obstacle(self._session.zenoh, self.server, incarnation, self.name, slots, timeout=1.0)

    def _share_memory(self) -> None:
        """What did not work when this life of the server was followed works now: it may have been busy."""
        self.shared_memory = True
        self.counters.warn("shared_memory_again", "shared memory works after all, arrays travel through it")
        self._heartbeat.wake()

    def _say(self) -> None:
        if not self.incarnation:
            return
        with self._saying:
            info = WorkerInfo(
                header=self.header("", 0, "worker"),
                worker=self.name,
                pid=os.getpid(),
                host=_host(),
                library=self.library,
                threads=self._threads,
                shared_memory=self.shared_memory,
                jobs=self.counters.jobs,
                failures=self.counters.failures,
                superseded=self.counters.superseded + self.mailbox.dropped,
                refused=self.counters.refused,
                bulk_shared=self.counters.bulk_shared,
                bulk_copied=self.counters.bulk_copied,
                builds=self._builds,
                idle=self.mailbox.idle,
            )
            self._session.zenoh.put(key("worker", self.server, worker=self.name), info.SerializeToString())

    def header(self, object: str, epoch: int, channel: str) -> Header:
        """Header of the next message on a channel."""
        self._sequence[channel + object] += 1
        return Header(
            protocol=PROTOCOL,
            incarnation=self.incarnation,
            object=object,
            epoch=epoch,
            sequence=self._sequence[channel + object],
        )

    def topology(self, object: str, epoch: int) -> Topology:
        """Ask the server for the topology of an object; raises Refused if it has not that of this epoch."""
        for reply in self._session.zenoh.get(key("topology", self.server, object=object), timeout=TIMEOUT):
            if reply.ok is None:
                break
            topology = parse(Topology, reply.ok.payload, CHANNELS["topology"].limit)
            check_header(topology, incarnation=self.incarnation, object=object, epoch=epoch)
            return topology
        raise Refused(f"the server has no topology of {object}", "object")

    def scene(self) -> Scene:
        """Ask the server for what it simulates; raises Refused if it does not tell."""
        for reply in self._session.zenoh.get(key("scene", self.server), timeout=TIMEOUT):
            if reply.ok is None:
                break
            scene = parse(Scene, reply.ok.payload, CHANNELS["scene"].limit)
            check_header(scene, incarnation=self.incarnation)
            return scene
        raise Refused("the server does not tell what it simulates", "object")

    def send_pattern(self, pattern: FactorPattern, object: str, epoch: int) -> None:
        """Send the pattern of an object's factors."""
        message = pattern.message(self.header(object, epoch, "pattern"))
        name = key("pattern", self.server, object=object)
        self._session.zenoh.put(name, message.SerializeToString(), congestion_control=BLOCK)

    def send_factor(self, message: Factor, values: bytes = b"") -> None:
        """Send an answer; values only if they are in no slot."""
        name = key("factor", self.server, object=message.header.object)
        self._session.zenoh.put(name, values, attachment=message.SerializeToString(), congestion_control=BLOCK)

    def close(self) -> None:
        """End the heartbeat; the session is closed by its owner."""
        self._again.close()
        self._heartbeat.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _host() -> str:
    return socket.gethostname()[:64]
