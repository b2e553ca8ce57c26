# SPDX-License-Identifier: MIT
"""A GPU made of NumPy for the native GPU loop: work is put off as a real one does it, so that order mistakes show."""

import ctypes as c
import subprocess
import tempfile
from collections import deque
from collections.abc import Callable
from functools import cache, partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.compiler import INCLUDE, SOURCES, compiler
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu import structs
from sim_server.backends.gpu.loop import CAPACITY, GRAPH_STEPS, DeviceLoop
from sim_server.backends.gpu.solver import PCG_RESULT
from sim_server.backends.gpu.structs import ENERGY_RECORD, RECORDS, STEP_RECORDS, STEP_TIMESTAMP

NOT_READY = 600
p, size, u64 = c.c_void_p, c.c_size_t, c.c_uint64
SIGNATURES = {
    "context_set": [p], "graph_launch": [p, p], "to_device": [u64, p, size, p], "to_host": [p, u64, size, p],
    "on_device": [u64, u64, size, p], "event_record": [p, p], "event_query": [p], "event_wait": [p],
    "stream_wait": [p, p, c.c_uint32],
}  # fmt: skip
Work = Callable[[], None]

ELASTIC_GRAPH, BALANCE_GRAPH, RECORD_GRAPHS = 11, 12, (15, 16)  # handles of graphs
COPY_GRAPHS = (17, 18, 19)  # of mail of both batches, and of matrices
STEPS = dict(zip(range(5, 11), GRAPH_STEPS * 2, strict=True))  # of the graphs that step
TIMED = (8, 9, 10)  # those that note the time first


class FakeDevice:
    """loop.LoopDevice. Nothing is done before somebody waits for it or asks often enough.

    calls: names of the functions in the order of the calls. fail: a function that answers with an error. pieces: of
    work that are done when somebody asks.
    """

    context, stream, copies = 1, 2, 3

    def __init__(self) -> None:
        self.calls: list[str] = []
        self.fail, self.pieces = "", 4
        self.graphs: dict[int, Work] = {}
        self._queues: dict[int, deque[tuple[str, int | Work]]] = {self.stream: deque(), self.copies: deque()}
        self._recorded: dict[int, int] = {}  # by event: records asked for, of which so many are
        self._done: dict[int, int] = {}
        self._events, self._kept = 100, []
        self._functions: dict[str, object] = {}
        self.functions = structs.CudaDriver()
        for name in SIGNATURES:
            self.set(name, getattr(self, name))

    def set(self, name: str, function: Callable[..., int]) -> None:
        """Another function of the driver in place of what stands here."""
        self._functions[name] = made = c.CFUNCTYPE(c.c_int32, *SIGNATURES[name])(function)
        setattr(self.functions, name, c.cast(made, p).value)

    def pinned(self, size: int) -> NDArray[np.uint8]:
        return np.zeros(size, np.uint8)

    def memory(self, size: int) -> int:
        self._kept.append(np.zeros(size, np.uint8))
        return int(self._kept[-1].ctypes.data)

    def event(self) -> int:
        self._events += 1
        return self._events

    def error(self, code: int) -> str:
        return f"fake error {code}"

    def _put(self, name: str, stream: int, work: Work) -> int:
        self.calls.append(name)
        if name == self.fail:
            return 700
        self._queues[stream].append(("work", work))
        return 0

    def context_set(self, context: int) -> int:
        assert context == self.context
        return 0

    def graph_launch(self, graph: int, stream: int) -> int:
        return self._put("graph_launch", stream, self.graphs[graph])

    def to_device(self, to: int, source: int, count: int, stream: int) -> int:
        return self._put("to_device", stream, lambda: c.memmove(to, source, count))  # type: ignore[arg-type,return-value]

    def to_host(self, to: int, source: int, count: int, stream: int) -> int:
        return self._put("to_host", stream, lambda: c.memmove(to, source, count))  # type: ignore[arg-type,return-value]

    def on_device(self, to: int, source: int, count: int, stream: int) -> int:
        return self._put("on_device", stream, lambda: c.memmove(to, source, count))  # type: ignore[arg-type,return-value]

    def event_record(self, event: int, stream: int) -> int:
        self._recorded[event] = self._recorded.get(event, 0) + 1
        count = self._recorded[event]
        return self._put("event_record", stream, lambda: self._done.__setitem__(event, count))

    def stream_wait(self, stream: int, event: int, flags: int) -> int:
        self.calls.append("stream_wait")
        self._queues[stream].append(("wait", event))
        return 0

    def is_done(self, event: int) -> bool:
        """Everything before its last record has been done."""
        return self._done.get(event, 0) >= self._recorded.get(event, 1 << 30)

    def begin(self, event: int) -> None:
        """As if the work before an event were under way on a stream of somebody else."""
        self._recorded[event] = 1

    def record(self, event: int) -> None:
        """As if a stream of somebody else had come so far."""
        self._recorded[event] = self._done[event] = 1

    def event_query(self, event: int) -> int:
        self.calls.append("event_query")
        if self.fail == "event_query":
            return 700
        for _ in range(self.pieces):
            if not self.is_done(event):
                self._one(self.stream) or self._one(self.copies)
        return 0 if self.is_done(event) else NOT_READY

    def event_wait(self, event: int) -> int:
        self.calls.append("event_wait")
        if self.fail == "event_wait":
            return 700
        while not self.is_done(event):
            assert self._one(self.stream) or self._one(self.copies), "nothing would ever end this wait"
        return 0

    def finish_copies(self) -> None:
        """Makes the copies to the host that wait for no step, beside the steps."""
        while self._one(self.copies):
            pass

    def _one(self, stream: int) -> bool:
        """Does one piece of work of a stream, if it may."""
        queue = self._queues[stream]
        while queue:
            kind, what = queue[0]
            if kind == "wait" and not self.is_done(what):  # type: ignore[arg-type]
                return False
            queue.popleft()
            if kind == "work":
                what()  # type: ignore[operator]
                return True
        return False


