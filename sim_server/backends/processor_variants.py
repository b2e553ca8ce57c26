# SPDX-License-Identifier: MIT
"""The libraries that a wheel brings, compiled for generations of processors, and which of them are used here.

A checkout brings none: there everything is compiled for the very processor. Levels: x86-64 psABI, table 3.1; a wheel
for aarch64 has one variant, since all such processors have vectors of the same width.
"""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

from sim_server.backends.build_pool import CompileError

LIBRARIES = Path(__file__).parent / "libraries"  # VARIANT/NAME-DIGEST.so, MADE_BY; made by wheel.py
MADE_BY = "compiler.txt"  # version of the compiler that made them
CHOICE = "WARPFACTOR_KERNELS"
NATIVE = "native"  # compiled here, for this processor

_V3 = frozenset({"avx", "avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe", "xsave"})
# Flags of /proc/cpuinfo that each needs, fastest first of each machine; abm is what Linux calls lzcnt.
VARIANTS: dict[str, frozenset[str]] = {
    "x86-64-v4": _V3 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
    "x86-64-v3": _V3,
    "x86-64": frozenset(),
    "armv8-a": frozenset({"asimd"}),
}


def processor_flags() -> frozenset[str]:
    """Flags of this processor as Linux names them; none where they cannot be read."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return frozenset()
    named = (line.partition(":")[2].split() for line in lines if line.startswith(("flags", "Features")))  # x86, ARM
    return frozenset(next(named, []))


def present(libraries: Path) -> list[str]:
    """Variants that a folder of libraries holds, fastest first."""
    return [name for name in VARIANTS if (libraries / name).is_dir()]


def choose(libraries: Path, flags: frozenset[str], wanted: str = "") -> str | None:
    """The variant to use on a processor with these flags; None: everything is compiled here.

    wanted: a variant or "native"; empty: the fastest one. Raises CompileError for one that is not there or cannot run.
    """
    there = present(libraries)
    able = [name for name in there if VARIANTS[name] <= flags]
    if not wanted:
        return next(iter(able), None)
    if wanted == NATIVE:
        return None
    if wanted in able:
        return wanted
    if wanted in there:
        why = f"this processor lacks {', '.join(sorted(VARIANTS[wanted] - flags))}"
    else:
        why = "this installation brings no such kernels"
    raise CompileError(f"{CHOICE}={wanted}: {why}; allowed here: {', '.join([NATIVE, *able])}")


@cache
def variant() -> str | None:
    """The variant that this process uses, $WARPFACTOR_KERNELS or the fastest one; None: all is compiled here."""
    return choose(LIBRARIES, processor_flags(), os.environ.get(CHOICE, ""))


@cache
def made_by() -> str:
    """Version of the compiler that made the libraries of the wheel."""
    return (LIBRARIES / MADE_BY).read_text()


def advice(build: str) -> str:
    """What a replay of a log says where it runs other kernels than a wheel's that made the log; else nothing."""
    recorded = build.rpartition(":")[0]
    if not recorded or recorded == variant():
        return ""
    return f"; it was recorded with the kernels for {recorded} of a wheel, which {CHOICE}={recorded} chooses"
