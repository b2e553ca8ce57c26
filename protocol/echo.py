# SPDX-License-Identifier: MIT
"""Does shared memory work between this worker and its server? Tried end to end before it is relied on.

The worker asks for the server's echo slot: its bytes must arrive by reference, and the same bytes must stand in the
worker's own mapping of the segment. It then writes a number there and asks the server to read it.

A question without a number asks who is there: servers answer it with their header alone, those of another wire version
too, so that a worker learns which lives of its server answer, and why none does.
"""

import contextlib
import secrets
from collections.abc import Callable

import numpy as np
import zenoh

from protocol.channels import CHANNELS, PROTOCOL, key
from protocol.check import check_header, parse
from protocol.messages_pb2 import Echo, Header
from protocol.refused import Refused
from protocol.slotmap import SlotMap
from protocol.slots import HEADER, Slot

LANES = 64  # askers that may be at it at the same time
NUMBERS = 2 * LANES  # of 8 bytes: the server's, then the worker's
LIMIT = CHANNELS["echo"].limit
Answered = Callable[[dict[int, Echo]], None]
ANSWERS = 64  # lives of a server that are told apart


def answer(slot: Slot, query: Echo, incarnation: int) -> tuple[Echo, zenoh.ZBytes]:
    """Server: the reply to one question, and the payload to send with it."""
    lane = query.header.sequence % LANES
    numbers = slot.array(np.uint64, NUMBERS)
    numbers[lane] = query.nonce
    header = Header(protocol=PROTOCOL, incarnation=incarnation, sequence=query.header.sequence)
    return Echo(header=header, slot=slot.message(), nonce=int(numbers[LANES + lane])), slot.payload


def who(session: zenoh.Session, server: str, asker: str, answered: Answered, timeout: float = 1.0) -> None:
    """Ask which lives of a server are there; does not wait.

    answered: is called in a thread of zenoh's with what each incarnation said that answered in time.
    """
    found: dict[int, Echo] = {}

    def take(reply: zenoh.Reply) -> None:
        if reply.ok is not None and len(found) < ANSWERS:
            with contextlib.suppress(Refused):
                message = parse(Echo, reply.ok.attachment, LIMIT)
                found[message.header.incarnation] = message

    session.get(
        key("echo", server, worker=asker),
        zenoh.handlers.Callback(take, lambda: answered(found)),
        payload=Echo(header=Header(protocol=PROTOCOL)).SerializeToString(),
        timeout=timeout,
        target=zenoh.QueryTarget.ALL,
        consolidation=zenoh.ConsolidationMode.NONE,  # their answers have one key: each counts
    )


def obstacle(
    session: zenoh.Session, server: str, incarnation: int, worker: str, slots: SlotMap, timeout: float = 2.0
) -> str:
    """Worker: why shared memory cannot be used with this life of the server; empty if it works both ways."""
    lane = secrets.randbelow(LANES)
    try:
        nonce = secrets.randbits(63)
        reply, payload = _ask(session, server, incarnation, worker, lane, nonce, timeout)
        if not reply.HasField("slot"):
            return "the server offers none"
        if payload.as_shm() is None:
            return "what the server put there arrived as a copy"
        numbers = slots.array(reply.slot, np.uint64, NUMBERS)
        sent = np.frombuffer(payload.to_bytes(), np.uint64, LANES, HEADER)
        if int(numbers[lane]) != nonce or int(sent[lane]) != nonce:
            return "the mapped segment does not show what the server wrote"
        numbers[LANES + lane] = nonce ^ 1
        reply, _ = _ask(session, server, incarnation, worker, lane, nonce, timeout)
        return "" if reply.nonce == nonce ^ 1 else "the server does not see what is written there"
    except (Refused, zenoh.ZError, ValueError) as error:
        return str(error)


def _ask(
    session: zenoh.Session, server: str, incarnation: int, worker: str, lane: int, nonce: int, timeout: float
) -> tuple[Echo, zenoh.ZBytes]:
    question = Echo(header=Header(protocol=PROTOCOL, sequence=lane), nonce=nonce)
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
