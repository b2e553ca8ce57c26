# SPDX-License-Identifier: MIT
"""Copies from and to device memory of a server, which may be gone."""

import ctypes
from types import SimpleNamespace

import numpy as np
import pytest

from precond_worker.gpu.opened_memory import OpenedDeviceMemory
from protocol.refused import Refused


class CUDARuntimeError(RuntimeError):
    pass


@pytest.fixture
def opened() -> OpenedDeviceMemory:
    """Copies within this process; nothing is at addresses below 4096."""

    def copy(to: int, source: int, size: int, kind: int, stream: int) -> None:
        if min(to, source) < 4096:
            raise CUDARuntimeError("cudaErrorInvalidValue: invalid argument")
        ctypes.memmove(to, source, size)

    made = OpenedDeviceMemory.__new__(OpenedDeviceMemory)
    made.runtime = SimpleNamespace(memcpyAsync=copy, memcpyDefault=4, CUDARuntimeError=CUDARuntimeError)
    made.device = SimpleNamespace(use=lambda: None)
    made.stream = SimpleNamespace(ptr=0, synchronize=lambda: None)
    return made


def test_numbers_are_written_and_read(opened):
    place = np.zeros(3)
    opened.write(place.ctypes.data, np.arange(3.0))
    assert opened.read(place.ctypes.data, np.dtype(np.float64), 3).tolist() == [0.0, 1.0, 2.0]


def test_memory_that_is_gone_is_refused_and_ends_nothing(opened):
    with pytest.raises(Refused, match="cudaErrorInvalidValue"):
        opened.read(8, np.dtype(np.float64), 3)
    with pytest.raises(Refused, match="cudaErrorInvalidValue"):
        opened.write(8, np.zeros(3))
