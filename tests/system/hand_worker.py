# SPDX-License-Identifier: MIT
"""A worker played by hand: it says and sends exactly what a test wants, right or wrong."""

import time
from typing import Any

import numpy as np
import zenoh
from link_helpers import PATIENCE, DenseAnalysis
from zenoh.handlers import RingChannel

from protocol.channels import PROTOCOL, key
from protocol.messages_pb2 import Factor, Header, Matrix, Topology, WorkerInfo
from protocol.network.session import open_session
from protocol.validate import checksum


class HandWorker:
    """A client session that acts as worker `name` of the server with this incarnation."""

    def __init__(self, endpoint: str, incarnation: int, name: str = "hand", shared_memory: bool = False):
        self.session = open_session("client", connect=[endpoint], shared_memory=shared_memory)
        self.incarnation, self.name, self.sequence = incarnation, name, 0
        self.shared_memory = shared_memory
        self._next: Any = None
        self.matrices = self.session.zenoh.declare_subscriber(key("matrix", worker=name), RingChannel(64))
        self.token = self.session.zenoh.liveliness().declare_token(key("alive_worker", worker=name))

    def header(self, object: str = "", epoch: int = 0) -> Header:
        self.sequence += 1
        return Header(
            protocol=PROTOCOL, incarnation=self.incarnation, object=object, epoch=epoch, sequence=self.sequence
        )

    def hello(self, **changes: Any) -> None:
        """A heartbeat, with fields changed."""
        info = WorkerInfo(
            header=self.header(), worker=self.name, pid=1, host="here", library="hand", shared_memory=self.shared_memory
        )
        _change(info, changes)
        self.put("worker", info.SerializeToString(), worker=self.name)

    def has_job(self) -> bool:
        """One has arrived."""
        if self._next is None:
            self._next = self.matrices.try_recv()
        return self._next is not None

    def receive(self) -> Matrix:
        """The next job."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            if self.has_job():
                sample, self._next = self._next, None
                self.payload = sample.payload
                return Matrix.FromString(bytes(sample.attachment))
            time.sleep(0.002)
        raise AssertionError("no matrix came")

    def put(self, channel: str, payload: Any, attachment: bytes | None = None, **names: str) -> None:
        self.session.zenoh.put(
            key(channel, **names), payload, attachment=attachment, congestion_control=zenoh.CongestionControl.BLOCK
        )

    def right_answer(self, job: Matrix, topology: Topology, shift: float = 0.0) -> tuple[Factor, np.ndarray]:
        """What a good worker would answer; sends the pattern."""
        from link_helpers import matrix

        analysis = DenseAnalysis(np.frombuffer(topology.row_start, np.int32), np.frombuffer(topology.columns, np.int32))
        values = analysis.factorize(matrix(topology, shift), job.factor_dtype)
        pattern = analysis.pattern.message(self.header(job.header.object, job.header.epoch))
        self.put("pattern", pattern.SerializeToString(), worker=self.name, object=job.header.object)
        answer = Factor(
            header=self.header(job.header.object, job.header.epoch),
            step=job.step,
            warp=job.warp,
            pattern=analysis.pattern.id,
            dtype=job.factor_dtype,
            nonzeros=len(values),
            checksum=checksum(values),
            worker=self.name,
            seconds=0.01,
            job=job.header.sequence,
        )
        return answer, values

    def answer(self, answer: Factor, values: np.ndarray | bytes = b"", object: str | None = None) -> None:
        data = values if isinstance(values, bytes) else values.tobytes()
        self.put("factor", data, answer.SerializeToString(), worker=self.name, object=object or answer.header.object)

    def close(self) -> None:
        self.session.close()

    def __enter__(self) -> "HandWorker":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _change(message: Any, changes: dict[str, Any]) -> None:
    for path, value in changes.items():
        *outer, last = path.split("__")
        target = message
        for name in outer:
            target = getattr(target, name)
        setattr(target, last, value)


change = _change