@cache
def on_threads(declarations: Declarations, call: str, struct: str) -> c.CDLL:
    """A kernel's text, run by threads of the processor: run(blocks, a). call: of the kernel. struct: of a"""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        text = f"""#include "cuda_threads.h"
            {declarations.checked()}
            extern "C" void run(int blocks, const {struct}* a) {{
                launch(blocks, THREADS, [&] {{ {call}; }});
            }}
            """
        (folder / "kernel.cpp").write_text(text)
        paths = [f"-I{p}" for p in (Path(__file__).parent, SOURCES / "backends/gpu", INCLUDE)]
        command = [compiler(), "-std=c++17", "-O1", "-shared", "-fPIC", "-pthread", *paths]
        subprocess.run([*command, str(folder / "kernel.cpp"), "-o", str(folder / "kernel.so")], check=True)
        return c.CDLL(str(folder / "kernel.so"))


def write_records(results: NDArray, energies: NDArray, loop: structs.GpuLoop, target: int, blocks: int = 2) -> None:
    """Writes the records that a target says into the ring of a loop. results, energies: (capacity, bodies)"""
    params = np.zeros((), STEP_RECORDS)
    params["target"], params["results"], params["energies"] = target, results.ctypes.data, energies.ctypes.data
    params["records"], params["room"] = loop.records, loop.record_capacity
    params["capacity"], params["bodies"] = results.shape
    on_threads(RECORDS, "write_records(*a)", "StepRecords").run(blocks, c.c_void_p(params.ctypes.data))


def make_copies(launch: structs.CopyLaunch) -> None:
    """Makes the copies of a list on the device."""
    count, first = (c.c_int64 * 2).from_address(launch.target)
    for copy in (structs.DeviceCopy * count).from_address(launch.target + first):
        c.memmove(copy.target, copy.source, copy.bytes)


