# SPDX-License-Identifier: MIT
"""A small object, a factorization of it, a server to drive by hand and processes to drive it with."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from protocol.factor import Factor, FactorPattern
from protocol.messages_pb2 import Header, Topology
from protocol.method import Method
from sim_server.network.link import ServerLink
from sim_server.updates.factor_source import Job

ROOT = Path(__file__).parents[2]
PATIENCE = 60.0  # s until a test gives up: half of what pytest gives it


def chain(nodes: int = 8, object: str = "beam", epoch: int = 1) -> Topology:
    """Block pattern of nodes in a row, each a neighbour of the next."""
    rows = [[j for j in (i - 1, i, i + 1) if 0 <= j < nodes] for i in range(nodes)]
    return Topology(
        header=Header(object=object, epoch=epoch),
        nodes=nodes,
        row_start=np.cumsum([0, *map(len, rows)]).astype(np.int32).tobytes(),
        columns=np.concatenate(rows).astype(np.int32).tobytes(),
    )


def matrix(topology: Topology, shift: float = 0.0) -> NDArray[np.float64]:
    """Values (blocks, 3, 3) of a positive definite matrix, (4 + shift) on the diagonal and -1 beside it."""
    columns = np.frombuffer(topology.columns, np.int32)
    rows = np.repeat(np.arange(topology.nodes), np.diff(np.frombuffer(topology.row_start, np.int32)))
    weight = np.where(rows == columns, 4.0 + shift, -1.0)
    return weight[:, None, None] * np.eye(3)


def dense(topology: Topology, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """The same matrix with all its zeros."""
    row_start, columns = np.frombuffer(topology.row_start, np.int32), np.frombuffer(topology.columns, np.int32)
    full = np.zeros((topology.nodes, 3, topology.nodes, 3))
    for i in range(topology.nodes):
        for k in range(row_start[i], row_start[i + 1]):
            full[i, :, columns[k]] = values[k]
    return full.reshape(3 * topology.nodes, -1)


class DenseAnalysis:
    """Cholesky factors as one dense supernode: quick to import and to check."""

    library = "dense"
    remedy = ""

    def __init__(self, row_start: NDArray[np.int32], columns: NDArray[np.int32], method: Method | None = None):
        nodes = len(row_start) - 1
        n = 3 * nodes
        self._topology = Topology(nodes=nodes, row_start=row_start.tobytes(), columns=columns.tobytes())
        self.pattern = FactorPattern.build(np.arange(n), [0, n], [0, n], np.arange(n))

    def factorize(self, values: Any, dtype: Any) -> NDArray[Any]:
        """L column by column; raises ValueError if there is none."""
        try:
            lower = np.linalg.cholesky(dense(self._topology, values))
        except np.linalg.LinAlgError as error:
            raise ValueError(f"not positive definite: {error}") from error
        n = len(lower)
        return np.concatenate([lower[k:, k] for k in range(n)]).astype(dtype)


def product(factor: Factor) -> NDArray[np.float64]:
    """P' L L' P of a factor, dense: the matrix that it was made from."""
    pattern, n = factor.pattern, factor.pattern.size
    lower = np.zeros((n, n))
    for s in range(len(pattern.super_start) - 1):
        rows = pattern.rows[pattern.row_start[s] : pattern.row_start[s + 1]]
        for k in range(pattern.super_start[s], pattern.super_start[s + 1]):
            below = rows[k - pattern.super_start[s] :]
            start = pattern.diagonal[k]
            lower[below, k] = factor.values[start : start + len(below)]
    back = np.empty(n, np.int64)
    back[pattern.permutation] = np.arange(n)
    return (lower @ lower.T)[np.ix_(back, back)]


class Driver:
    """A ServerLink and what came out of it."""

    def __init__(self, link: ServerLink):
        self.link = link
        self.factors: list[Factor] = []
        self.failures: list[tuple[str, str]] = []

    def turn(self) -> None:
        """What the service thread does again and again."""
        self.factors += self.link.dispatch.poll()
        self.failures += self.link.dispatch.failures()

    def until(self, condition: Callable[[], Any], what: str) -> Any:
        """Turn until the condition holds, and return what it returned."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            self.turn()
            if result := condition():
                return result
            time.sleep(0.002)
        refusals = dict(self.link.counters.refusals)
        raise AssertionError(f"waited {PATIENCE} s for {what}; {refusals}, {self.failures[-3:]}")

    def submit(self, topology: Topology, step: int, shift: float = 0.0, dtype: str = "float32") -> None:
        """Send a matrix of the object as soon as somebody is ready."""
        header = topology.header
        job = Job(header.object, header.epoch, step, True, matrix(topology, shift), dtype)
        self.until(lambda: self.link.dispatch.ready() and self.link.dispatch.submit(job), "a worker that is ready")

    def factor(self, topology: Topology, step: int, shift: float = 0.0, dtype: str = "float32") -> Factor:
        """Submit and wait for the factor."""
        self.submit(topology, step, shift, dtype)
        return self.until(lambda: next((f for f in self.factors if f.step == step), None), f"the factor of step {step}")


@contextlib.contextmanager
def process(*arguments: str, **options: Any) -> Iterator[subprocess.Popen[str]]:
    """A Python process that is gone afterwards, whatever happened."""
    environment = {**os.environ, "PYTHONPATH": f"{ROOT}:{Path(__file__).parent}", "OPENBLAS_NUM_THREADS": "1"}
    child = subprocess.Popen(
        [sys.executable, *arguments],
        cwd=ROOT,
        env=environment,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )
    try:
        yield child
    finally:
        with contextlib.suppress(ProcessLookupError):
            child.send_signal(signal.SIGCONT)
            child.kill()
        child.communicate()


def light_worker(endpoint: str, name: str = "light", *options: str) -> contextlib.AbstractContextManager[Any]:
    """A worker process with dense factors: the real network side, started in a fraction of a second."""
    return process(str(Path(__file__).parent / "light_worker.py"), endpoint, name, *options)


def endpoint_of(client: Any) -> str:
    """Where the server of a Client listens."""
    return str(client._where)
