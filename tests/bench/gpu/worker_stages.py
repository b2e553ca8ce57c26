# SPDX-License-Identifier: MIT
"""Time of a worker for each factor of batches of small beams, by stage, without a network.

A worker's loop gets messages as they come from a server, in slots of shared memory, and its answers are encoded but not
sent. gpu: a worker on a GPU whose factors are there at once, so that what is told is the time of the host. device: the
same on the GPU that is there. cpu: factors by native code, as they are.
"""

import argparse
import json
import logging
import tempfile
import time
from collections import Counter
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest import mock

import numpy as np

from precond_worker.factorization.registry import make_factorization
from precond_worker.network.presence import ServersThere
from precond_worker.network.receive_queue import ReceiveQueue
from precond_worker.symbolic.pivots import PivotCheck
from precond_worker.worker import Worker
from protocol.channels import PROTOCOL, key
from protocol.counters import Counters
from protocol.factor import ROOM_ALIGNMENT, FactorPattern
from protocol.messages_pb2 import Header, MatrixBatch, Topology
from protocol.shared_memory.copies import Copies
from protocol.shared_memory.view import SlotMap
from protocol.validate import checksum, topology_checksum
from sim_server.recording import messages
from sim_server.simulation import Simulation
from tests.bench.gpu.problem import Problem
from tests.support.lent_slot import LentSlot
from tests.support.worker_gpu import FOUND, WorkerGpu, installed

Row = dict[str, Any]
MESSAGES = 4  # that are sent in turn, of different objects


class Device(WorkerGpu):
    """A device whose factors are there at once: copies and launches take no time of the host."""

    def __init__(self) -> None:
        super().__init__(lambda *_: None)
        self.values: np.ndarray | None = None  # of a factor
        self._pinned: dict[int, list[np.ndarray]] = {}

    def copy(self, to: int, source: int, size: int, kind: int, stream: int) -> None: ...

    def pinned(self, size: int) -> np.ndarray:
        """Three arrays of a size in turn, with factors in them, as if the device had written there."""
        known = self._pinned.setdefault(size, [])
        if len(known) < 3:
            made = np.zeros(size, np.uint8)
            if size == 12:
                made.view(np.int32)[:] = FOUND
            elif self.values is not None and size % self.values.nbytes == 0:
                made.view(self.values.dtype).reshape(-1, self.values.size)[:] = self.values
            known.append(made)
        known.append(known.pop(0))
        return known[-1]


class Connection:
    """The network as a worker sees it. Answers are encoded."""

    def __init__(self, topology: Topology):
        self.name, self.server, self.incarnation, self.library = "w", "sim", 7, ""
        self.counters = Counters(logging.getLogger("worker_stages"))
        self.received: ReceiveQueue[Any] = ReceiveQueue(256)
        self.slots, self.together, self.shared_memory, self.device = SlotMap(), 0, False, None
        self.offered = SimpleNamespace(withdraw=lambda objects: None, clear=lambda: None)
        self._topology, self.answered, self.messages = topology, 0, 0

    def has_token(self, incarnation: int) -> bool:
        return True

    def follow(self, incarnation: int) -> None: ...

    def header(self, object: str, epoch: int, channel: str) -> Header:
        return Header(protocol=PROTOCOL, incarnation=7, object=object, epoch=epoch, sequence=1)

    def topology(self, object: str, epoch: int | None = None) -> Topology:
        return self._topology

    def tell(self) -> None: ...

    def send_pattern(self, pattern: Any, object: str, epoch: int) -> None: ...

    def send_factor(self, message: Any, values: bytes = b"") -> None:
        raise AssertionError(f"a factor left alone: {message}")

    def send_factors(self, message: Any) -> None:
        message.SerializeToString()
        self.answered += len(message.jobs)
        if any(message.failures):
            raise AssertionError(f"no factor: {message.failures[0]}")
        self.messages += 1


def spied(stages: Counter[str], name: str, function: Callable[..., Any]) -> Callable[..., Any]:
    """Adds the thread's processor time of each call."""

    def timed(*arguments: Any, **named: Any) -> Any:
        begun = time.thread_time_ns()
        try:
            return function(*arguments, **named)
        finally:
            stages[name] += time.thread_time_ns() - begun

    return timed


