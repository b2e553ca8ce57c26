# SPDX-License-Identifier: MIT
"""Copies to and from slots of device memory, with arrays of the host in place of those of a device."""

import ctypes
import gc
import threading
import weakref
from types import SimpleNamespace

import numpy as np
import pytest

from precond_worker.factorization.factorize import Analysis
from protocol.refused import Refused
from sim_server.backends.gpu import shared_device_memory as module
from sim_server.backends.gpu.shared_device_memory import SharedDeviceMemory
from sim_server.backends.shared_memory import PlacedMatrix
from tests.worker.block_matrices import bar_edges, pattern, spd

GRAPH = pattern(12, bar_edges(1, 1, 2))


class OutOfMemoryError(Exception):
    pass


@pytest.fixture
def memory() -> SharedDeviceMemory:
    """Copies are made when they are waited for, as by a device; there is room for factors, and for nothing else."""
    made, begun = SharedDeviceMemory.__new__(SharedDeviceMemory), []

    def finish() -> None:
        while begun:
            ctypes.memmove(*begun.pop(0))

    def none_left(array: np.ndarray) -> None:
        raise OutOfMemoryError

    runtime = SimpleNamespace(
        memcpyAsync=lambda to, source, size, *_: begun.append((to, source, size)), memcpyDefault=4
    )
    cuda = SimpleNamespace(memory=SimpleNamespace(OutOfMemoryError=OutOfMemoryError))
    made.gpu = SimpleNamespace(cp=SimpleNamespace(empty=np.empty, asarray=none_left, cuda=cuda))
    made.runtime, made.device = runtime, SimpleNamespace(use=lambda: None)
    made.stream = SimpleNamespace(ptr=0, record=lambda: SimpleNamespace(synchronize=finish))
    made._lock, made.diagonals, made.sums = threading.Lock(), {}, False
    return made


def test_a_device_without_room_for_the_check_has_the_host_check(memory):
    analysis = Analysis(*GRAPH)
    values = analysis.factorize(spd(*GRAPH), np.float32)
    taken = memory.take(values.ctypes.data, analysis.pattern, values.dtype)
    np.testing.assert_array_equal(taken, values)
    assert taken is not values
    values[analysis.pattern.diagonal[3]] = -1.0
    with pytest.raises(Refused, match="not positive"):
        memory.take(values.ctypes.data, analysis.pattern, values.dtype)


def test_what_is_copied_in_order_to_be_contiguous_is_kept_until_it_was_read(memory, monkeypatch):
    made: list[weakref.ref] = []
    contiguous = np.ascontiguousarray

    def noted(values: np.ndarray) -> np.ndarray:
        made.append(weakref.ref(found := contiguous(values)))
        return found

    alive: list[bool] = []
    record = memory.stream.record

    def look() -> SimpleNamespace:
        gc.collect()
        alive.extend(each() is not None for each in made)
        return record()

    memory.stream.record = look
    monkeypatch.setattr(module.np, "ascontiguousarray", noted)
    matrices = [np.arange(72.0).reshape(8, 3, 3)[::2] + k for k in range(2)]
    matrices = [np.repeat(each, 2, axis=0)[::2] for each in matrices]
    place = np.zeros((2, 4, 3, 3))
    memory.put(place.ctypes.data, [PlacedMatrix(each, 0) for each in matrices])
    assert alive == [True, True]
    np.testing.assert_array_equal(place, matrices)
