# SPDX-License-Identifier: MIT
"""The processor as a place for kernels to run: kernel texts compiled for it, and launches of their kernels."""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cache, cached_property, partial
from typing import Any

import numpy as np

from sim_server.backends.base import Engine, EngineInput
from sim_server.backends.build_pool import compilers
from sim_server.backends.compiler import ahead, begin_kernels, build_id, read_text
from sim_server.backends.kernel_binding import arguments_of, domain_of

_SCALARS = {"int": ctypes.c_int32, "double": ctypes.c_double, "float": ctypes.c_float}


@dataclass
class CpuLaunch:
    """One kernel with its arguments: what the native loop calls, `items` times."""

    name: str
    address: Callable[[], int]
    params: ctypes.Structure
    items: int
    arrays: dict[str, np.ndarray]  # kept alive
    mailed: bool = False  # its arguments may be replaced while steps run
    domain: str = ""  # what its items are, as its text says

    @property
    def function(self) -> int:
        """Address of void(const void* params, int begin, int end); waits until its text is compiled."""
        return self.address()

    def fetch(self, name: str) -> np.ndarray:
        """One of its arrays as kernels have left it."""
        return self.arrays[name]

    def __call__(self) -> None:
        """Runs it here and now (tests, set-up); a step runs launches natively."""
        call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_int)(self.function)
        call(ctypes.addressof(self.params), 0, self.items)


class CpuModule:
    """A kernel text of this package, e.g. CpuModule("effects/corotational.cu"); paths: as of read_text.

    Its compiler is started here; who first asks for the address of a kernel waits for it, so that those of a scene are
    compiled side by side.
    """

    def __init__(self, path: str, real: str = "double"):
        self.real = real
        self.name, self._text = read_text(path)
        self._path = begin_kernels(path, self._text, (f"real={real}",))
        self._layouts: dict[str, type[ctypes.Structure]] = {}  # of the kernels bound so far

    @cached_property
    def library(self) -> ctypes.CDLL:
        """The compiled text; raises CompileError with the compiler's output."""
        compilers.finish(self._path)
        return ctypes.CDLL(str(self._path))

    def address(self, kernel: str) -> int:
        """Of a kernel's function."""
        found = ctypes.cast(getattr(self.library, kernel), ctypes.c_void_p).value
        assert found is not None
        return found

    def bind(self, kernel: str, n: int, **arguments: Any) -> CpuLaunch:
        """Argument struct of `kernel` over `n` items; raises TypeError where an argument does not fit the text."""
        fields, struct, form = arguments_of(
            self._text, kernel, self.name, {"real": self.real, "local": self.real}, {"n": n, **arguments}
        )
        if kernel not in self._layouts:
            members = [(a.name, _SCALARS[a.kind] if a.dtype is None else ctypes.c_void_p) for a, _ in fields]
            self._layouts[kernel] = type(kernel, (ctypes.Structure,), {"_fields_": members})
        params = self._layouts[kernel]()
        for a, value in fields:
            setattr(params, a.name, value if a.dtype is None else value.ctypes.data)
        arrays = {a.name: value for a, value in fields if a.dtype is not None}
        address, domain = partial(self.address, kernel), domain_of(self._text, struct)
        return CpuLaunch(f"{self.name}.{kernel}", address, params, n, arrays, form == "MAILED_", domain)


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
    def keep(*hosts: np.ndarray, exact: bool = False) -> None:
        """Arrays that stay for the whole run: nothing to do here."""

    @staticmethod
    def fetch(host: np.ndarray) -> np.ndarray:
        """The array with what kernels have made of it: here they wrote to it themselves."""
        return host
