# SPDX-License-Identifier: MIT
"""Drops moves of a grab that newer ones replace, before commands are checked in full."""

from collections.abc import Callable, Sequence
from typing import Generic, NamedTuple, TypeVar

from protocol.messages_pb2 import Command
from protocol.refused import Refused

Sender = TypeVar("Sender")


class Coalesced(NamedTuple, Generic[Sender]):
    """Commands that arrived together, sorted by what becomes of them.

    accepted: in the order of arrival
    refused: each with the reason
    replaced: senders of moves that a newer move of the same grab replaces
    """

    accepted: list[tuple[Command, Sender]]
    refused: list[tuple[Refused, Sender]]
    replaced: list[Sender]


def coalesce_moves(received: Sequence[tuple[Command, Sender]], check: Callable[[Command], None]) -> Coalesced[Sender]:
    """Checks commands, except moves that a newer well-formed move of the same client and grab replaces.

    A client may move at 1 kHz, more often than the simulation looks at its grab, and the check costs more than all
    else that is done with a move.

    received: parsed commands with their senders, in the order of arrival
    check: raises Refused
    """
    found: Coalesced[Sender] = Coalesced([], [], [])
    moved: set[tuple[str, int]] = set()
    for command, sender in reversed(received):
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
        found.accepted.append((command, sender))
    found.accepted.reverse()
    return found
