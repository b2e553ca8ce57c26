# SPDX-License-Identifier: MIT
"""The network side of the server: session, name, published messages, clients and commands.

No method waits for the network: messages are sent by threads of their own, and arriving ones stay in bounded rings
until they are read. Methods are for the service thread, except `close`; those of `dispatch` are for any thread.
"""

import logging
import secrets
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from typing import Self

import zenoh
from zenoh.handlers import RingChannel

from protocol.access.rights import Rights
from protocol.channels import PROTOCOL, SERVER_NAME, check_name, key, name_in
from protocol.counters import Counters
from protocol.messages_pb2 import (
    Checkpoint,
    Command,
    LocalWorker,
    Need,
    Obstacle,
    ObstaclePose,
    Reply,
    Scene,
    State,
    Status,
    Steps,
    Topology,
)
from protocol.network.access_rules import access_rules
from protocol.network.identity import Identity, roles_of
from protocol.network.session import open_session
from protocol.refused import Refused
from protocol.shared_memory.limits import POOL_LIMIT
from protocol.shared_memory.pool import Slot, SlotPool, SlotsUnusable
from sim_server.backends.shared_memory import SharedMemory
from sim_server.network.device_slots import DeviceSlots
from sim_server.network.dispatch import Dispatch
from sim_server.network.name_claim import NameClaim
from sim_server.network.publishers import Publishers
from sim_server.network.queryables import Queryables
from sim_server.network.send_queue import SendQueue

log = logging.getLogger(__name__)

SWITCH_SECONDS = 5e-4  # for which a thread may keep Python's lock while the thread that serves the loop wants it back
MESSAGE_THREADS = 2  # that take in messages of factors: one calls native code while the other has Python's lock
TOKENS = 4096  # liveliness tokens of clients that may wait to be read
REPLIES = 1024  # replies to commands that may wait to be sent

Stamped = Checkpoint | Need | Obstacle | ObstaclePose | Scene | State | Status | Steps | Topology
"""Messages with a header of the server."""


