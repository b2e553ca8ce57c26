# SPDX-License-Identifier: MIT
"""Matrices assembled by the worker itself, from positions, by the code of sim_server where that is installed."""

from importlib.util import find_spec
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from protocol.messages_pb2 import Scene, Topology


class Source(Protocol):
    """What an uplink gives: descriptions that the server sends when asked; raises Refused."""

    def topology(self, object: str, epoch: int) -> Topology: ...
    def scene(self) -> Scene: ...


class Builder(Protocol):
    """sim_server.assembly.Assembly."""

    def matrix(self, x: NDArray[np.float64]) -> NDArray[np.float64]: ...


def can_build() -> bool:
    """The code is there; nothing is imported."""
    return find_spec("sim_server") is not None


class Builders:
    """Of each object of one server, made when the first positions of an epoch come."""

    def __init__(self, source: Source):
        self._source = source
        self._known: dict[str, tuple[int, Builder]] = {}

    def of(self, object: str, epoch: int) -> Builder:
        """Raises Refused for an object that cannot be built."""
        known = self._known.get(object)
        if known is None or known[0] != epoch:
            from sim_server.assembly import Assembly  # lazily: only who is sent positions needs the server's code

            built = Assembly(self._source.scene(), self._source.topology(object, epoch))
            known = self._known[object] = (epoch, built)
        return known[1]

    def clear(self) -> None:
        """The server has ended, or another life of it began."""
        self._known.clear()
