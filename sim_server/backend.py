# SPDX-License-Identifier: MIT
"""Compiles the kernel texts for the CPU and binds their arguments.

One `.cu` text serves both compilers (kernels/kernel.h). Here the system C++ compiler builds it into a shared library
that ctypes loads, cached by source, headers, flags, compiler and processor. A kernel's argument struct is read from the
text itself, so its layout stands in one place; `Module.bind` fills it from arrays by name and checks them.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import re
import shutil
import subprocess
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
INCLUDE = HERE / "kernels"
# No -ffast-math: it deletes NaN checks. Contraction to FMA is the compiler's default on both sides.
FLAGS = [
    "-O3",
    "-march=native",
    "-std=c++17",
    "-shared",
    "-fPIC",
    "-fopenmp",
    "-fno-math-errno",
    "-fno-trapping-math",
    "-Wall",
]

compiled: list[str] = []  # names of the texts this process uses, in order: what a scene costs can be tested


class CompileError(RuntimeError):
    """The C++ compiler is missing or refused a text; the message holds its output."""


@cache
def compiler() -> str:
    """Path of the C++ compiler: $CXX, g++ or clang++. Raises CompileError if there is none."""
    for name in filter(None, (os.environ.get("CXX"), "g++", "clang++")):
        if path := shutil.which(name):
            return path
    raise CompileError("no C++ compiler found (looked for $CXX, g++, clang++); on Debian: apt-get install g++")


@cache
def _machine() -> str:
    """What -march=native depends on: compiler version and processor flags."""
    version = subprocess.run([compiler(), "--version"], capture_output=True, text=True, check=True).stdout
    try:
        flags = next(
            line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith(("flags", "Features"))
        )
    except (OSError, StopIteration):
        flags = platform.processor()
    return version + flags


def cache_folder() -> Path:
    """$WARPFACTOR_CACHE, else $XDG_CACHE_HOME/warpfactor, else ~/.cache/warpfactor."""
    if folder := os.environ.get("WARPFACTOR_CACHE"):
        return Path(folder)
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "warpfactor"


def build(source: Path, defines: tuple[str, ...] = ()) -> Path:
    """Shared library of one text; compiles only what the cache lacks.

    Raises CompileError with the compiler's output.
    """
    headers = sorted(p for folder in {INCLUDE, source.parent} for p in folder.iterdir() if p.suffix in (".h", ".cuh"))
    flags = [*FLAGS, *(f"-D{d}" for d in defines)]
    digest = hashlib.sha256(
        "\0".join([_machine(), *flags, *(p.name + p.read_text() for p in [source, *headers])]).encode()
    )
    library = cache_folder() / f"{source.stem}-{digest.hexdigest()[:24]}.so"
    if not library.exists():
        library.parent.mkdir(parents=True, exist_ok=True)
        scratch = library.with_suffix(f".{os.getpid()}.tmp")  # another process may build the same
        command = [compiler(), *flags, "-x", "c++", f"-I{INCLUDE}", str(source), "-o", str(scratch)]
        result = subprocess.run(command, capture_output=True, text=True)
        if result.returncode:
            raise CompileError(f"{source.name} did not compile:\n{' '.join(command)}\n{result.stderr}")
        os.replace(scratch, library)
    compiled.append(source.name)
    return library


_SCALARS = {"int": ctypes.c_int32, "double": ctypes.c_double, "float": ctypes.c_float}


def _fields(text: str, struct: str, real: str) -> list[tuple[str, Any, np.dtype | None]]:
    """(name, ctypes type, dtype of the array or None) of each member of a C struct, read from its text."""
    body = re.search(rf"struct {struct} \{{(.*?)\n\}};", text, re.DOTALL)
    if body is None:
        raise CompileError(f"no struct {struct} in the kernel text")
    fields: list[tuple[str, Any, np.dtype | None]] = []
    for line in body.group(1).splitlines():
        member = re.fullmatch(r"\s*(?:const )?(\w+)(\*?) (\w+);.*", line)
        if member is None:
            if line.split("//")[0].strip():
                raise CompileError(f"struct {struct}: cannot read the member {line.strip()!r}")
            continue
        kind, star, name = member.groups()
        kind = real if kind == "real" else kind
        if star:
            fields.append((name, ctypes.c_void_p, np.dtype({"int": "i4", "double": "f8", "float": "f4"}[kind])))
        else:
            fields.append((name, _SCALARS[kind], None))
    return fields


@dataclass
class Launch:
    """One kernel with its arguments: what the native loop calls, `items` times."""

    name: str
    function: int  # address of void(const void* params, int begin, int end)
    params: ctypes.Structure
    items: int
    arrays: dict[str, np.ndarray]  # kept alive

    def __call__(self) -> None:
        """Runs it here and now (tests, set-up); a step runs launches natively."""
        call = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_int)(self.function)
        call(ctypes.addressof(self.params), 0, self.items)


class Module:
    """A compiled kernel text of this package, e.g. Module("effects/corotational.cu")."""

    def __init__(self, path: str, real: str = "double"):
        source = HERE / path
        self.name, self.real = source.stem, real
        self._text = source.read_text()
        self._library = ctypes.CDLL(str(build(source, (f"real={real}",))))

    def bind(self, kernel: str, n: int, **arguments: Any) -> Launch:
        """Argument struct of `kernel` over `n` items; raises TypeError where an argument does not fit the text."""
        found = re.search(rf"KERNEL\({kernel}, (\w+)\)", self._text)
        if found is None:
            raise CompileError(f"no kernel {kernel} in {self.name}.cu")
        fields = _fields(self._text, found.group(1), self.real)
        arguments = {"n": n, **arguments}
        if set(arguments) != {name for name, _, _ in fields}:
            raise TypeError(f"{self.name}.{kernel} takes {[f[0] for f in fields]}, not {sorted(arguments)}")
        layout = type(found.group(1), (ctypes.Structure,), {"_fields_": [(name, kind) for name, kind, _ in fields]})
        params, arrays = layout(), {}
        for name, _, dtype in fields:
            value = arguments[name]
            if dtype is not None:
                if not isinstance(value, np.ndarray) or value.dtype != dtype or not value.flags.c_contiguous:
                    raise TypeError(f"{self.name}.{kernel}: {name} must be a contiguous array of {dtype}")
                arrays[name] = value
                value = value.ctypes.data
            setattr(params, name, value)
        function = ctypes.cast(getattr(self._library, kernel), ctypes.c_void_p).value
        assert function is not None
        return Launch(f"{self.name}.{kernel}", function, params, n, arrays)


@cache
def module(path: str, real: str = "double") -> Module:
    """The compiled text, once per process."""
    return Module(path, real)


def native(path: str, signatures: dict[str, tuple[Any, list[Any]]]) -> ctypes.CDLL:
    """A host-only C++ text of this package with its functions' types declared."""
    library = ctypes.CDLL(str(build(HERE / path)))
    for name, (result, arguments) in signatures.items():
        function: Callable[..., Any] = getattr(library, name)
        function.restype, function.argtypes = result, arguments  # type: ignore[attr-defined]
    return library