def batch(
    topology: Topology, matrices: np.ndarray, pattern: FactorPattern, number: int, segments: tuple[LentSlot, LentSlot]
) -> Any:  # fmt: skip
    """Returns a sample with as many matrices as there are, (k, blocks, 3, 3), in a slot."""
    count, blocks = matrices.shape[:2]
    room = -(-4 * pattern.nonzeros // ROOM_ALIGNMENT) * ROOM_ALIGNMENT
    segments[0].data[: matrices.nbytes] = matrices.reshape(-1).view(np.uint8)
    objects = [f"beam{number}_{k}" for k in range(count)]
    message = MatrixBatch(
        header=Header(protocol=PROTOCOL, incarnation=7, sequence=number), worker="w", factor_dtype="float32",
        method="cholesky", matrix_slot=segments[0].message, factor_slot=segments[1].message, objects=objects,
        epochs=[1] * count, jobs=[1000 * number + k for k in range(count)], steps=[5] * count, warps=[True] * count,
        blocks=[blocks] * count, checksums=[checksum(each) for each in matrices], rooms=[room] * count,
        leases=[1.0] * count, known=[1] * count, known_patterns=[pattern.id] * count,
        topologies=[topology_checksum(topology)] * count,
    )  # fmt: skip
    payload = mock.MagicMock()
    payload.as_shm = lambda: b""
    return SimpleNamespace(
        attachment=message.SerializeToString(), payload=payload, key_expr=key("matrices", worker="w")
    )


def beams(tets: int, count: int) -> tuple[Topology, np.ndarray]:
    """Returns the topology of a beam and matrices of some that differ, (count, blocks, 3, 3)."""
    with tempfile.TemporaryDirectory() as folder:
        sim = Simulation.load(Problem(tets).write(Path(folder)))
    sim.engine.run(1)
    matrix = np.array(sim.system.values).reshape(-1, 3, 3)
    scale = np.linspace(1, 1.5, count)[:, None, None, None]
    return messages.topology(sim, sim.world.bodies[0]), np.ascontiguousarray(matrix * scale)


def prepared(device: str, tets: int, count: int, closing: ExitStack) -> tuple[Worker, Connection, Any, list[Any]]:
    """Returns a worker, its connection, its factorization and messages of `count` jobs in turn."""
    topology, matrices = beams(tets, count)
    gpu = Device()
    if device == "gpu":
        closing.enter_context(installed(gpu))
    start, columns = (np.frombuffer(each, np.int32) for each in (topology.row_start, topology.columns))
    made: Any = make_factorization(start, columns, library="auto" if device == "cpu" else "gpu")
    gpu.values = np.full(made.pattern.nonzeros, 1e6, np.float32)
    room = -(-4 * made.pattern.nonzeros // ROOM_ALIGNMENT) * ROOM_ALIGNMENT
    samples = []
    for number in range(MESSAGES):
        pair = closing.enter_context(LentSlot(matrices.nbytes)), closing.enter_context(LentSlot(count * room))
        samples.append(batch(topology, matrices, made.pattern, number, pair))
    connection = Connection(topology)
    worker = Worker(connection, lambda *_: made)  # type: ignore[arg-type]
    connection.received.put(ServersThere((7,)))
    for sample in 2 * samples:
        connection.received.put(sample)
        worker.step(0.0)
    return worker, connection, made, samples


def measure(device: str, tets: int, count: int, rounds: int) -> Row:
    """Measures messages of `count` jobs, of which the next one comes while the last one is at work; us of the worker's
    thread a factor."""
    stages: Counter[str] = Counter()
    with ExitStack() as closing:
        worker, connection, made, samples = prepared(device, tets, count, closing)
        while worker.waiting:
            worker.step(0.0)
        spies(closing, stages, worker, connection, made)
        answered, messages, begun = connection.answered, connection.messages, time.thread_time_ns()
        wall = time.perf_counter()
        for k in range(rounds):
            connection.received.put(samples[k % MESSAGES])
            worker.step(0.0)
            while worker.waiting > count:
                worker.step(0.0)
        while worker.waiting:
            worker.step(0.0)
        total, lasted = time.thread_time_ns() - begun, time.perf_counter() - wall
        answered, messages = connection.answered - answered, connection.messages - messages
    assert answered == rounds * count and connection.counters.refused == 0, connection.counters.copy()
    return {
        "worker": device, "tets": tets, "batch": count, "KB of L": 4 * made.pattern.nonzeros / 1e3, "answers": messages,
        "factors/s": answered / lasted, "us/factor": total / answered / 1e3,
        **{f"us {name}": round(nanoseconds / answered / 1e3, 2) for name, nanoseconds in stages.items()},
    }  # fmt: skip


def spies(closing: ExitStack, stages: Counter[str], worker: Worker, connection: Connection, made: Any) -> None:
    """Has the stages timed: begin and end of a factorization take in sums, copies in and the check of pivots."""
    for holder, name, stage in (
        (worker, "take_in", "take in"), (made, "begin_many", "begin"), (made, "factorize", "factorize"),
        (Copies, "sum_parts", "sums"), (Copies, "copy", "copies"),
        (Copies, "copy_parts", "copies"), (PivotCheck, "scales", "pivots"), (PivotCheck, "sound", "pivots"),
        (connection, "send_factors", "encode"),
    ):  # fmt: skip
        closing.enter_context(mock.patch.object(holder, name, spied(stages, stage, getattr(holder, name))))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("worker", choices=("gpu", "device", "cpu"))
    parser.add_argument("--tets", type=int, default=540)
    parser.add_argument("--batch", type=int, nargs="+", default=[20, 64])
    parser.add_argument("--rounds", type=int, default=40)
    o = parser.parse_args()
    for count in o.batch:
        print(json.dumps(measure(o.worker, o.tets, count, o.rounds)), flush=True)


if __name__ == "__main__":
    main()
