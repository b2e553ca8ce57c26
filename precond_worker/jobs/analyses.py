# SPDX-License-Identifier: MIT
"""Symbolic phases of the objects of one server, each done once."""

from collections.abc import Callable
from typing import NamedTuple
from weakref import WeakValueDictionary

import numpy as np

from precond_worker.arrays import Int32
from precond_worker.factorization.registry import Factorization
from precond_worker.jobs.job import Job
from precond_worker.network.server_connection import ServerConnection
from protocol.messages_pb2 import Topology
from protocol.method import COMPLETE, Method
from protocol.refused import Refused
from protocol.validate import array, topology_checksum

Analyse = Callable[[Int32, Int32, Method], Factorization]  # registry.make_factorization


class CachedAnalysis(NamedTuple):
    """The symbolic phase of an object, for the matrices of one epoch and method. blocks: of each matrix."""

    epoch: int
    method: Method
    blocks: int
    factorization: Factorization

    def is_of(self, method: Method) -> bool:
        """True if it is of this method."""
        return self.method is method or self.method == method  # equal ones are mostly one object (job.accept)


class Analyses:
    """Symbolic phases by object and method. Objects of one topology share that of complete factors."""

    def __init__(self, connection: ServerConnection, analyse: Analyse):
        self._connection, self._analyse = connection, analyse
        self._of_objects: dict[tuple[str, str], CachedAnalysis] = {}  # by object and name of the method
        self._complete: WeakValueDictionary[int, Factorization] = WeakValueDictionary()  # by topology
        self._blocks: dict[int, int] = {}  # of a matrix, likewise
        self._together: int | None = None  # as it was since the last change

    def __bool__(self) -> bool:
        """True if one was done since the last `clear`."""
        return bool(self._of_objects)

    def clear(self) -> None:
        """Forgets all, when their server is gone."""
        self._of_objects.clear()
        self._together = None

    @property
    def together(self) -> int:
        """Number of matrices that take hardly more time than one, if every object has as many as any other: the
        harmonic mean of the numbers of all objects. It changes with the objects, not with the job at hand."""
        if self._together is None:
            each = [getattr(known.factorization, "together", 1) for known in self._of_objects.values()]
            self._together = int(len(each) / sum(1 / count for count in each)) if each else 1
        return self._together

    def changed(self) -> None:
        """Has `together` asked for anew, since a library takes fewer matrices."""
        self._together = None

    def known(self, job: Job) -> CachedAnalysis | None:
        """Returns the symbolic phase of a job, if it is done already."""
        key = job.object, job.method.name
        known = self._of_objects.get(key)
        if known is not None and known.epoch == job.epoch and known.is_of(job.method):
            return known
        alike = self._complete.get(job.topology) if job.method.name == COMPLETE else None
        if alike is None:
            return None
        return self._keep(key, CachedAnalysis(job.epoch, job.method, self._blocks[job.topology], alike))

    def of_job(self, job: Job) -> Factorization:
        """Returns the symbolic phase of a job, done once per epoch of an object. Raises Refused."""
        known = self.known(job)
        if known is None:
            known = self.of_object(job.object, self._connection.topology(job.object, job.epoch), job.method)
        if known.blocks != job.blocks:
            raise Refused(f"Matrix.blocks is {job.blocks}; allowed: {known.blocks}, as in the topology", "shape")
        return known.factorization

    def of_object(self, object: str, topology: Topology, method: Method) -> CachedAnalysis:
        """Does the symbolic phase of an object, unless one like it has had it. Raises Refused."""
        row_start = array(topology.row_start, np.int32, (topology.nodes + 1,), "Topology.row_start")
        columns = array(topology.columns, np.int32, (-1,), "Topology.columns")
        analysis = self._shared(topology_checksum(topology), row_start, columns, method)
        if method.name == COMPLETE:  # by one of several libraries
            self._connection.library = analysis.library
        return self._keep(
            (object, method.name), CachedAnalysis(topology.header.epoch, method, len(columns), analysis)
        )  # fmt: skip

    def _keep(self, key: tuple[str, str], made: CachedAnalysis) -> CachedAnalysis:
        self._of_objects[key] = made
        self._together = None
        return made

    def _shared(self, topology: int, row_start: Int32, columns: Int32, method: Method) -> Factorization:
        """Returns the symbolic phase of a pattern. topology: its checksum"""
        if method.name != COMPLETE:
            return self._analyse(row_start, columns, method)
        known = self._complete.get(topology)
        if known is None:
            known = self._complete[topology] = self._analyse(row_start, columns, method)
            self._blocks = {each: count for each, count in self._blocks.items() if each in self._complete}
            self._blocks[topology] = len(columns)
        return known
