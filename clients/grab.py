# SPDX-License-Identifier: MIT
"""The handle of a grab: moves it, tells its force and releases it, also when the code around it fails."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Protocol, Self

from clients.errors import BadInput, ClientError
from clients.forces import Forces, Load, Vector
from protocol import messages_pb2 as pb


class Sender(Protocol):
    """What a grab uses of a Client."""

    timeout: float

    @property
    def forces(self) -> Forces: ...

    def command(self, verb: str, interaction: pb.Interaction) -> pb.Reply: ...

    def send(
        self, verb: str, interaction: pb.Interaction, answered: Callable[[pb.Reply | None], None] = ...
    ) -> int: ...


class Grab:
    """Handle of a grab, from Client.grab. `interaction`: the grab as the server accepted it, with id and nodes."""

    def __init__(self, sender: Sender, interaction: pb.Interaction) -> None:
        self._sender = sender
        self.interaction = interaction
        self.released = False
        self._refusal = ""  # of a move that was not waited for

    def move(self, target: Sequence[float], wait: bool = True) -> int | None:
        """Moves the far end of the spring to `target` [m].

        wait: for the answer. Without, it may be called 1000 times a second: returns the number of the move, and a
        refusal is raised by the next call. Raises BadInput.
        """
        if self._refusal:
            refusal, self._refusal = self._refusal, ""
            raise BadInput(f"move: {refusal}")
        x, y, z = target
        wanted = self._reference()
        wanted.target.CopyFrom(pb.Vector(x=x, y=y, z=z))
        if not wait:
            return self._sender.send("move", wanted, self._answered)
        self._sender.command("move", wanted)
        return None

    @property
    def force(self) -> Vector:
        """What the spring pulls the object with in the newest step [N]; the hand feels the contrary.

        The first call waits for a step with the grab. Of a grab that is released there is none. Raises ClientError.
        """
        x, y, z = self._load().force
        return -x, -y, -z

    @property
    def point(self) -> Vector:
        """Where the grabbed point is after the newest step [m]: the target, where the spring pulls with no force."""
        point = self._load().point
        assert point is not None
        return point

    def _load(self) -> Load:
        if self.released:
            raise ClientError("the grab is released")
        return self._sender.forces.grab(self.interaction.id, self._sender.timeout)

    def release(self) -> None:
        """Releases the grab; a second call does nothing."""
        if not self.released:
            self.released = True
            self._sender.command("release", self._reference())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        # After an error the first message matters, and the server releases the grab itself when this client is gone.
        with contextlib.suppress(*((BadInput, ClientError) if kind else ())):
            self.release()

    def _answered(self, reply: pb.Reply | None) -> None:
        if reply is not None and reply.error:
            self._refusal = reply.error

    def _reference(self) -> pb.Interaction:
        return pb.Interaction(id=self.interaction.id, object=self.interaction.object, kind="grab")
