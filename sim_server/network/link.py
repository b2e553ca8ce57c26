# SPDX-License-Identifier: MIT
"""The network side of the server: jobs for remote workers, what is published, what clients ask.

Nothing here waits for the network: sending has its own threads, what arrives lies in bounded rings until the service
thread takes it. Methods are for that one thread, except close() and those of a source of factors (ready, submit, poll,
failures, workers), which a loop that waits for its factors calls from its own.
"""

import logging
import secrets
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, Self

import zenoh
from zenoh.handlers import RingChannel

from protocol import Factor
from protocol.channels import PROTOCOL, SERVER_NAME, check_name, key, name_in
from protocol.counters import Counters
from protocol.memlock import POOL_LIMIT
from protocol.messages_pb2 import Command, LocalWorker, Reply, Scene, State, Status, Steps, Topology, WorkerInfo
from protocol.refused import Refused
from protocol.session import open_session
from protocol.slots import Slot, SlotPool, SlotsUnusable
from sim_server.network.dispatch import Dispatch
from sim_server.network.name_claim import NameClaim
from sim_server.network.publishers import Publishers
from sim_server.network.queryables import Queryables
from sim_server.network.send_queue import SendQueue

if TYPE_CHECKING:
    from sim_server.factors import Job

log = logging.getLogger(__name__)

TOKENS = 4096  # joins and leaves that may wait
REPLIES = 1024  # answers to commands that may wait to be sent


