# SPDX-License-Identifier: MIT
"""Commands that came together, before they are looked at in full: of the moves of a grab the newest is enough."""

from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

from protocol.messages_pb2 import Command
from protocol.refused import Refused

Sender = TypeVar("Sender")


class Coalesced(NamedTuple, Generic[Sender]):
    """taken: in the order of their arrival; refused: each with the reason; replaced: moves that newer ones overtook."""

    taken: list[tuple[Command, Sender]]
    refused: list[tuple[Refused, Sender]]
    replaced: list[Sender]


def coalesce_moves(asked: Sequence[tuple[Command, Sender]], check: Callable[[Command], None]) -> Coalesced[Sender]:
    """asked: parsed, in the order of their arrival, each with whom to answer. check: raises Refused.

    A move is passed over unchecked if a newer one of the same client and grab is well-formed. At 1 kHz a client moves
    more often than its grab is looked at, and the check is what costs most.
    """
    found: Coalesced[Sender] = Coalesced([], [], [])
    moved: set[tuple[str, int]] = set()
    for command, sender in reversed(asked):
        grab = (command.client, command.interaction.id) if command.verb == "move" else None
        if grab in moved:
            found.replaced.append(sender)
            continue
        try:
            check(command)
        except Refused as refusal:
            found.refused.append((refusal, sender))
            continue
        if grab is not None:
            moved.add(grab)
        found.taken.append((command, sender))
    found.taken.reverse()
    return found