class ServerLink:
    """The server on the network.

    Raises BadEndpoint, ConnectionFailed or NameTaken.

    name: of the server in all keys
    listen: endpoints; loopback if None
    connect: other servers to be linked with
    slots: bytes of shared memory for matrices and factors
    tls: certificate; roles of others are read beside it. None: none is asked for
    silence: seconds without a heartbeat until a worker gets no more jobs
    clock: monotonic time [s]

    dispatch: the remote workers, a source of factors
    local_workers: returns the workers that this process supervises, for the status
    """

    def __init__(
        self,
        name: str = SERVER_NAME,
        listen: Sequence[str] | None = None,
        connect: Sequence[str] | None = None,
        *,
        shared_memory: bool = True,
        slots: int = POOL_LIMIT,
        tls: Identity | None = None,
        silence: float = 2.0,
        clock: Callable[[], float] = time.monotonic,
    ):
        self.name = check_name(name, "server name")
        sys.setswitchinterval(min(SWITCH_SECONDS, sys.getswitchinterval()))
        self.incarnation = secrets.randbits(63) | 1
        self.counters = Counters(log)
        self.local_workers: Callable[[], list[LocalWorker]] = list
        roles = None if tls is None else roles_of(tls)
        self._rights = Rights(roles)
        with ExitStack() as closing:
            self._session = open_session(
                "server", listen=listen, connect=connect, shared_memory=shared_memory, name=self.name, tls=tls,
                access=None if roles is None else access_rules([self.name], roles),
            )  # fmt: skip
            closing.callback(self._session.close)
            self._claim = NameClaim(self._session, self.name, self.incarnation, listen, connect, clock, tls)
            closing.callback(self._claim.close)
            self._pool, probe_slot = self._make_slots(slots)
            if self._pool is not None:
                closing.callback(self._pool.close)
            self._job_queue, self._telemetry_queue = SendQueue("jobs", 64), SendQueue("telemetry", 64)
            self._reply_queue = SendQueue("replies", REPLIES)
            closing.callback(self._reply_queue.close, finish=True)
            self._urgent_queue = SendQueue("urgent", 64)
            closing.callback(self._urgent_queue.close)
            closing.callback(self._telemetry_queue.close)
            closing.callback(self._job_queue.close)
            self._declare(probe_slot, silence, clock)
            self._closing = closing.pop_all()

    def _declare(self, probe_slot: Slot | None, silence: float, clock: Callable[[], float]) -> None:
        session = self._session.zenoh
        self.dispatch = Dispatch(
            session, self.name, self.incarnation, self._pool, self._job_queue, self.counters, silence, clock
        )
        for k in range(MESSAGE_THREADS):
            self._session.thread(f"factors of messages {k + 1}", self.dispatch.take_in_batches)
        self._queryables = Queryables(
            self._session, self.name, self.incarnation, self.counters, probe_slot, self._reply_queue, self._claim,
            self._rights,
        )  # fmt: skip
        self._publishers = Publishers(
            session, self.name, self._telemetry_queue, self._urgent_queue, self.counters, self._stamp
        )
        self._clients: set[str] = set()
        self._client_tokens = session.liveliness().declare_subscriber(
            key("alive_client", self.name), RingChannel(TOKENS), history=True
        )
        self._claim.watch()
        # Declared last: workers take it as the sign that everything else is there.
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
        """Raises NameTaken if this server has to leave its name to another that started at the same time."""
        self._claim.check()

    @property
    def shared_memory(self) -> bool:
        """True if there is a pool of slots for workers on this host."""
        return self._pool is not None

    @property
    def slots_lent(self) -> int:
        """Number of slots lent to jobs now. A probe for tests."""
        return self._pool.lent - 1 if self._pool is not None else 0  # one is for shm_probe

    def share_device(self, memory: SharedMemory) -> None:
        """Has matrices and factors stay in device memory where a worker can open it: one on this host, of this user.
        Not without shared memory of the host, by which it is known to be."""
        slots = DeviceSlots(memory, self.counters)
        if self._pool is None or not slots.usable:
            return slots.close()
        self._closing.callback(slots.close)
        self.dispatch.share_device(slots)
        self._queryables.device = slots

    def announce(self, topology: Topology) -> None:
        """Begins a new epoch of an object: sends its topology to all and offers it to those who join later."""
        data = self._encoded(topology)
        object = check_name(topology.header.object, "Topology.header.object")
        self.dispatch.announce(topology)
        name = key("topology", self.name, object=object)
        self._queryables.set_answer(name, data)
        self._job_queue.post(
            lambda: self._session.zenoh.put(name, data, congestion_control=zenoh.CongestionControl.BLOCK)
        )

    def renew_topology(self, object: str, change: Callable[[Topology], None]) -> None:
        """Changes the answer to queries for the topology of an object, whose epoch goes on."""
        name = key("topology", self.name, object=object)
        topology = Topology.FromString(self._queryables.answer(name))
        change(topology)
        self._queryables.set_answer(name, topology.SerializeToString())

    def set_scene(self, scene: Scene) -> None:
        """Sets the answer to queries for the scene."""
        self._queryables.set_answer(key("scene", self.name), self._encoded(scene))

    def set_checkpoint(self, checkpoint: Checkpoint) -> None:
        """Sets the answer to queries for the state that was saved last."""
        self._queryables.set_answer(key("checkpoint", self.name), self._encoded(checkpoint))

    def set_obstacle(self, obstacle: Obstacle) -> None:
        """Sets the answer to queries for an obstacle."""
        name = check_name(obstacle.header.object, "Obstacle.header.object")
        self._queryables.set_answer(key("obstacle", self.name, object=name), self._encoded(obstacle))

    def clients(self) -> list[str]:
        """Returns the names of the clients that are connected."""
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
        """Returns the commands that came since the last call, each with a function to answer it from any thread."""
        return self._queryables.commands()

    def wants_steps(self) -> bool:
        """True if somebody subscribed to step records."""
        return self._publishers.has_subscribers("steps")

    def wants_state(self, object: str = "*") -> bool:
        """True if somebody subscribed to the state of an object; "*": of any object."""
        return self._publishers.has_subscribers("state", object=object)

    def wants_pose(self, obstacle: str = "*") -> bool:
        """True if somebody subscribed to the pose of an obstacle; "*": of any."""
        return self._publishers.has_subscribers("pose", object=obstacle)

    def wants_reactions(self) -> bool:
        """True if somebody subscribed to what objects exert in each step."""
        return self._publishers.has_subscribers("reactions")

    def publish_reactions(self, steps: Steps) -> None:
        """Sends what objects exert in steps to subscribers."""
        self._publishers.put("reactions", steps)

    def publish_steps(self, steps: Steps) -> None:
        """Sends step records to their subscribers."""
        self._publishers.put("steps", steps)

    def publish_state(self, state: State) -> None:
        """Sends positions and velocities to their subscribers; replaces a state that still waits to be sent."""
        self._publishers.put("state", state, object=state.header.object)

    def publish_pose(self, pose: ObstaclePose) -> None:
        """Sends where an obstacle is to subscribers; replaces a pose that still waits to be sent."""
        self._publishers.put("pose", pose, object=pose.header.object)

    def publish_need(self, lost: float) -> None:
        """Tells the workers of a pool what more of them are worth. lost: as of Need"""
        workers = sum(info.share or 1.0 for info in self.dispatch.workers())
        self._publishers.put("need", Need(lost=lost, workers=workers))

    def publish_status(self, status: Status) -> None:
        """Fills in workers, clients and counts, sends the status to its subscribers and sets the answer to queries."""
        del status.workers[:], status.clients[:], status.local_workers[:]
        status.local_workers.extend(self.local_workers())
        status.workers.extend(self.dispatch.workers())
        status.clients.extend(self.clients())
        status.bulk_shared, status.bulk_copied = self.counters.bulk_shared, self.counters.bulk_copied
        status.bulk_on_device = self.counters.bulk_on_device
        status.refused = self.counters.refused
        status.commands_refused, status.moves_replaced = self.counters.commands_refused, self.counters.moves_replaced
        status.bulk_bytes_out, status.bulk_bytes_in = self.counters.bytes_out, self.counters.bytes_in
        status.frames_dropped += self.counters.frames_dropped
        self._queryables.set_answer(key("status", self.name), self._encoded(status))
        self._publishers.put("status", status)

    def _encoded(self, message: Stamped) -> bytes:
        self._stamp(message, message.header.sequence + 1)
        return message.SerializeToString()

    def _stamp(self, message: Stamped, sequence: int) -> None:
        message.header.protocol = PROTOCOL
        message.header.incarnation = self.incarnation
        message.header.sequence = sequence

    def close(self) -> None:
        """Leaves the network; jobs in flight are dropped. A second call does nothing."""
        self._closing.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
