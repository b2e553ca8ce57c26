# SPDX-License-Identifier: MIT
"""Rooms and matrices of a batch must lie inside their slots, whatever numbers tell of them."""

from types import SimpleNamespace

import pytest

from precond_worker.jobs.batch import accept_batch
from protocol.channels import PROTOCOL, key
from protocol.messages_pb2 import Header, MatrixBatch, Slot
from protocol.refused import Refused

ALL = (1 << 64) - 1


class Payload(bytes):
    def as_shm(self) -> object:
        return self


def accepted(rooms: list[int], blocks: int = 1, capacity: int = 4096):
    jobs, slot = len(rooms), Slot(segment="7.zenoh", offset=64, capacity=capacity, generation=1)
    message = MatrixBatch(
        header=Header(protocol=PROTOCOL, incarnation=7), worker="w", factor_dtype="float32", method="cholesky",
        matrix_slot=slot, factor_slot=slot, objects=[f"o{k}" for k in range(jobs)], epochs=[1] * jobs,
        jobs=range(1, jobs + 1), steps=[1] * jobs, warps=[False] * jobs, blocks=[blocks] * jobs,
        checksums=[0] * jobs, rooms=rooms, leases=[1.0] * jobs, known=[0] * jobs,
    )  # fmt: skip
    data = message.SerializeToString()
    sample = SimpleNamespace(attachment=data, payload=Payload(), key_expr=key("matrices", worker="w"))
    return accept_batch(sample, "w", 7)  # type: ignore[arg-type]


def test_rooms_that_fill_their_slot_are_taken():
    assert accepted([1024, 2048, 1024]).rooms.tolist() == [0, 1024, 3072, 4096]


@pytest.mark.parametrize("capacity", [4096, ALL])
@pytest.mark.parametrize(
    "rooms",
    [
        pytest.param([1 << 62] * 4, id="a sum of 0 in 64 bits"),
        pytest.param([1 << 63, 1 << 63, 64], id="of 64"),
        pytest.param([64, ALL - 63], id="as if one were negative"),
        pytest.param([1 << 63], id="no signed number"),
    ],
)
def test_rooms_beyond_all_memory_are_refused(rooms, capacity):
    with pytest.raises(Refused, match="needed"):
        accepted(rooms, capacity=capacity)


def test_matrices_beyond_their_slot_are_refused():
    with pytest.raises(Refused, match="needed"):
        accepted([64] * 3, blocks=19)
