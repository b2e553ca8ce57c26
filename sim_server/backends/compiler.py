# SPDX-License-Identifier: MIT
"""Compiles kernel texts and host-only C++ texts for the CPU and keeps the libraries.

One `.cu` text serves both compilers (kernels/kernel.h). Here the system C++ compiler builds it into a shared library
that ctypes loads, cached by source, headers, flags, compiler and processor. A wheel brings libraries of the texts of
this package (processor_variants.py), which need no compiler. Arguments: kernel_binding.py.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import shutil
import subprocess
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from protocol.process.cache_folder import cache_folder, remove_stale
from sim_server.backends.build_pool import CompileError, Job, compilers
from sim_server.backends.cache_trust import distrust
from sim_server.backends.processor_variants import LIBRARIES, made_by, variant

SOURCES = Path(__file__).parents[1]  # sim_server/
INCLUDE = SOURCES / "kernels"
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
def compiler_version() -> str:
    """What the compiler says of itself. Raises CompileError if there is none."""
    return subprocess.run([compiler(), "--version"], capture_output=True, text=True, check=True).stdout


@cache
def _machine() -> str:
    """What -march=native depends on: compiler version and processor flags."""
    version = compiler_version()
    try:
        flags = next(
            line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith(("flags", "Features"))
        )
    except (OSError, StopIteration):
        flags = platform.processor()
    return version + flags


def _make(folder: Path) -> None:
    try:
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    except OSError as error:
        raise CompileError(
            f"compiled kernels cannot be kept in {folder}: {error.strerror}; WARPFACTOR_CACHE may name another folder"
        ) from error
    remove_stale(folder)


def read_text(path: str) -> tuple[str, str]:
    """Name and text of a kernel text of this package, or of another by its absolute path. Raises CompileError.

    "a.cu+b.cuh" is the text a.cu with b.cuh in place of its line `#include LAW`, and its name is b.
    """
    frame, law = _parts(path)
    try:
        text = (SOURCES / frame).read_text()
        if not law:
            return Path(frame).stem, text
        return Path(law).stem, text.replace("#include LAW\n", (SOURCES / law).read_text())
    except OSError as error:
        raise CompileError(f"kernel text {path}: {error.strerror}") from error
    except UnicodeDecodeError as error:
        raise CompileError(f"kernel text {path}: is no UTF-8 text") from error


def _parts(path: str) -> tuple[str, str]:
    frame, law, name = path.partition(".cu+")
    return (f"{frame}.cu", name) if law else (path, "")


def folder_outside(path: str) -> Path | None:
    """Folder of a kernel text that is of another package, where its own headers are; None for one of this package."""
    frame, law = _parts(path)
    source = SOURCES / (law or frame)
    return None if source.is_relative_to(SOURCES) else source.parent


def digest(source: Path, flags: list[str], text: str | None, machine: str) -> str:
    """Names a library by all that it is made of. machine: compiler, and processor where flags do not name one."""
    folders = [f for f in {INCLUDE, source.parent, SOURCES / "backends/cpu/native"} if f.is_dir()]
    headers = sorted(p for folder in folders for p in folder.iterdir() if p.suffix in (".h", ".cuh"))
    parts = [machine, *flags, text or source.read_text(), *(p.name + p.read_text() for p in headers)]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]


def job(source: Path, flags: list[str], text: str | None, library: Path) -> Job:
    """How a library is made."""
    own = [] if source.is_relative_to(SOURCES) else [f"-I{source.parent}"]
    command = [compiler(), *flags, "-x", "c++", f"-I{INCLUDE}", *own, str(source) if text is None else "-"]
    return Job(source.name, library, command, text)


def flags_of(variant: str, defines: tuple[str, ...] = ()) -> list[str]:
    """Flags of a library of a wheel; it finds the runtime of OpenMP in the folder above it."""
    generic = [f"-march={variant}" if flag == "-march=native" else flag for flag in FLAGS]
    return [*generic, "-Wl,--as-needed,-s,-rpath,$ORIGIN/..", *(f"-D{d}" for d in defines)]


def _brought(source: Path, defines: tuple[str, ...], text: str | None) -> Path | None:
    """The library of a text that the wheel brings for this processor; None: it brings none."""
    if (name := variant()) is None:
        return None
    made = digest(source, flags_of(name, defines), text, made_by())
    library = LIBRARIES / name / f"{source.stem}-{made}.so"
    return library if library.exists() else None


def begin(source: Path, defines: tuple[str, ...] = (), text: str | None = None) -> Path:
    """The shared library of one text, which exists after `compilers.finish`; compiles only what is not there.

    text: where the file does not hold it. Raises CompileError without a compiler or a folder for the library, or
    if others than this user could have put it there.
    """
    if (brought := _brought(source, defines, text)) is not None:
        return brought
    flags = [*FLAGS, *(f"-D{d}" for d in defines)]
    library = cache_folder() / f"{source.stem}-{digest(source, flags, text, _machine())}.so"
    there = library.exists()
    if not there:
        _make(library.parent)
    if why := distrust(library):
        raise CompileError(f"compiled kernels are not loaded: {why}")
    if not there:
        compilers.begin(job(source, flags, text, library))
    return library


def used(source: Path, library: Path, stepping: bool = True) -> None:
    """Notes that this process uses a library. stepping: True if results of steps depend on it."""
    compiled.append(source.name)
    if stepping:
        libraries.add(library.name)


def build(source: Path, stepping: bool = True) -> Path:
    """The shared library of a text, made. Raises CompileError with the compiler's output."""
    library = begin(source)
    compilers.finish(library)
    used(source, library, stepping)
    return library


def source_of(path: str) -> tuple[Path, str | None]:
    """File that names a kernel text of this package or of another, and the text where that file does not hold it."""
    frame, law = _parts(path)
    return SOURCES / (law or frame), read_text(path)[1] if law else None


def begin_kernels(path: str, text: str, defines: tuple[str, ...]) -> Path:
    """As `begin`, of a kernel text as read_text gives it; notes that this process uses it."""
    frame, law = _parts(path)
    source = SOURCES / (law or frame)
    library = begin(source, defines, text if law else None)
    used(source, library)
    return library


def ahead(*paths: str) -> None:
    """Begins to compile host-only texts of this package that will be asked for soon."""
    for path in paths:
        begin(SOURCES / path)


def names(*paths: str) -> list[str]:
    """Returns the names of the libraries of host-only texts of this package; begins to compile those that are not
    there."""
    return [begin(SOURCES / path).name for path in paths]


def build_id() -> str:
    """Digest of the compiled code in use, with the variant of a wheel's: equal ones repeat a run bit for bit."""
    made = hashlib.sha256("\0".join(sorted(libraries)).encode()).hexdigest()[:24]
    return f"{name}:{made}" if (name := variant()) else made


def native(
    path: str, signatures: dict[str, tuple[Any, list[Any]]], stepping: bool = True, lock: bool = False
) -> ctypes.CDLL:
    """A host-only C++ text of this package with its functions' types declared. lock: they keep Python's lock, as is
    best where that takes less time than to get it back while other threads are at work."""
    library = (ctypes.PyDLL if lock else ctypes.CDLL)(str(build(SOURCES / path, stepping=stepping)))
    for name, (result, arguments) in signatures.items():
        function: Callable[..., Any] = getattr(library, name)
        function.restype, function.argtypes = result, arguments  # type: ignore[attr-defined]
    return library
