# SPDX-License-Identifier: MIT
"""The processor as a place for kernels to run: kernel texts compiled for it, and launches of their kernels."""

from __future__ import annotations

import ctypes
from concurrent.futures import Future
from contextlib import AbstractContextManager, nullcontext
from functools import cache, cached_property, partial
from typing import Any

from numpy.typing import NDArray

from sim_server.backends.base import Engine, EngineInput
from sim_server.backends.build_pool import compilers
from sim_server.backends.compiler import ahead, begin_kernels, build_id
from sim_server.backends.kernel_binding import Argument, BoundKernel, KernelText, structure_of


class CpuModule(KernelText):
    """A kernel text, e.g. CpuModule("effects/corotational.cu").

    Its compiler is started here; who first asks for the address of a kernel waits for it, so that those of a scene are
    compiled side by side.
    """

    def __init__(self, path: str, real: str = "double"):
        super().__init__(path, {"real": real, "local": real})
        self._path = begin_kernels(path, self.text, (f"real={real}",))
        self._layouts: dict[str, type[ctypes.Structure]] = {}  # of the structs of kernels bound so far

    @cached_property
    def library(self) -> ctypes.CDLL:
        """The compiled text; raises CompileError with the compiler's output."""
        compilers.finish(self._path)
        return ctypes.CDLL(str(self._path))

    def address(self, kernel: str) -> int:
        """Returns the address of a kernel's function."""
        found = ctypes.cast(getattr(self.library, kernel), ctypes.c_void_p).value
        assert found is not None
        return found

    def layout(self, kernel: str, fields: list[Argument]) -> type[ctypes.Structure]:
        """The argument struct of a kernel as ctypes sees it."""
        if kernel not in self._layouts:
            self._layouts[kernel] = structure_of(fields)
        return self._layouts[kernel]

    def bind(self, kernel: str, n: int, **arguments: Any) -> CpuLaunch:
        """Returns the launch of `kernel` over n items; raises TypeError where an argument does not fit the text."""
        return CpuLaunch(self, kernel, {"n": n, **arguments})


class CpuLaunch(BoundKernel):
    """One kernel with its arguments: what the native loop calls, `items` times.

    arrays: kept alive. module: its text
    """

    def __init__(self, module: CpuModule, kernel: str, given: dict[str, Any]):
        super().__init__(module, kernel, given)
        self.module = module
        self._address = partial(module.address, kernel)
        self.params = module.layout(kernel, self.fields)()
        self.arrays: dict[str, NDArray[Any]] = {}
        for f, value in zip(self.fields, self.values, strict=True):
            setattr(self.params, f.name, value if f.dtype is None else value.ctypes.data)
            if f.dtype is not None:
                self.arrays[f.name] = value

    @property
    def function(self) -> int:
        """Address of void(const void* params, int begin, int end); waits until its text is compiled."""
        return self._address()

    def fetch(self, name: str) -> NDArray[Any]:
        """One of its arrays as kernels have left it."""
        return self.arrays[name]

    def __call__(self) -> None:
        """Runs it here and now (tests, set-up); a step runs launches natively."""
        call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_int)(self.function)
        call(ctypes.addressof(self.params), 0, self.items)


@cache
def module(path: str, real: str = "double") -> CpuModule:
    """The compiled text, once per process."""
    return CpuModule(path, real)


class Cpu:
    """The processor as a place for kernels to run."""

    name = "cpu"

    def __init__(self) -> None:
        ahead("backends/cpu/native/loop.cpp")  # takes longest to compile

    @staticmethod
    def building() -> AbstractContextManager[None]:
        """Around the building of a scene: nothing to translate here."""
        return nullcontext()

    @staticmethod
    def engine(given: EngineInput) -> Engine:
        """Returns the loop over launches of this backend."""
        from sim_server.backends.cpu.engine import CpuEngine

        return CpuEngine(given)

    @staticmethod
    def module(path: str) -> CpuModule:
        """A kernel text, compiled once."""
        return module(path)

    @staticmethod
    def build() -> str:
        """What a run depends on beside its scene: equal ones repeat it bit for bit."""
        return build_id()

    @staticmethod
    def keep(*hosts: NDArray[Any], exact: bool = False) -> None:
        """Arrays that stay for the whole run: nothing to do here."""

    @staticmethod
    def fetch(host: NDArray[Any]) -> NDArray[Any]:
        """The array with what kernels have made of it: here they wrote to it themselves."""
        return host

    @staticmethod
    def begin_fetch(host: NDArray[Any]) -> Future[NDArray[Any]]:
        """The array itself."""
        there: Future[NDArray[Any]] = Future()
        there.set_result(host)
        return there

    @staticmethod
    def push(host: NDArray[Any]) -> None:
        """Gives kernels the array as it is: here they read it itself."""

    @staticmethod
    def view(host: NDArray[Any]) -> NDArray[Any]:
        """The array itself."""
        return host

    @staticmethod
    def settle() -> None:
        """Nothing is under way here."""
