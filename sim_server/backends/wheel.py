# SPDX-License-Identifier: MIT
"""Builds the wheel of this platform: the package, and its kernels compiled for generations of processors.

`pip wheel .` and `python -m build --wheel` come here (pyproject.toml, tool.setuptools.cmdclass), with nothing but
setuptools at hand. On Linux with a C++ compiler for x86-64 or aarch64 ($CXX may be one for another machine) the
libraries of all texts go into the wheel, and its tag says which glibc they need at least; elsewhere, and for editable
installations, it has none and kernels are compiled when they are first used. WARPFACTOR_VARIANTS: variants separated
by commas instead of all; "none": no libraries.
"""

from __future__ import annotations

import ast
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_py import build_py

ROOT = Path(__file__).parents[2]
SERVER = ROOT / "sim_server"
FRAME = "kernels/hyperelastic.cu"  # of laws: no text by itself
PATCH_FRAMES = ("kernels/hyperelastic_cells.cu", "kernels/hyperelastic_patches.cu")  # of those in PATCHED
OPENMP = "libgomp.so.1"  # GPL 3 with the runtime exception; nothing that users have installed brings it
OLDEST = (2, 17)  # glibc
EVERY = {"x86_64": ["x86-64-v4", "x86-64-v3", "x86-64"], "aarch64": ["armv8-a"]}  # as processor_variants.py has them


def patched() -> list[str]:
    """Laws that patches of elements may have: the list of scene/elements.py, which imports pydantic, so it is read."""
    for node in ast.parse((SERVER / "scene/elements.py").read_text()).body:
        if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "PATCHED":
            return list(ast.literal_eval(node.value))
    raise ValueError("sim_server/scene/elements.py defines no PATCHED")


def kernel_texts() -> list[str]:
    """Every kernel text that a scene may ask for on a CPU, as of compiler.read_text."""
    found = sorted(p.relative_to(SERVER).as_posix() for p in SERVER.rglob("*.cu"))
    laws = sorted(p.relative_to(SERVER).as_posix() for p in SERVER.glob("effects/*.cuh"))
    texts = [path for path in found if not path.startswith("backends/gpu/") and path not in (FRAME, *PATCH_FRAMES)]
    texts += [f"{FRAME}+{law}" for law in laws]
    return texts + [f"{frame}+effects/{law}.cuh" for frame in PATCH_FRAMES for law in patched()]


def host_texts() -> list[Path]:
    """Every C++ text of the server and of workers."""
    packages = ("protocol", "sim_server", "precond_worker")
    return sorted(path for package in packages for path in (ROOT / package).rglob("*.cpp"))


def make_libraries(folder: Path, variants: list[str]) -> None:
    """Compiles every text in each variant into a folder; what the cache of compiled kernels has is taken from it."""
    sys.path.insert(0, str(ROOT))  # a build backend has the folder of the project nowhere else
    try:
        from protocol.process.cache_folder import cache_folder
        from sim_server.backends import compiler
        from sim_server.backends.build_pool import compilers
        from sim_server.backends.processor_variants import MADE_BY
    finally:
        sys.path.pop(0)
    version = compiler.compiler_version()
    made: list[tuple[Path, Path]] = []
    for variant in variants:
        cache = cache_folder() / "wheel" / variant
        cache.mkdir(parents=True, exist_ok=True)
        (folder / variant).mkdir(parents=True)
        kernels = [(*compiler.source_of(path), ("real=double",)) for path in kernel_texts()]
        for source, text, defines in [*((path, None, ()) for path in host_texts()), *kernels]:
            flags = compiler.flags_of(variant, defines)
            library = cache / f"{source.stem}-{compiler.digest(source, flags, text, version)}.so"
            if not library.exists():
                compilers.begin(compiler.job(source, flags, text, library))
            made.append((library, folder / variant / library.name))
    for k, (library, kept) in enumerate(made, 1):
        compilers.finish(library)
        shutil.copy2(library, kept)
        print(f"kernels: {k} of {len(made)}, {kept.relative_to(folder)}", flush=True)
    found = subprocess.run(
        [compiler.compiler(), f"-print-file-name={OPENMP}"], capture_output=True, text=True, check=True
    )
    shutil.copy(Path(found.stdout.strip()).resolve(), folder / OPENMP)
    (folder / MADE_BY).write_text(version)


def glibc_needed(libraries: Path) -> tuple[int, int]:
    """Version of glibc that the libraries of a folder need at least, by the symbols that they ask for."""
    return max((v for path in libraries.rglob("*.so*") for v in _versions(path)), default=OLDEST)


def _versions(library: Path) -> Iterator[tuple[int, int]]:
    listed = subprocess.run([objdump(), "-p", str(library)], capture_output=True, text=True, check=True).stdout
    for major, minor in re.findall(r"\bGLIBC_(\d+)\.(\d+)", listed.partition("Version References:")[2]):
        yield int(major), int(minor)


def target() -> str:
    """Machine that the C++ compiler makes code for: "x86_64", "aarch64"; empty without one, or not on Linux."""
    name = next(filter(shutil.which, filter(None, (os.environ.get("CXX"), "g++", "clang++"))), None)
    if sys.platform != "linux" or name is None:
        return ""
    said = subprocess.run([name, "-dumpmachine"], capture_output=True, text=True, check=True).stdout
    return said.partition("-")[0]


def objdump() -> str:
    """Path of the objdump that reads code of the target; empty without one."""
    for name in (f"{target()}-linux-gnu-objdump", "objdump" if target() == platform.machine() else None):
        if name and (path := shutil.which(name)):
            return path
    return ""


def wanted() -> list[str]:
    """Variants to compile here; empty where that cannot be, or is not wanted."""
    every = EVERY.get(target(), [])
    if not every or not objdump():
        return []
    asked = [name for name in os.environ.get("WARPFACTOR_VARIANTS", "").split(",") if name]
    if asked == ["none"]:
        return []
    if unknown := [name for name in asked if name not in every]:
        raise SystemExit(f"WARPFACTOR_VARIANTS: {', '.join(unknown)}: allowed are none, {', '.join(every)}")
    return asked or every


class BuildWithLibraries(build_py):
    """Copies the package, and makes the libraries beside it, but for an editable installation."""

    def run(self) -> None:
        """Runs the command of setuptools."""
        super().run()
        if not self.editable_mode and (variants := wanted()):
            folder = Path(self.build_lib) / "sim_server/backends/libraries"
            shutil.rmtree(folder, ignore_errors=True)
            with tempfile.TemporaryDirectory() as scratch:
                make_libraries(Path(scratch), variants)
                shutil.copytree(scratch, folder)


class PlatformWheel(bdist_wheel):
    """A wheel with libraries that any Python of this platform loads; without them, a wheel for all platforms."""

    def finalize_options(self) -> None:
        """Has a wheel with libraries installed where those of a platform are."""
        libraries = bool(wanted())
        if libraries:
            self.distribution.has_ext_modules = lambda: True  # type: ignore[method-assign]
        super().finalize_options()
        self.root_is_pure = not libraries

    def get_tag(self) -> tuple[str, str, str]:
        """Python, ABI and platform: manylinux by the glibc that the libraries need."""
        libraries = Path(self.get_finalized_command("build_py").build_lib) / "sim_server/backends/libraries"
        if not libraries.is_dir():
            return "py3", "none", "any"
        major, minor = glibc_needed(libraries)
        return "py3", "none", f"manylinux_{major}_{minor}_{target()}"
