# SPDX-License-Identifier: MIT
"""Matrices that the worker assembles from positions, by the code of sim_server where that is installed."""

from importlib.util import find_spec
from typing import Protocol

from precond_worker.arrays import Float64
from protocol.messages_pb2 import Scene, Topology


class Source(Protocol):
    """Scene and topologies of a server (ServerConnection). Its methods raise Refused."""

    def topology(self, object: str, epoch: int) -> Topology: ...
    def scene(self) -> Scene: ...


class Assembler(Protocol):
    """Assembles the matrices of one object (sim_server.updates.worker_assembly.Assembly)."""

    def matrix(self, x: Float64) -> Float64: ...


def can_assemble() -> bool:
    """True if the code of the server is installed; imports nothing."""
    return find_spec("sim_server") is not None


class Assemblers:
    """An assembler for each object of one server, made for the first positions of an epoch."""

    def __init__(self, source: Source):
        self._source = source
        self._known: dict[str, tuple[int, Assembler]] = {}

    def of(self, object: str, epoch: int) -> Assembler:
        """Returns the assembler of an object. Raises Refused if its matrix cannot be assembled here."""
        known = self._known.get(object)
        if known is None or known[0] != epoch:
            from sim_server.updates.worker_assembly import Assembly  # lazily: only positions need the server's code

            built = Assembly(self._source.scene(), self._source.topology(object, epoch))
            known = self._known[object] = (epoch, built)
        return known[1]

    def clear(self) -> None:
        """Drops all assemblers, when the server has ended or restarted."""
        self._known.clear()
