# SPDX-License-Identifier: MIT
"""A grab by one drag of a pointer: nothing in it waits, since it is called in the event loop of the page."""

from __future__ import annotations

import contextlib
import itertools
import json
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from clients.errors import ClientError
from clients.log.frames import Mesh
from protocol import messages_pb2 as pb

PUSH_SECONDS = 0.2  # s of simulation that a push lasts
STRETCH = 0.25  # part of an object's size by which a spring that bears its weight is stretched
STIFF = 0.02  # stiffness of a spring over Young's modulus times size, at least

_numbers = itertools.count(1)


class Sender(Protocol):
    """What a hand uses of a Client."""

    def send(
        self, verb: str, interaction: pb.Interaction | None = None, answered: Callable[[pb.Reply | None], None] = ...
    ) -> int: ...


@dataclass(frozen=True)
class Grip:
    """How an object is taken hold of by default."""

    size: float  # m, diagonal of its box
    stiffness: float  # N/m
    limit: float  # N, that the scene allows for one push or grab


def grip(mesh: Mesh, described: Mapping[str, Any]) -> Grip:
    """Returns sensible values for an object. described: its table in the scene (Scene.resolved).

    The spring bears the object's weight at a stretch of a quarter of its size, and is not too soft to bend it.
    """
    corners = mesh.rest[mesh.tets]
    volume = float(np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum() / 6)
    density = described.get("density")
    mass = volume * (float(density) if isinstance(density, int | float) else 1000.0)
    size = float(np.linalg.norm(np.ptp(mesh.rest, axis=0))) or 1.0
    young = float(np.median(mesh.young)) if len(mesh.young) else 0.0
    touch = (described.get("effects") or {}).get("touch")
    limit = touch.get("max_force") if isinstance(touch, Mapping) else None
    stiffness = max(9.81 * mass / (STRETCH * size), STIFF * young * size, 1e-6)
    return Grip(size, stiffness, float(limit) if isinstance(limit, int | float) else 1e4)


def described_objects(resolved: str) -> dict[str, dict[str, Any]]:
    """Returns the tables of the objects by name from Scene.resolved; empty if they cannot be read."""
    with contextlib.suppress(ValueError, TypeError, KeyError, AttributeError):
        return {str(table["name"]): table for table in json.loads(resolved)["object"]}
    return {}


class Hand:
    """One grab. It begins at once, is moved and released; the answers come in threads of zenoh's.

    vertex: of the scene's surface, which the spring is drawn from
    refused: called with the reason if the server refuses it
    """

    def __init__(
        self, client: Sender, object: str, vertex: int, point: Sequence[float], target: Sequence[float], radius: float,
        stiffness: float, max_force: float, refused: Callable[[str], None],
    ) -> None:  # fmt: skip
        self.number = next(_numbers)
        self.object, self.vertex, self.target = object, vertex, tuple(target)
        self.id: int | None = None  # once the server has taken it
        self.over = False
        self.force = 0.0  # N, of the newest step that is known
        self._client, self._refused = client, refused
        self._lock = threading.Lock()
        wanted = pb.Interaction(
            object=object, kind="grab", point=vector(point), target=vector(target), radius=radius, stiffness=stiffness,
            max_force=max_force,
        )  # fmt: skip
        self._send("grab", wanted, self._taken)

    def move(self, target: Sequence[float]) -> None:
        """Moves the far end of the spring."""
        with self._lock:
            self.target = tuple(target)
            known = self.id is not None and not self.over
        if known:
            self._send("move", self._reference(target=vector(target)))

    def release(self) -> None:
        """Lets go; a second call does nothing. A grab that is not known yet is released once it is."""
        with self._lock:
            known, self.over = self.id is not None and not self.over, True
        if known:
            self._send("release", self._reference())

    def _taken(self, reply: pb.Reply | None) -> None:
        if reply is None or reply.error:
            with self._lock:
                self.over = True
            self._refused("the server did not answer" if reply is None else reply.error)
            return
        with self._lock:
            self.id = reply.interaction.id
            over, target = self.over, self.target
        self._send("release", self._reference()) if over else self._send("move", self._reference(target=vector(target)))

    def _reference(self, **fields: Any) -> pb.Interaction:
        return pb.Interaction(id=self.id or 0, object=self.object, kind="grab", **fields)

    def _send(
        self, verb: str, interaction: pb.Interaction, answered: Callable[[pb.Reply | None], None] = lambda reply: None
    ) -> None:
        with contextlib.suppress(ClientError):  # the server is gone, and the grab with it
            self._client.send(verb, interaction, answered)


def push(
    client: Sender, object: str, point: Sequence[float], force: NDArray, radius: float, refused: Callable[[str], None]
) -> None:
    """Pushes an object, without waiting for the answer."""
    wanted = pb.Interaction(
        object=object, kind="push", point=vector(point), force=vector(force), radius=radius, duration=PUSH_SECONDS
    )
    with contextlib.suppress(ClientError):
        client.send("push", wanted, lambda reply: refused(reply.error) if reply is not None and reply.error else None)


def swept(start: Sequence[float], end: Sequence[float], eye: NDArray, size: float) -> list[tuple[float, float, float]]:
    """Returns the corners of what a blade sweeps that is drawn from start to end and held along the line of sight [m].

    eye (3,): of who draws; size: how far it reaches before and behind the line that is drawn
    """
    a, b = np.asarray(start, float), np.asarray(end, float)
    sight = (a + b) / 2 - eye
    reach = sight / (float(np.linalg.norm(sight)) or 1.0) * size
    return [(float(x), float(y), float(z)) for x, y, z in (a - reach, b - reach, b + reach, a + reach)]


def vector(values: Sequence[float] | NDArray) -> pb.Vector:
    x, y, z = (float(value) for value in values)
    return pb.Vector(x=x, y=y, z=z)
