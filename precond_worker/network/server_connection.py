# SPDX-License-Identifier: MIT
"""The connection of a worker to one server: receives matrices, sends patterns and factors, says hello."""

import contextlib
import os
import socket
import threading
import time
from collections import Counter
from typing import Self

import zenoh

from precond_worker.errors import NameTaken
from precond_worker.network.heartbeat import Heartbeat
from precond_worker.network.offered_factors import OfferedFactors
from precond_worker.network.presence import Presence, ServerGone, ServersThere
from precond_worker.network.receive_queue import ReceiveQueue
from precond_worker.network.retry import Retry
from precond_worker.remote_assembly import can_assemble
from protocol.channels import CHANNELS, MOST_JOBS, PROTOCOL, check_name, key
from protocol.counters import Counters
from protocol.factor import FactorPattern
from protocol.messages_pb2 import Factor, FactorBatch, Header, Scene, Topology, WorkerInfo
from protocol.network.session import LINK_LEASE, Session
from protocol.refused import Refused
from protocol.shared_memory import device_probe
from protocol.shared_memory import probe as shm_probe
from protocol.shared_memory.device_probe import OpenedMemory
from protocol.shared_memory.view import SlotMap
from protocol.validate import check_header, parse

BLOCK = zenoh.CongestionControl.BLOCK
TIMEOUT = 5.0  # s for a topology or a scene
NAME_CONFLICT_TIME = 3.0  # s after the first hello in which a worker gives way to another one of its name


