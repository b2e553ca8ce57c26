# SPDX-License-Identifier: MIT
"""The handle of a grab: moves it and releases it, also when the code around it fails."""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Sequence
from typing import Self

from clients.errors import BadInput, ClientError
from protocol import messages_pb2 as pb

Send = Callable[[str, pb.Interaction], pb.Reply]


class Grab:
    """Handle of a grab, from Client.grab. `interaction`: the grab as the server accepted it, with id and nodes."""

    def __init__(self, send: Send, interaction: pb.Interaction) -> None:
        self._send = send
        self.interaction = interaction
        self.released = False

    def move(self, target: Sequence[float]) -> None:
        """Moves the far end of the spring to `target` [m]."""
        x, y, z = target
        wanted = self._reference()
        wanted.target.CopyFrom(pb.Vector(x=x, y=y, z=z))
        self._send("move", wanted)

    def release(self) -> None:
        """Releases the grab; a second call does nothing."""
        if not self.released:
            self.released = True
            self._send("release", self._reference())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        # After an error the first message matters, and the server releases the grab itself when this client is gone.
        with contextlib.suppress(*((BadInput, ClientError) if kind else ())):
            self.release()

    def _reference(self) -> pb.Interaction:
        return pb.Interaction(id=self.interaction.id, object=self.interaction.object, kind="grab")