class FakeScene:
    """A loop over `bodies` bodies of two nodes with one block of A a node. Step k (from 0) leaves x = k + 1, v = -k,
    A = k; the settings of a body (one int64) come back as its iterations, its factor (one int64) as its factor_step.
    Its kinetic energy is k, its elastic one where it is evaluated 1001 + k."""

    def __init__(self, bodies: int = 1, records: int = 8192, real: str = "f8"):
        nodes = 2 * bodies
        self.device = device = FakeDevice()
        self.x, self.v, self.values = (np.zeros((nodes, *rest), real) for rest in ((3,), (3,), (3, 3)))
        self.settings, self.factor = np.zeros(bodies, np.int64), np.zeros(bodies, np.int64)
        self.argument = np.zeros(1, np.int64)
        self.results, self.stamps = np.zeros((CAPACITY, bodies), PCG_RESULT), np.zeros(CAPACITY, STEP_TIMESTAMP)
        self.energies, self.phase = np.zeros((CAPACITY, bodies), ENERGY_RECORD), 0
        self.found, self.lasts = 0, 10  # ns of the first step; step k (from 0) lasts k + 1 times as long
        self.clock, self.time, self.done = np.zeros(1), 0, 0
        self.seen: list[int] = []  # the argument in each step
        boxes = [(a.ctypes.data + 8 * k, 8) for a in (self.settings, self.factor) for k in range(bodies)]
        addresses = {n: getattr(self, n).ctypes.data for n in ("x", "v", "values")}
        self.loop = DeviceLoop(
            device, [(2 * k, 2 * k + 2) for k in range(bodies)], np.arange(nodes + 1, dtype=np.int32), 0.5,
            [*boxes, (self.argument.ctypes.data, 8)], self.stamps, self.clock, records, real, **addresses,
        )  # fmt: skip
        device.graphs = {graph: partial(self._steps, steps, graph in TIMED) for graph, steps in STEPS.items()}
        device.graphs[ELASTIC_GRAPH] = self._elastic
        device.graphs[BALANCE_GRAPH] = lambda: None  # steps tell their energies themselves
        for graph, target in zip(RECORD_GRAPHS, self.loop.targets, strict=True):
            device.graphs[graph] = partial(write_records, self.results, self.energies, self.loop.loop, target)
        for graph, launch in zip(COPY_GRAPHS, self.loop.copy_launches, strict=True):
            device.graphs[graph] = partial(make_copies, launch)
        self.loop.use_graphs(list(STEPS), RECORD_GRAPHS, COPY_GRAPHS, BALANCE_GRAPH, ELASTIC_GRAPH)

    def _steps(self, steps: int, stamp: bool = False) -> None:
        if stamp:
            self._stamp()
        for _ in range(steps):
            self.make_step()

    def _elastic(self) -> None:
        self.energies[(self.done - 1) % CAPACITY]["elastic"] = 1000 + self.done

    def _stamp(self) -> None:
        self.time += 1_000_000  # the device had nothing to do for a while
        self.stamps[self.done % CAPACITY]["begin"] = self.time

    def make_step(self) -> None:
        k, slot = self.done, self.done % CAPACITY
        self.seen.append(int(self.argument[0]))
        self.values[:] = k
        row = self.results[slot]
        row["iterations"], row["factor_step"] = self.settings, self.factor
        row["residual"], row["seconds"], row["bad_node"] = 1e-7 * k, 1e-6, -1
        told = self.energies[slot]
        told["kinetic"], told["elastic"], told["work"], told["phase"] = k, np.nan, -k, self.phase
        told["found"] = self.found
        self.x[:], self.v[:] = k + 1, -k
        self.time += self.lasts * (k + 1)
        self.stamps[slot]["end"] = self.time
        self.stamps[(slot + 1) % CAPACITY]["begin"] = self.time
        self.done += 1


def number(value: int) -> bytes:
    """As a mailbox of FakeScene takes it."""
    return np.int64(value).tobytes()