class ServerLink:
    """The server on the network; a source of factors made by remote workers.

    name: of the server in all keys. listen: endpoints, loopback if None. connect: other servers to be linked with.
    slots: bytes of shared memory for matrices and factors. silence: seconds without a heartbeat until a worker gets
    no more jobs. Raises BadEndpoint, ConnectionFailed or NameTaken.
    """

    def __init__(
        self,
        name: str = SERVER_NAME,
        listen: Sequence[str] | None = None,
        connect: Sequence[str] | None = None,
        *,
        shared_memory: bool = True,
        slots: int = POOL_LIMIT,
        silence: float = 2.0,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.name = check_name(name, "server name")
        self.incarnation = secrets.randbits(63) | 1
        self.counters = Counters(log)
        self.local_workers: Callable[[], list[LocalWorker]] = list  # those that this process supervises, for the status
        with ExitStack() as closing:
            self._session = open_session(
                "server", listen=listen, connect=connect, shared_memory=shared_memory, name=self.name
            )
            closing.callback(self._session.close)
            self._claim = NameClaim(self._session, self.name, self.incarnation, listen, connect)
            closing.callback(self._claim.close)
            self._pool, echo_slot = self._make_slots(slots)
            if self._pool is not None:
                closing.callback(self._pool.close)
            self._jobs_out, self._telemetry = SendQueue("jobs", 64), SendQueue("telemetry", 64)
            self._replies = SendQueue("replies", REPLIES)
            closing.callback(self._replies.close, finish=True)
            closing.callback(self._telemetry.close)
            closing.callback(self._jobs_out.close)
            self._declare(echo_slot, silence, clock)
            self._closing = closing.pop_all()

    def _declare(self, echo_slot: Slot | None, silence: float, clock: Callable[[], float]) -> None:
        session = self._session.zenoh
        self._dispatch = Dispatch(
            session, self.name, self.incarnation, self._pool, self._jobs_out, self.counters, silence, clock
        )
        self._inquiries = Queryables(
            self._session, self.name, self.incarnation, self.counters, echo_slot, self._replies, self._claim
        )
        self._publications = Publishers(session, self.name, self._telemetry, self.counters)
        self._clients: set[str] = set()
        self._client_tokens = session.liveliness().declare_subscriber(
            key("alive_client", self.name), RingChannel(TOKENS), history=True
        )
        self._claim.begin()
        # Last, since workers take it as the sign that everything else is there.
        self._token = session.liveliness().declare_token(
            key("alive_server", self.name, incarnation=f"{self.incarnation:016x}")
        )

    def _make_slots(self, limit: int) -> tuple[SlotPool | None, Slot | None]:
        if not self._session.shared_memory:
            return None, None
        try:
            pool = SlotPool(limit)
            return pool, pool.lend(4096)
        except SlotsUnusable as problem:
            self.counters.warn("slots", f"shared memory is off, arrays travel as bytes: {problem}")
            return None, None

    def check_name(self) -> None:
        """Raise NameTaken if this server has to leave its name to another that started at the same time."""
        self._claim.check()

    @property
    def shared_memory(self) -> bool:
        """Slots can be lent to workers on this host."""
        return self._pool is not None

    def announce(self, topology: Topology) -> None:
        """A new epoch of an object, for everybody and for late joiners. Answers to older ones are refused."""
        message = self._stamped(topology)
        object = check_name(message.header.object, "Topology.header.object")
        self._dispatch.announce(message)
        data = message.SerializeToString()
        name = key("topology", self.name, object=object)
        self._inquiries.offer(name, data)
        self._jobs_out.post(
            lambda: self._session.zenoh.put(name, data, congestion_control=zenoh.CongestionControl.BLOCK)
        )

    def set_scene(self, scene: Scene) -> None:
        """What queries for the scene are answered with."""
        self._inquiries.offer(key("scene", self.name), self._stamped(scene).SerializeToString())

    def ready(self) -> int:
        """How many are idle and can take a job."""
        return self._dispatch.ready()

    def ahead(self) -> int:
        """How many of the most urgent objects are left for faster workers that are about to be free."""
        return self._dispatch.ahead()

    def submit(self, job: "Job") -> bool:
        """Send a job to an idle worker; False if there is none or the object is in flight. Copies the values."""
        return self._dispatch.submit(job)

    def poll(self) -> list[Factor]:
        """Factors that arrived and were found good since the last call."""
        return self._dispatch.poll()

    def failures(self) -> list[tuple[str, str]]:
        """(object, reason) of jobs since the last call that will bring no factor: failed, refused, late or lost."""
        return self._dispatch.failures()

    def taken_back(self) -> list[str]:
        """Objects whose worker takes its time while another one is idle: they may be sent again at once."""
        return self._dispatch.taken_back()

    def no_use(self, worker: str, object: str) -> None:
        """A factor of a worker was refused, or solves had to leave it."""
        self._dispatch.no_use(worker, object)

    def of_use(self, worker: str, object: str) -> None:
        """A solve was made with a factor of a worker."""
        self._dispatch.of_use(worker, object)

    def setbacks(self) -> dict[str, int]:
        """By object, jobs in a row that came to nothing with the best of its workers."""
        return self._dispatch.setbacks()

    def reserved(self) -> set[str]:
        """Objects that are better left for a busy worker, since factors of the idle ones came to nothing."""
        return self._dispatch.reserved()

    def workers(self) -> list[WorkerInfo]:
        """Workers that may be given work, as they last described themselves."""
        return self._dispatch.workers()

    def builds(self) -> bool:
        """There are workers, and all of them can assemble matrices from positions."""
        return self._dispatch.builds()

    def clients(self) -> list[str]:
        """Names of the clients that are connected."""
        while (sample := self._client_tokens.try_recv()) is not None:
            try:
                client = name_in("alive_client", sample.key_expr, "client")
            except Refused as refusal:
                self.counters.refuse(refusal)
                continue
            if sample.kind != zenoh.SampleKind.PUT:
                self._clients.discard(client)
            elif len(self._clients) < TOKENS:
                self._clients.add(client)
        return sorted(self._clients)

    def commands(self) -> list[tuple[Command, Callable[[Reply], None]]]:
        """Commands that came since the last call, each with the function that answers it, from any thread."""
        return self._inquiries.commands()

    def wants_steps(self) -> bool:
        """Somebody listens to step records."""
        return self._publications.wanted("steps")

    def wants_state(self, object: str = "*") -> bool:
        """Somebody listens to the state of an object; "*": of any."""
        return self._publications.wanted("state", object=object)

    def publish_steps(self, steps: Steps) -> None:
        """Send step records to those who listen."""
        self._publications.put("steps", steps, self._stamp)

    def publish_state(self, state: State) -> None:
        """Send positions and velocities to those who listen; a state still waiting is replaced."""
        self._publications.put("state", state, self._stamp, object=state.header.object)

    def publish_status(self, status: Status) -> None:
        """Send and keep for queries; what the link knows best (workers, clients, counts) is filled in."""
        del status.workers[:], status.clients[:], status.local_workers[:]
        status.local_workers.extend(self.local_workers())
        status.workers.extend(self.workers())
        status.clients.extend(self.clients())
        status.bulk_shared, status.bulk_copied = self.counters.bulk_shared, self.counters.bulk_copied
        status.refused = self.counters.refused
        status.commands_refused, status.moves_replaced = self.counters.commands_refused, self.counters.moves_replaced
        status.bulk_bytes_out, status.bulk_bytes_in = self.counters.bytes_out, self.counters.bytes_in
        status.frames_dropped += self.counters.frames_dropped
        self._inquiries.offer(key("status", self.name), self._stamped(status).SerializeToString())
        self._publications.put("status", status, self._stamp)

    def _stamped(self, message: Any) -> Any:
        self._stamp(message, message.header.sequence + 1)
        return message

    def _stamp(self, message: Any, sequence: int) -> None:
        message.header.protocol = PROTOCOL
        message.header.incarnation = self.incarnation
        message.header.sequence = sequence

    def close(self) -> None:
        """Leave the network; jobs in flight are dropped. A second call does nothing."""
        self._closing.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
