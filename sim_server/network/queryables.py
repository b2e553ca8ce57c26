# SPDX-License-Identifier: MIT
"""Answers the queries of clients and workers: status, scene, topology, obstacles, shared memory probes, commands."""

import logging
from collections.abc import Callable
from functools import partial

import zenoh

from protocol.access.client_name import check_client
from protocol.access.rights import Rights
from protocol.channels import CHANNELS, FORMER_COMMAND, PROTOCOL, ROOT, check_name, commands, key, name_in
from protocol.counters import Counters
from protocol.messages_pb2 import Command, Echo, Header, Reply
from protocol.network.session import Session
from protocol.refused import Refused
from protocol.shared_memory import probe as shm_probe
from protocol.shared_memory.pool import Slot
from protocol.validate import check_header, check_numbers, check_strings, parse
from sim_server.network.coalesce import coalesce_moves
from sim_server.network.command_queue import CommandQueue, PendingCommand
from sim_server.network.device_slots import DeviceSlots
from sim_server.network.name_claim import NameClaim
from sim_server.network.send_queue import SendQueue

log = logging.getLogger(__name__)

MAX_QUERIES = 256  # queries of a channel that may wait for its thread; beyond that the oldest is dropped
LONGEST_NAME = 64  # characters of the name of an obstacle
MAX_WARNED_WORKERS = 64  # workers of another wire version that are warned of one by one
QUERYABLES = ("command", "status", "scene", "topology", "obstacle", "echo", "checkpoint")  # channels
FORMER = "command of an older client"  # its queryable
OUTDATED = (
    "this client is older than the server, where each command has a key of its own; install the same release of "
    "warpfactor on both sides"
)


