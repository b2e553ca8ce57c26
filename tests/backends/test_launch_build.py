# SPDX-License-Identifier: MIT
"""A build of inverses is launched by one call: what it copies, in which order, and what it waits for."""

from typing import Any

import numpy as np
import pytest

from protocol.shared_memory.located import addresses
from sim_server.backends.gpu import structs
from sim_server.backends.gpu.device_values import DeviceValues
from sim_server.backends.gpu.mailbox import library
from sim_server.backends.gpu.pinned import PinnedArray, readable
from tests.backends.fake_cuda import FakeDevice

FLOAT32, HEAD = np.dtype(np.float32), np.arange(100, 108, dtype=np.uint8)
GRAPH, DONE, COPIED = 42, 7, 8


class OnDevice(np.ndarray):
    """Memory of a device, as CuPy has it."""

    @property
    def data(self) -> Any:  # type: ignore[override]
        return type("Pointer", (), {"ptr": self.ctypes.data})

    def get(self) -> np.ndarray:
        return np.array(self)


class Launch:
    """Launches a build of values on a GPU made of NumPy."""

    def __init__(self) -> None:
        self.device, self.seen = FakeDevice(), list[np.ndarray]()
        self.staging, self.incoming = np.zeros(4096, np.uint8), np.zeros(4096, np.uint8)
        self.device.graphs[GRAPH] = lambda: self.seen.append(self.incoming.copy())
        self.device.record(COPIED)

    def __call__(self, values: list[Any], done: int | None = DONE) -> int:
        kept, values_are = readable(values, FLOAT32)
        sources = addresses(kept)
        self.kept = kept, sources
        return int(library().wf_launch_build(self.device.functions, structs.BuildLaunch(
            stream=self.device.stream, copied=COPIED, done=done, graph=GRAPH, head=HEAD.ctypes.data,
            head_bytes=len(HEAD), staging=self.staging.ctypes.data, incoming=self.incoming.ctypes.data,
            sources=sources.ctypes.data, count=len(kept), bytes=kept[0].nbytes, values_are=values_are,
        )))  # fmt: skip

    def end(self, event: int = DONE) -> None:
        self.device.event_wait(event)

    @property
    def found(self) -> np.ndarray:
        """What the last build found behind the head."""
        assert np.array_equal(self.seen[-1][: len(HEAD)], HEAD)
        return self.seen[-1][len(HEAD) :].view(np.float32)


def values(kind: str) -> list[Any]:
    block = np.arange(12, dtype=np.float32).reshape(3, 4)
    if kind == "page-locked":
        return list(block.view(PinnedArray))
    if kind == "on the device":
        return [DeviceValues(row.copy().view(OnDevice)) for row in block]
    if kind == "both":
        return [block[0].view(PinnedArray), *(DeviceValues(row.copy().view(OnDevice)) for row in block[1:])]
    return list(block.astype(np.float64) if kind == "float64" else block)


@pytest.mark.parametrize("kind", ["page-locked", "on the device", "both", "float64", "usual"])
def test_the_build_finds_all_values_behind_the_head(kind):
    launch = Launch()
    assert launch(values(kind)) == 0
    launch.end()
    assert launch.found[:12].tolist() == list(range(12))
    assert launch.device.calls.count("to_device") == (2 if kind == "page-locked" else 1), "of the head; of the rows"
    assert launch.device.calls.count("on_device") == (3 if kind == "on the device" else 0)


def test_values_that_lie_one_behind_the_other_are_copied_together():
    launch, memory = Launch(), np.arange(40, dtype=np.float32).view(PinnedArray)
    order = [0, 1, 2, 4, 5, 9, 3]
    assert launch([memory[4 * k : 4 * k + 4] for k in order]) == 0
    launch.end()
    assert launch.found[:28].reshape(7, 4)[:, 0].tolist() == [4 * k for k in order]
    assert launch.device.calls.count("to_device") == 1 + 4


def test_memory_is_written_again_only_once_what_was_in_it_is_copied():
    launch = Launch()
    for number in range(3):
        assert launch([np.full(4, number, np.float32)]) == 0
    launch.end()
    assert [build[len(HEAD) :].view(np.float32)[0] for build in launch.seen] == [0, 1, 2]


def test_who_has_more_to_append_tells_the_end_itself():
    launch = Launch()
    launch.device.begin(DONE)
    assert launch(values("page-locked"), done=None) == 0
    launch.end(COPIED)
    assert not launch.device.is_done(DONE)


@pytest.mark.parametrize("call", ["to_device", "graph_launch"])
def test_an_error_of_the_driver_is_returned(call):
    launch = Launch()
    launch.device.fail = call
    assert launch(values("page-locked")) == 700
    assert launch.seen == []