class ServerConnection:
    """One worker of one server. received: queue of samples with a matrix and of events of the server.

    wake: set by each of them. device: opens device memory of servers; None: this worker has none. Raises NameTaken if
    another worker has that name. Two that join at the same instant do not see each other's token: one of them finds a
    NameTaken in `received`.
    """

    def __init__(
        self, session: Session, server: str, name: str, threads: int, library: str, counters: Counters,
        wake: threading.Event | None = None, device: OpenedMemory | None = None,
    ):  # fmt: skip
        self.server, self.name = check_name(server, "server name"), check_name(name, "worker name")
        self.library = library
        self.counters = counters
        self.received: ReceiveQueue[ServerGone | ServersThere | zenoh.Sample | NameTaken] = ReceiveQueue(256, wake)
        self.slots = SlotMap()
        self.incarnation = 0  # of the server that is served; 0: none
        self.shared_memory = False
        self.device, self.device_memory = device, False
        self.share = 1.0  # part of this process's time for the server
        self._together = 0
        self.leaving: float | None = None  # since when it takes no more jobs [s, monotonic]
        self._session, self._threads, self._can_assemble = session, threads, can_assemble()
        self._sequence: Counter[str] = Counter()
        self._saying = threading.Lock()
        zs = session.zenoh
        own = key("alive_worker", server, worker=name)
        self._claim(zs, own)
        # Subscribed first, announced last: the server sends as soon as it knows the token.
        self.offered = OfferedFactors(session, server, name, counters)
        self._matrices = zs.declare_subscriber(key("matrix", server, worker=name), self.received.put)
        self._batches = zs.declare_subscriber(key("matrices", server, worker=name), self.received.put)
        self._token = zs.liveliness().declare_token(own)
        self._retry, self._device_retry = Retry(), Retry()
        self._conflict_end = float("inf")  # [s, monotonic]; after that time it gives way to no other worker
        self._others = zs.declare_subscriber(key("worker", server, worker=name), self._heard)
        self._presence = Presence(zs, server, name, counters, self.received.put, lambda: self._heartbeat.wake())
        self._heartbeat = Heartbeat(self._beat)
        self._presence.begin()

    def _claim(self, session: zenoh.Session, token: str) -> None:
        """Waits until the token of a process that died with this name is gone: the lease of its link."""
        end = time.monotonic() + LINK_LEASE / 1000 + 0.5
        while any(reply.ok is not None for reply in session.liveliness().get(token, timeout=1.0)):
            if time.monotonic() > end:
                raise self._taken("another worker")
            time.sleep(0.1)

    def _taken(self, who: str) -> NameTaken:
        text = f"{who} of server {self.server} is called {self.name}; --name gives this one its own"
        return NameTaken(text, self.server)

    def _heard(self, sample: zenoh.Sample) -> None:
        """Handles a hello under this name, which may be of another worker; the larger process id gives way."""
        try:
            info = parse(WorkerInfo, sample.payload, CHANNELS["worker"].limit)
        except Refused as refusal:
            self.counters.refuse(refusal)
            return
        if (info.host, info.pid) < (_host(), os.getpid()) and time.monotonic() < self._conflict_end:
            self.received.put(self._taken(f"another worker, process {info.pid} on {info.host},"))

    def has_token(self, incarnation: int) -> bool:
        """True if that incarnation of the server has a token. May wait for the answer of a router."""
        return self._presence.has_token(incarnation)

    def follow(self, incarnation: int) -> None:
        """Serves this incarnation of the server from now on; 0: none. Probes its shared memory and says hello."""
        self._retry.stop()
        self._device_retry.stop()
        self.incarnation = self._presence.serving = 0
        self.slots.clear()
        self.shared_memory = self.device_memory = False
        if self.device is not None:
            self.device.clear()
        if incarnation:
            obstacle = "switched off here"
            if self._session.shared_memory:
                obstacle = shm_probe.obstacle(self._session.zenoh, self.server, incarnation, self.name, self.slots)
            self.shared_memory = not obstacle
            if obstacle and self._session.shared_memory:
                self.counters.warn("no_shared_memory", f"arrays travel as bytes: {obstacle}")
                self._retry.start(lambda: self._shared_memory_works(incarnation), self._enable_shared_memory)
            if self.device is not None and self._session.shared_memory:
                self.device_memory = self._device_works(incarnation)
                if not self.device_memory:
                    self._device_retry.start(lambda: self._device_works(incarnation), self._enable_device)
            self.incarnation = incarnation
            self._presence.serving = incarnation
            self._conflict_end = min(self._conflict_end, time.monotonic() + NAME_CONFLICT_TIME)
            self._heartbeat.wake()

    def _device_works(self, incarnation: int) -> bool:
        assert self.device is not None
        why = device_probe.obstacle(self._session.zenoh, self.server, incarnation, self.name, self.device)
        if why and why != device_probe.NOT_OFFERED:  # as by each server on a CPU
            self.counters.warn("no_device_memory", f"matrices and factors travel through the host: {why}")
        return not why

    def _enable_device(self) -> None:
        self.device_memory = True
        self._heartbeat.wake()

    def leave_device(self, why: str) -> None:
        """Has matrices and factors travel through the host from now on."""
        self.device_memory = False
        self.counters.warn("no_device_memory", f"matrices and factors travel through the host from now on: {why}")
        self._heartbeat.wake()

    def _beat(self) -> None:
        self._presence.look()
        self._say()
        self.offered.expire()

    def _shared_memory_works(self, incarnation: int) -> bool:
        slots = SlotMap()
        return not shm_probe.obstacle(self._session.zenoh, self.server, incarnation, self.name, slots, timeout=1.0)

    def _enable_shared_memory(self) -> None:
        """Uses shared memory after all: the server may have been busy when it was probed first."""
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
                superseded=self.counters.superseded + self.received.dropped,
                refused=self.counters.refused,
                bulk_shared=self.counters.bulk_shared,
                bulk_copied=self.counters.bulk_copied,
                builds=self._can_assemble,
                idle=self.received.idle,
                share=self.share,
                leaving=self.leaving is not None,
                most_jobs=MOST_JOBS,
                batches=True,
                together=self._together,
                device_memory=self.device_memory,
            )
            self._session.zenoh.put(key("worker", self.server, worker=self.name), info.SerializeToString())

    def header(self, object: str, epoch: int, channel: str) -> Header:
        """Returns the header of the next message on a channel."""
        self._sequence[channel + object] += 1
        return Header(
            protocol=PROTOCOL,
            incarnation=self.incarnation,
            object=object,
            epoch=epoch,
            sequence=self._sequence[channel + object],
        )

    def tell(self) -> None:
        """Says hello at once, as what it tells has changed."""
        self._heartbeat.wake()

    def topology(self, object: str, epoch: int | None = None) -> Topology:
        """Queries the topology of an object; raises Refused if the server does not have that of this epoch. None: the
        present one"""
        for reply in self._session.zenoh.get(key("topology", self.server, object=object), timeout=TIMEOUT):
            if reply.ok is None:
                break
            topology = parse(Topology, reply.ok.payload, CHANNELS["topology"].limit)
            check_header(topology, incarnation=self.incarnation, object=object, epoch=epoch)
            return topology
        raise Refused(f"the server has no topology of {object}", "object")

    def scene(self) -> Scene:
        """Queries the scene; raises Refused if the server does not answer."""
        for reply in self._session.zenoh.get(key("scene", self.server), timeout=TIMEOUT):
            if reply.ok is None:
                break
            scene = parse(Scene, reply.ok.payload, CHANNELS["scene"].limit)
            check_header(scene, incarnation=self.incarnation)
            return scene
        raise Refused("the server does not tell what it simulates", "object")

    def send_pattern(self, pattern: FactorPattern, object: str, epoch: int) -> None:
        """Sends the pattern of an object's factors."""
        message = pattern.message(self.header(object, epoch, "pattern"))
        name = key("pattern", self.server, worker=self.name, object=object)
        self._session.zenoh.put(name, message.SerializeToString(), congestion_control=BLOCK)

    def send_factor(self, message: Factor, values: bytes = b"") -> None:
        """Sends a factor or a failure; values: of the factor if they are in no slot."""
        name = key("factor", self.server, worker=self.name, object=message.header.object)
        self._session.zenoh.put(name, values, attachment=message.SerializeToString(), congestion_control=BLOCK)

    def send_factors(self, message: FactorBatch) -> None:
        """Sends answers to jobs of one batch; the values of the factors are in its slot."""
        name = key("factors", self.server, worker=self.name)
        self._session.zenoh.put(name, b"", attachment=message.SerializeToString(), congestion_control=BLOCK)

    @property
    def together(self) -> int:
        """Number of matrices of one pattern that are factorized together."""
        return self._together

    @together.setter
    def together(self, together: int) -> None:
        if together != self._together:
            self._together = together
            self._heartbeat.wake()

    def leave(self) -> None:
        """Has the server send no more jobs; one under way may still be answered."""
        if self.leaving is None:
            self.leaving = time.monotonic()
            self._heartbeat.wake()

    def stay(self) -> None:
        """Takes jobs again after `leave`."""
        self.leaving = None
        self._heartbeat.wake()

    def withdraw(self) -> None:
        """Closes, and takes back what it has declared, where the session goes on without it."""
        self.close()
        self._presence.end()
        with contextlib.suppress(zenoh.ZError):
            self.offered.close()
        for declared in (self._token, self._matrices, self._batches, self._others):
            with contextlib.suppress(zenoh.ZError):
                declared.undeclare()

    def close(self) -> None:
        """Ends the heartbeat; the session is closed by its owner."""
        self._retry.close()
        self._device_retry.close()
        self._heartbeat.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _host() -> str:
    return socket.gethostname()[:64]