class Queryables:
    """A zenoh queryable and a thread for each channel, so that a flood of commands delays no other query.

    Queries for what was set by `set_answer` are answered at once. Commands wait for the simulation in a bounded queue
    (command_queue.py), except moves that newer ones replace (coalesce.py). Their replies go through a send queue, since
    zenoh blocks where a client does not read.

    probe_slot: shared memory with which workers probe whether they can use it; None: there is none
    rights: which commands are whose
    device: device memory, likewise
    """

    device: DeviceSlots | None = None

    def __init__(
        self, session: Session, server: str, incarnation: int, counters: Counters, probe_slot: Slot | None,
        replies: SendQueue, claim: NameClaim, rights: Rights,
    ):  # fmt: skip
        self._rights = rights
        self._claim = claim
        self._replies = replies
        self._server = server
        self._incarnation = incarnation
        self._counters = counters
        self._probe_slot = probe_slot
        self._commands = commands(server)
        self._former = f"{ROOT}/{server}/{FORMER_COMMAND}"
        self._echo_prefix = key("echo", server, worker="*")[:-1]
        self._answers: dict[str, bytes] = {}  # by key
        self._other_version: set[str] = set()  # workers
        self._queue = CommandQueue(counters, account=rights.account)
        self._done = self._stamped(Reply())
        self._queryables = {}
        self._keys = {channel: key(channel, server) for channel in QUERYABLES} | {FORMER: self._former}
        for channel, name in self._keys.items():
            ring: zenoh.handlers.RingChannel[zenoh.Query] = zenoh.handlers.RingChannel(MAX_QUERIES)
            self._queryables[channel] = session.zenoh.declare_queryable(name, ring)
            session.thread(f"queryable-{channel}", partial(self._run, channel))

    def set_answer(self, name: str, answer: bytes) -> None:
        """Sets the answer to queries of the key `name`."""
        self._answers[name] = answer

    def answer(self, name: str) -> bytes:
        """Returns the answer that was set; KeyError without one."""
        return self._answers[name]

    def commands(self) -> list[PendingCommand]:
        """Returns the commands that came since the last call, each with the function that answers it."""
        return self._queue.take_all()

    def _run(self, channel: str) -> None:
        queryable, own = self._queryables[channel], zenoh.KeyExpr(self._keys[channel])
        together = MAX_QUERIES if channel == "command" else 1
        while True:
            try:
                queries = [queryable.recv()]
                while len(queries) < together and (query := queryable.try_recv()) is not None:
                    queries.append(query)
            except zenoh.ZError:
                return  # the session was closed
            try:
                self.serve_all(queries, own)
            except zenoh.ZError as error:
                log.debug("a query was not answered: %s", error)
            except Exception:
                log.exception("a query was not answered")

    def serve_all(self, queries: list[zenoh.Query], own: zenoh.KeyExpr) -> None:
        """Answers queries, and queues commands. own: key expression of the queryable."""
        commands = []
        for query in queries:
            asked = str(query.key_expr)
            if asked.startswith(self._commands):
                commands.append(query)
                continue
            if asked == self._former:
                self._refuse(Refused(OUTDATED, "version"), query)
                continue
            try:
                self._serve(query, own)
            except Refused as refusal:
                self._counters.refuse(refusal)
                query.drop()
        if commands:
            self._queue_commands(commands)

    def _serve(self, query: zenoh.Query, own: zenoh.KeyExpr) -> None:
        with query:
            if str(query.key_expr).startswith(self._echo_prefix):
                return self._answer_probe(query)
            for name, answer in list(self._answers.items()):
                name_expr = zenoh.KeyExpr(name)
                if own.intersects(name_expr) and query.key_expr.intersects(name_expr):
                    query.reply(name, answer)

    def _answer_probe(self, query: zenoh.Query) -> None:
        question = parse(Echo, query.payload, CHANNELS["echo"].limit)
        if question.header.protocol != PROTOCOL:
            self._warn_of_version(query, question)
        if question.on_device and self.device is not None and question.header.protocol == PROTOCOL:
            reply = self.device.answer(question, self._incarnation)
            query.reply(query.key_expr, b"", attachment=reply.SerializeToString())
            return
        asks = bool(question.nonce) and question.header.protocol == PROTOCOL and not question.on_device
        if self._probe_slot is None or not asks:
            header = Header(protocol=PROTOCOL, incarnation=self._incarnation)
            query.reply(
                query.key_expr, b"", attachment=Echo(header=header, settled=self._claim.settled).SerializeToString()
            )
        else:
            reply, payload = shm_probe.answer(self._probe_slot, question, self._incarnation)
            query.reply(query.key_expr, payload, attachment=reply.SerializeToString())

    def _warn_of_version(self, query: zenoh.Query, question: Echo) -> None:
        """Warns once for each worker that speaks another version; the worker finds out by the header of the answer."""
        worker = name_in("echo", query.key_expr, "worker")
        refusal = Refused(
            f"worker {worker} speaks protocol version {question.header.protocol}, this server version {PROTOCOL}: "
            "it gets no jobs; install the same release of warpfactor on both sides",
            "version",
        )
        if len(self._other_version) < MAX_WARNED_WORKERS:
            self._other_version.add(worker)
        self._counters.refuse(refusal, worker if worker in self._other_version else "")

    def _queue_commands(self, queries: list[zenoh.Query]) -> None:
        received = []
        for query in queries:
            try:
                command = parse(Command, query.payload, CHANNELS["command"].limit)
                self._check_key(command, query)
                received.append((command, query))
            except Refused as refusal:
                self._refuse(refusal, query)
            except Exception as error:  # the others of this moment are carried out all the same
                self._refuse(self._counters.unexpected(error, "a Command"), query)
        found = coalesce_moves(received, self._check)
        for reason, query in found.refused:
            self._refuse(reason, query)
        for query in found.replaced:
            self._post(query, self._done)
        if found.replaced:
            self._counters.add("moves_replaced", len(found.replaced))
        for command, query in found.accepted:
            if command.verb == "rights":
                self._post(query, self._stamped(self._rights.of(command.client)))
            else:
                self._queue.put(command, self._replier(query))

    def _check_key(self, command: Command, query: zenoh.Query) -> None:
        """Raises Refused unless the key has the verb and the client: access rules know keys alone."""
        asked = str(query.key_expr)
        if asked != f"{self._commands}{command.verb}/{command.client}":
            said = f"{command.verb[:80]!r} of {command.client[:80]!r}"
            raise Refused(f"a Command, {said}, came under the key {asked[:200]}; allowed: its own", "key")

    def _check(self, command: Command) -> None:
        try:
            self._check_all(command)
        except Refused:
            raise
        except Exception as error:
            raise self._counters.unexpected(error, "a Command") from error

    def _check_all(self, command: Command) -> None:
        check_header(command, incarnation=self._incarnation if command.header.incarnation else None)
        check_name(command.client, "Command.client")
        check_strings(command)
        check_strings(command.target, LONGEST_NAME)
        check_numbers(command)
        check_client(command.client, command.secret)
        self._rights.check(command)

    def _refuse(self, refusal: Refused, query: zenoh.Query) -> None:
        self._counters.refuse(refusal)
        self._post(query, self._stamped(Reply(error=str(refusal))))

    def _replier(self, query: zenoh.Query) -> Callable[[Reply], None]:
        return lambda answer: self._post(query, self._stamped(answer))

    def _stamped(self, answer: Reply) -> bytes:
        answer.header.protocol = PROTOCOL
        answer.header.incarnation = self._incarnation
        return answer.SerializeToString()

    def _post(self, query: zenoh.Query, data: bytes) -> None:
        if not self._replies.post(lambda: self._send(query, data)):
            log.debug("a command was not answered: too many answers wait")

    def _send(self, query: zenoh.Query, data: bytes) -> None:
        try:
            query.reply(query.key_expr, data)
        except zenoh.ZError as error:
            log.debug("a command was not answered: %s", error)
        finally:
            query.drop()
