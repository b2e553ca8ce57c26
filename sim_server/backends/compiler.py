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
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from sim_server.backends.build_pool import CompileError, Job, compilers

HERE = Path(__file__).parents[1]  # sim_server/
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
libraries: set[str] = set()  # what they were compiled to, named by source, headers, flags, compiler and processor


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


def _make(folder: Path) -> None:
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise CompileError(
            f"compiled kernels cannot be kept in {folder}: {error.strerror}; WARPFACTOR_CACHE may name another folder"
        ) from error


def read_text(path: str) -> tuple[str, str]:
    """Name and text of a kernel text of this package.

    "a.cu+b.cuh" is the text a.cu with b.cuh in place of its line `#include LAW`, and its name is b.
    """
    frame, _, law = path.partition("+")
    text = (HERE / frame).read_text()
    if not law:
        return Path(frame).stem, text
    return Path(law).stem, text.replace("#include LAW\n", (HERE / law).read_text())


def begin(source: Path, defines: tuple[str, ...] = (), text: str | None = None) -> Path:
    """The shared library of one text, which exists after `compilers.finish`; compiles only what the cache lacks.

    text: where the file does not hold it. Raises CompileError without a compiler or a folder for the library.
    """
    folders = [f for f in {INCLUDE, source.parent, HERE / "backends/cpu/native"} if f.is_dir()]
    headers = sorted(p for folder in folders for p in folder.iterdir() if p.suffix in (".h", ".cuh"))
    flags = [*FLAGS, *(f"-D{d}" for d in defines)]
    digest = hashlib.sha256(
        "\0".join([_machine(), *flags, text or source.read_text(), *(p.name + p.read_text() for p in headers)]).encode()
    )
    library = cache_folder() / f"{source.stem}-{digest.hexdigest()[:24]}.so"
    if not library.exists():
        _make(library.parent)
        file = str(source) if text is None else "-"
        command = [compiler(), *flags, "-x", "c++", f"-I{INCLUDE}", file]
        compilers.begin(Job(source.name, library, command, text))
    return library


def used(source: Path, library: Path, stepping: bool = True) -> None:
    """Notes that this process uses a library. stepping: what a step computes comes out of it."""
    compiled.append(source.name)
    if stepping:
        libraries.add(library.name)


def build(source: Path, stepping: bool = True) -> Path:
    """The shared library of a text, made. Raises CompileError with the compiler's output."""
    library = begin(source)
    compilers.finish(library)
    used(source, library, stepping)
    return library


def ahead(*paths: str) -> None:
    """Begins to compile host-only texts of this package that will be asked for soon."""
    for path in paths:
        begin(HERE / path)


_SCALARS = {"int": ctypes.c_int32, "double": ctypes.c_double, "float": ctypes.c_float}


_TYPES = {"int": "i4", "double": "f8", "float": "f4"}


@dataclass(frozen=True)
class Argument:
    """A member of a kernel's argument struct. dtype: of the array that a pointer points to, None for a number.

    own: only the items of the kernel's domain touch it, each its row. constant: the kernel only reads it.
    """

    name: str
    kind: str  # int, float or double
    dtype: np.dtype | None
    own: bool = False
    constant: bool = False


def _members(text: str, struct: str, types: dict[str, str]) -> list[Argument]:
    body = re.search(rf"struct {struct} \{{(.*?)\n\}};", text, re.DOTALL)
    if body is None:
        raise CompileError(f"no struct {struct} in the kernel text")
    members: list[Argument] = []
    for line in body.group(1).splitlines():
        member = re.fullmatch(r"\s*(const )?(?:own<(\w+)>|(\w+)(\*?)) (\w+);.*", line)
        if member is None:
            if line.split("//")[0].strip():
                raise CompileError(f"struct {struct}: cannot read the member {line.strip()!r}")
            continue
        constant, own, kind, star, name = member.groups()
        kind = types.get(own or kind, own or kind)
        dtype = np.dtype(_TYPES[kind]) if star or own else None
        members.append(Argument(name, kind, dtype, bool(own), bool(constant)))
    return members


