# SPDX-License-Identifier: MIT
"""Conditional nodes of CUDA graphs: work that a captured graph does only if, or as long as, a number on the device is
not 0.

An untaken branch costs as much as half a dozen empty kernels, whatever it holds. CuPy has no interface to it, so the
driver is called.
Source: CUDA driver API, graph management (CUDA 12.4 and above).
"""

import ctypes as c
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from typing import Any, NamedTuple

import numpy as np

from sim_server.backends.compiler import SOURCES
from sim_server.backends.gpu.cupy_types import DeviceArray, KernelFunction, KernelModule
from sim_server.errors import DeviceError

FUNCTIONS = (
    "cuStreamGetCaptureInfo_v2", "cuGraphConditionalHandleCreate", "cuGraphAddNode",
    "cuStreamUpdateCaptureDependencies", "cuStreamBeginCaptureToGraph", "cuStreamEndCapture",
)  # fmt: skip
IF, WHILE = 0, 1  # types of conditional nodes
LINKED = ("-arch=compute_80", "-rdc=true", "-ftz=true")  # options of texts that the driver links; the last as CuPy
CONDITIONAL_NODE, ASSIGN_DEFAULT, SET_DEPENDENCIES, RELAXED = 13, 1, 1, 2  # enumerators of the driver API


class ConditionalNodeParams(c.Structure):
    """CUDA_CONDITIONAL_NODE_PARAMS: type is IF or WHILE; graphs: out, of the branch."""

    _fields_ = [
        ("handle", c.c_uint64), ("type", c.c_int), ("size", c.c_uint), ("graphs", c.POINTER(c.c_void_p)),
        ("context", c.c_void_p),
    ]  # fmt: skip


class GraphNodeParams(c.Structure):
    """CUgraphNodeParams, with the member of its union that is used here."""

    _fields_ = [
        ("type", c.c_int), ("reserved", c.c_int * 3), ("conditional", ConditionalNodeParams),
        ("rest", c.c_char * (29 * 8 - c.sizeof(ConditionalNodeParams))), ("reserved2", c.c_int64),
    ]  # fmt: skip


class Loop(NamedTuple):
    """A loop of a graph, whose kernels tell it to go on by cudaGraphSetConditional(handle, 1).

    It does not begin unless a kernel before it has said so in the same run of the graph. body: begins what it holds
    """

    handle: int
    body: Callable[[], AbstractContextManager[None]]


class Conditions:
    """Branches of the graphs that are captured from streams of one context.

    Raises DeviceError if the driver has no conditional nodes.
    """

    def __init__(self, cp: Any, driver: c.CDLL, context: int):
        self._cp, self._driver, self._context = cp, driver, context
        missing = [name for name in FUNCTIONS if not hasattr(driver, name)]
        if missing:
            raise self._too_old(missing[0])
        text = (SOURCES / "backends/gpu/set_condition.cu").read_text()
        self._module = self.linked(text, "set_condition.cu", ["-std=c++17"])
        self._set_condition: KernelFunction = self._module.get_function("set_condition")

    @staticmethod
    def _too_old(missing: str) -> DeviceError:
        """Returns the error of a driver without a function."""
        return DeviceError(
            "the NVIDIA driver is too old for the schemes ros2 and central_difference and for contact: it has no "
            f"{missing}; CUDA 12.4 or above has it"
        )

    def linked(self, text: str, name: str, options: Sequence[str]) -> KernelModule:
        """Compiles a text to PTX, which the driver links with its own function cudaGraphSetConditional."""
        cp = self._cp
        program = cp.cuda.nvrtc.createProgram(text, name, [], [])
        cp.cuda.nvrtc.compileProgram(program, [*LINKED, *options])
        module: Any = cp.cuda.function.Module()
        try:
            module.load(cp.cuda.nvrtc.getPTX(program))
        except cp.cuda.driver.CUDADriverError as error:
            raise self._too_old(f"cudaGraphSetConditional ({error})") from error
        cp.cuda.nvrtc.destroyProgram(program)
        linked: KernelModule = module
        return linked

    @contextmanager
    def branch(self, flag: DeviceArray, repeats: bool = False) -> Iterator[None]:
        """What is launched inside runs only if `flag` (1,) is not 0 then. Only while the current stream is captured.

        repeats: it runs again and again as long as the flag is not 0 at its end
        """
        handle = self._handle()
        arguments = np.uint64(handle), np.uint64(flag.data.ptr)
        self._set_condition((1,), (1,), arguments)
        with self._inside(handle, WHILE if repeats else IF):
            yield
            if repeats:
                self._set_condition((1,), (1,), arguments)

    def loop(self) -> Loop:
        """Makes a loop of the graph that is captured from the current stream. What its body holds is told when it is
        entered; kernels that tell it may be launched before."""
        handle = self._handle()
        return Loop(handle, lambda: self._inside(handle, WHILE))

    def _handle(self) -> int:
        """Returns a new handle of a condition, which is 0 when the graph that is captured begins to run."""
        graph, _, _ = self._capture()
        handle = c.c_uint64()
        self._call("cuGraphConditionalHandleCreate", c.byref(handle), graph, self._context, 0, ASSIGN_DEFAULT)
        return handle.value

    @contextmanager
    def _inside(self, handle: int, kind: int) -> Iterator[None]:
        """What is launched inside is that of a conditional node of this kind."""
        body = self._add_node(handle, kind)
        stream, ended = self._cp.cuda.Stream(non_blocking=True), c.c_void_p()
        self._call("cuStreamBeginCaptureToGraph", stream.ptr, body, None, None, 0, RELAXED)
        with stream:
            yield
        self._call("cuStreamEndCapture", stream.ptr, c.byref(ended))

    def _add_node(self, handle: int, kind: int) -> c.c_void_p:
        """Appends a conditional node to the current stream; returns the graph of its branch."""
        graph, dependencies, count = self._capture()
        params = GraphNodeParams(type=CONDITIONAL_NODE)
        params.conditional = ConditionalNodeParams(handle=handle, type=kind, size=1, context=self._context)
        node = (c.c_void_p * 1)()
        self._call("cuGraphAddNode", node, graph, dependencies, count, c.byref(params))
        self._call("cuStreamUpdateCaptureDependencies", self._stream(), node, 1, SET_DEPENDENCIES)
        return c.c_void_p(params.conditional.graphs[0])

    def _stream(self) -> int:
        return int(self._cp.cuda.get_current_stream().ptr)

    def _capture(self) -> tuple[c.c_void_p, c.c_void_p, c.c_size_t]:
        """Returns graph, last nodes and their number of the capture of the current stream."""
        status, number, graph, nodes, count = c.c_int(), c.c_uint64(), c.c_void_p(), c.c_void_p(), c.c_size_t()
        found = (c.byref(x) for x in (status, number, graph, nodes, count))
        self._call("cuStreamGetCaptureInfo_v2", self._stream(), *found)
        return graph, nodes, count

    def _call(self, function: str, *arguments: Any) -> None:
        """Calls the driver; integers are handles, counts or flags."""
        given = [c.c_void_p(x) if isinstance(x, int) else x for x in arguments]
        if error := getattr(self._driver, function)(*given):
            raise DeviceError(f"the NVIDIA driver refused {function}: CUDA error {error}")
