# SPDX-License-Identifier: MIT
"""Reads the argument struct of a kernel from its text and checks arrays and numbers against it.

A struct's layout stands in one place, the kernel text (kernels/kernel.h). cpu/device.py and gpu/device.py fill the
struct for their side.
"""

from __future__ import annotations

import ctypes
import re
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from sim_server.backends.build_pool import CompileError
from sim_server.backends.compiler import folder_outside, read_text
from sim_server.backends.declarations import NUMBERS, split_members

REALS_AND_INT = ("int", "float", "double")


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


def members_of(text: str, struct: str, types: dict[str, str]) -> list[Argument]:
    """Members of a struct of a text, in order. types: what `real` and `local` stand for. Raises CompileError."""
    body = re.search(rf"struct {struct} \{{(.*?)\n\}};", text, re.DOTALL)
    if body is None:
        raise CompileError(f"no struct {struct} in the kernel text")
    members = []
    try:
        for member in split_members(body.group(1)):
            own = member.kind.startswith("own<")
            written = member.kind[4:-1] if own else member.kind
            kind = types.get(written, written)
            if kind not in REALS_AND_INT or member.shape:
                raise ValueError(f"cannot read the member {member.name!r}")
            dtype = np.dtype(NUMBERS[kind]) if member.pointer else None
            members.append(Argument(member.name, kind, dtype, own, member.constant))
    except ValueError as error:
        raise CompileError(f"struct {struct}: {error}") from None
    return members


def structure_of(members: list[Argument]) -> type[ctypes.Structure]:
    """The argument struct as ctypes has it: numbers and addresses of arrays."""
    fields = [(m.name, NUMBERS[m.kind] if m.dtype is None else ctypes.c_void_p) for m in members]
    return type("Arguments", (ctypes.Structure,), {"_fields_": fields})


@cache
def _signature(
    text: str, kernel: str, module: str, types: tuple[tuple[str, str], ...]
) -> tuple[list[Argument], str, str]:
    """Reads the signature of a kernel. Cached, since touch.apply is bound anew at each move of a grab."""
    found = re.search(rf"^(MAILED_|SUM_)?KERNEL\({kernel}, (\w+)[,)]", text, re.MULTILINE)
    if found is None:
        raise CompileError(f"no kernel {kernel} in {module}.cu")
    return members_of(text, found.group(2), dict(types)), found.group(2), found.group(1) or ""


@cache
def domain_of(text: str, struct: str) -> str:
    """What the items of a kernel are: the first word behind `int n;` in its struct."""
    found = re.search(rf"struct {struct} \{{\s*int n;\s*// (\w+)", text)
    return found.group(1) if found else ""


class KernelText:
    """A kernel text. path: as of compiler.read_text. types: what `real` and `local` stand for.

    folder: of a text of another package
    """

    def __init__(self, path: str, types: dict[str, str]):
        self.path = path
        self.name, self.text = read_text(path)
        self.types, self.folder = types, folder_outside(path)


class BoundKernel:
    """Base of launches: a kernel of a text, and its arguments by the names of its struct's members.

    fields: the members. values: an argument for each. mailed: the arguments may be replaced while steps run. sums: its
    items sum over lists. converts: an array of float64 may stand for one of float32.
    Raises CompileError for an unknown kernel, TypeError where an argument does not fit the text.
    """

    def __init__(self, of: KernelText, kernel: str, given: dict[str, Any], converts: bool = False):
        self.name, self.items = f"{of.name}.{kernel}", int(given["n"])
        self.text, self.types, self.folder = of.text, of.types, of.folder
        self.fields, self.struct, form = _signature(of.text, kernel, of.name, tuple(of.types.items()))
        self.mailed, self.sums = form == "MAILED_", form == "SUM_"
        if set(given) != {f.name for f in self.fields}:
            raise TypeError(f"{self.name} takes {[f.name for f in self.fields]}, not {sorted(given)}")
        self.values = [given[f.name] for f in self.fields]
        for f, value in zip(self.fields, self.values, strict=True):
            if f.dtype is None:
                continue
            fits = [f.dtype, np.dtype("f8")] if converts and f.dtype.kind == "f" else [f.dtype]
            if not (isinstance(value, np.ndarray) and value.dtype in fits and value.flags.c_contiguous):
                raise TypeError(f"{self.name}: {f.name} must be a contiguous array of {f.dtype}")

    def written(self) -> list[tuple[str, np.ndarray]]:
        """Returns the arrays of the host that it may write, by the names of its struct's members."""
        given = zip(self.fields, self.values, strict=True)
        return [(f.name, value) for f, value in given if f.dtype is not None and not f.constant]

    @property
    def domain(self) -> str:
        """What its items are: the first word behind `int n;` in its struct."""
        return domain_of(self.text, self.struct)