def arguments_of(
    text: str, kernel: str, module: str, types: dict[str, str], given: dict[str, Any], converts: bool = False
) -> tuple[list[tuple[Argument, Any]], str, str]:
    """The members of a kernel's struct in order, each with its argument; the struct's name; "", "MAILED_" or "SUM_".

    types: what `real` and `local` stand for. converts: an array of float64 may stand for one of float32.
    Raises CompileError for an unknown kernel, TypeError where an argument does not fit the text.
    """
    members, struct, form = _signature(text, kernel, module, tuple(types.items()))
    if set(given) != {m.name for m in members}:
        raise TypeError(f"{module}.{kernel} takes {[m.name for m in members]}, not {sorted(given)}")
    for m in members:
        value = given[m.name]
        if m.dtype is None:
            continue
        fits = [m.dtype, np.dtype("f8")] if converts and m.dtype.kind == "f" else [m.dtype]
        if not (isinstance(value, np.ndarray) and value.dtype in fits and value.flags.c_contiguous):
            raise TypeError(f"{module}.{kernel}: {m.name} must be a contiguous array of {m.dtype}")
    return [(m, given[m.name]) for m in members], struct, form


@cache
def _signature(
    text: str, kernel: str, module: str, types: tuple[tuple[str, str], ...]
) -> tuple[list[Argument], str, str]:
    """Once for each kernel: touch.apply is bound anew whenever clients move what they hold."""
    found = re.search(rf"^(MAILED_|SUM_)?KERNEL\({kernel}, (\w+)[,)]", text, re.MULTILINE)
    if found is None:
        raise CompileError(f"no kernel {kernel} in {module}.cu")
    return _members(text, found.group(2), dict(types)), found.group(2), found.group(1) or ""


@cache
def domain_of(text: str, struct: str) -> str:
    """What the items of a kernel are: the first word behind `int n;` in its struct."""
    found = re.search(rf"struct {struct} \{{\s*int n;\s*// (\w+)", text)
    return found.group(1) if found else ""


@dataclass
class Launch:
    """One kernel with its arguments: what the native loop calls, `items` times."""

    name: str
    address: Callable[[], int]
    params: ctypes.Structure
    items: int
    arrays: dict[str, np.ndarray]  # kept alive
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


class Module:
    """A kernel text of this package, e.g. Module("effects/corotational.cu"); paths: as of read_text.

    Its compiler is started here; who first asks for the address of a kernel waits for it, so that those of a scene are
    compiled side by side.
    """

    def __init__(self, path: str, real: str = "double"):
        self.real = real
        self.name, self._text = read_text(path)
        source = HERE / path.rpartition("+")[2]
        composed = self._text if "+" in path else None
        self._path = begin(source, (f"real={real}",), composed)
        used(source, self._path)
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

    def bind(self, kernel: str, n: int, **arguments: Any) -> Launch:
        """Argument struct of `kernel` over `n` items; raises TypeError where an argument does not fit the text."""
        fields, struct, _ = arguments_of(
            self._text, kernel, self.name, {"real": self.real, "local": self.real}, {"n": n, **arguments}
        )
        if kernel not in self._layouts:
            members = [(a.name, _SCALARS[a.kind] if a.dtype is None else ctypes.c_void_p) for a, _ in fields]
            self._layouts[kernel] = type(kernel, (ctypes.Structure,), {"_fields_": members})
        params = self._layouts[kernel]()
        for a, value in fields:
            setattr(params, a.name, value if a.dtype is None else value.ctypes.data)
        arrays = {a.name: value for a, value in fields if a.dtype is not None}
        address = partial(self.address, kernel)
        return Launch(f"{self.name}.{kernel}", address, params, n, arrays, domain_of(self._text, struct))


def build_id() -> str:
    """Digest of the compiled code in use: equal ones repeat a run bit for bit."""
    return hashlib.sha256("\0".join(sorted(libraries)).encode()).hexdigest()[:24]


@cache
def module(path: str, real: str = "double") -> Module:
    """The compiled text, once per process."""
    return Module(path, real)


class Cpu:
    """The processor as a place for kernels to run."""

    name = "cpu"

    @staticmethod
    def module(path: str) -> Module:
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


def native(path: str, signatures: dict[str, tuple[Any, list[Any]]], stepping: bool = True) -> ctypes.CDLL:
    """A host-only C++ text of this package with its functions' types declared."""
    library = ctypes.CDLL(str(build(HERE / path, stepping=stepping)))
    for name, (result, arguments) in signatures.items():
        function: Callable[..., Any] = getattr(library, name)
        function.restype, function.argtypes = result, arguments  # type: ignore[attr-defined]
    return library
