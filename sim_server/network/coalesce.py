# SPDX-License-Identifier: MIT
"""Drops moves of a grab or an obstacle that newer ones replace, before commands are checked in full."""

from collections.abc import Callable, Hashable, Sequence
from typing import Generic, NamedTuple, TypeVar

from protocol.messages_pb2 import Command
from protocol.refused import Refused

Sender = TypeVar("Sender")


def moved_by(command: Command) -> Hashable | None:
    """Returns what a move is of, (client, id of a grab) or (client, name of an obstacle); None for other commands."""
    if command.verb == "move":
        return command.client, command.interaction.id
    if command.verb == "move_obstacle":
        return command.client, command.target.obstacle
    return None


class Coalesced(NamedTuple, Generic[Sender]):
    """Commands that arrived together, sorted by what becomes of them.

    accepted: in the order of arrival
    refused: each with the reason
    replaced: senders of moves that a newer move of the same grab or obstacle replaces
    """

    accepted: list[tuple[Command, Sender]]
    refused: list[tuple[Refused, Sender]]
    replaced: list[Sender]


def coalesce_moves(received: Sequence[tuple[Command, Sender]], check: Callable[[Command], None]) -> Coalesced[Sender]:
    """Checks commands, except moves that a newer well-formed move by the same client of the same thing replaces.

    A client may move at 1 kHz, more often than the simulation looks at its moves, and the check costs more than
    all else that is done with one.

    received: parsed commands with their senders, in the order of arrival
    check: raises Refused
    """
    found: Coalesced[Sender] = Coalesced([], [], [])
    moved: set[Hashable] = set()
    for command, sender in reversed(received):
        what = moved_by(command)
        if what in moved:
            found.replaced.append(sender)
            continue
        try:
            check(command)
        except Refused as refusal:
            found.refused.append((refusal, sender))
            continue
        if what is not None:
            moved.add(what)
        found.accepted.append((command, sender))
    found.accepted.reverse()
    return found
