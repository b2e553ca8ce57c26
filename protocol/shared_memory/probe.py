# SPDX-License-Identifier: MIT
"""Probe of shared memory between a worker and its server, end to end (channel echo).

The worker queries the server's echo slot: its bytes must arrive by reference, and the worker's own mapping of the
segment must show the same bytes. It then writes a number there and asks the server to read it.

A query without a number asks which incarnations are alive: servers answer it with their header alone, also those of
another wire version, so that a worker knows why it has no server.
"""

import contextlib
import secrets
from collections.abc import Callable

import numpy as np
import zenoh

from protocol.channels import CHANNELS, PROTOCOL, key
from protocol.messages_pb2 import Echo, Header
from protocol.refused import Refused
from protocol.shared_memory.pool import HEADER, Slot
from protocol.shared_memory.view import SlotMap
from protocol.validate import check_header, parse

LANES = 64  # probes at the same time
NUMBERS = 2 * LANES  # of 8 bytes: the server's, then the worker's
LIMIT = CHANNELS["echo"].limit
Answered = Callable[[dict[int, Echo]], None]
MAX_ANSWERS = 64  # incarnations of a server


def answer(slot: Slot, query: Echo, incarnation: int) -> tuple[Echo, zenoh.ZBytes]:
    """Server: returns the reply to a query, and the payload to send with it."""
    lane = query.header.sequence % LANES
    numbers = slot.array(np.uint64, NUMBERS)
    numbers[lane] = query.nonce
    header = Header(protocol=PROTOCOL, incarnation=incarnation, sequence=query.header.sequence)
    return Echo(header=header, slot=slot.message(), nonce=int(numbers[LANES + lane])), slot.payload


def who(session: zenoh.Session, server: str, asker: str, answered: Answered, timeout: float = 1.0) -> None:
    """Queries which incarnations of a server are alive; does not wait.

    answered: called in a thread of zenoh's with the answer of each incarnation.
    """
    found: dict[int, Echo] = {}

    def take(reply: zenoh.Reply) -> None:
        if reply.ok is not None and len(found) < MAX_ANSWERS:
            with contextlib.suppress(Refused):
                message = parse(Echo, reply.ok.attachment, LIMIT)
                found[message.header.incarnation] = message

    session.get(
        key("echo", server, worker=asker),
        zenoh.handlers.Callback(take, lambda: answered(found)),
        payload=Echo(header=Header(protocol=PROTOCOL)).SerializeToString(),
        timeout=timeout,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,  # all answers have one key
    )


def obstacle(
    session: zenoh.Session, server: str, incarnation: int, worker: str, slots: SlotMap, timeout: float = 2.0
) -> str:
    """Worker: says why shared memory does not work with this incarnation of the server; empty if it works both ways."""
    lane = secrets.randbelow(LANES)
    try:
        nonce = secrets.randbits(63)
        question = Echo(header=Header(protocol=PROTOCOL, sequence=lane), nonce=nonce)
        reply, payload = ask(session, server, incarnation, worker, question, timeout)
        if not reply.HasField("slot"):
            return "the server offers none"
        if payload.as_shm() is None:
            return "what the server put there arrived as a copy"
        numbers = slots.array(reply.slot, np.uint64, NUMBERS)
        sent = np.frombuffer(payload.to_bytes(), np.uint64, LANES, HEADER)
        if int(numbers[lane]) != nonce or int(sent[lane]) != nonce:
            return "the mapped segment does not show what the server wrote"
        numbers[LANES + lane] = nonce ^ 1
        reply, _ = ask(session, server, incarnation, worker, question, timeout)
        return "" if reply.nonce == nonce ^ 1 else "the server does not see what is written there"
    except (Refused, zenoh.ZError, ValueError) as error:
        return str(error)


def ask(
    session: zenoh.Session, server: str, incarnation: int, worker: str, question: Echo, timeout: float
) -> tuple[Echo, zenoh.ZBytes]:
    """Worker: returns the answer of an incarnation of the server, and its payload; raises Refused without one."""
    selector = key("echo", server, worker=worker)
    replies = session.get(
        selector,
        payload=question.SerializeToString(),
        timeout=timeout,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,
    )
    for reply in replies:
        if reply.ok is None:
            break
        message = parse(Echo, reply.ok.attachment, LIMIT)
        if message.header.incarnation != incarnation:
            continue  # another server of this name
        check_header(message)
        return message, reply.ok.payload
    raise Refused(f"the server did not answer on {selector} within {timeout} s", "malformed")
