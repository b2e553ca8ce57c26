# SPDX-License-Identifier: MIT
"""Reads structs, enumerators and constants from the C++ texts that define them, so that Python repeats none of them.

    TEXT = Declarations("backends/cpu/native/loop.h")
    RECORD = TEXT.dtype("Record")                  # a NumPy dtype

    @TEXT.struct
    class Rings(ctypes.Structure): ...             # fields of struct Rings

A member is a number, a struct of the same text, a pointer or an array of these; std::atomic<T> is laid out as T. Every
pointer (also own<T> and pointers to functions) is a `c_void_p`, uint64 in a dtype. Alignment is the C compiler's;
`assertions` lets it check every offset.
"""

import ctypes as c
import re
from collections.abc import Iterator
from functools import cached_property
from itertools import count, takewhile
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import numpy as np

from sim_server.backends.compiler import SOURCES

FOLDERS = ("kernels", "backends/cpu/native", "backends/gpu", "backends/gpu/inverse")  # of headers
NUMBERS: dict[str, type[Any]] = {
    "bool": c.c_bool, "char": c.c_char, "uint8_t": c.c_uint8, "int": c.c_int32, "int32_t": c.c_int32,
    "unsigned": c.c_uint32, "uint32_t": c.c_uint32, "long long": c.c_int64, "int64_t": c.c_int64,
    "uint64_t": c.c_uint64, "float": c.c_float, "double": c.c_double,
}  # fmt: skip
DECLARATION = re.compile(r"(const )?(unsigned(?: short)?|long long|own<\w+>|[\w:]+(?:<[^>]*>)?)([\s*].*)", re.DOTALL)
DECLARATOR = re.compile(r"\s*(\**)\s*(\w+)((?:\[\w+\])*)(?:\s*=.*)?\s*", re.DOTALL)
FUNCTION = re.compile(r"\w+ \(\*(\w+)\)\(.*\)", re.DOTALL)  # a pointer to one

HAS_OFFSETOF = "!defined(__CUDACC_RTC__) || __CUDACC_VER_MAJOR__ * 100 + __CUDACC_VER_MINOR__ >= 1304"  # 13.2 has not

Struct = TypeVar("Struct", bound=c.Structure)


class StructSize(c.Structure):
    """Size of a struct by name, as backends/cpu/native/sizes.h exports it."""

    _fields_ = [("name", c.c_char_p), ("bytes", c.c_int64)]


class Member(NamedTuple):
    """A member of a struct. kind: the type as written, without const, * and []. shape: of an array, else ()."""

    name: str
    kind: str
    pointer: bool = False
    shape: tuple[str, ...] = ()
    constant: bool = False


def split_members(body: str) -> Iterator[Member]:
    """Members of a struct in order. body: the text between its braces. Raises ValueError for what is no data member."""
    for line in re.sub(r"//[^\n]*", "", body).split(";"):
        line = line.strip()
        if not line:
            continue
        line = re.sub(r"std::atomic<([^<>]*)>", r"\1", line)
        if function := FUNCTION.fullmatch(line):
            yield Member(function[1], "function", pointer=True)
            continue
        found = DECLARATION.fullmatch(line)
        declarators = [DECLARATOR.fullmatch(each) for each in found[3].split(",")] if found else []
        if found is None or None in declarators:
            raise ValueError(f"cannot read the member {line!r}")
        for each in filter(None, declarators):
            shape = tuple(re.findall(r"\[(\w+)\]", each[3]))
            yield Member(each[2], found[2], bool(each[1]) or found[2].startswith("own<"), shape, bool(found[1]))


class Declarations:
    """What a text of this package and the headers that it includes declare. path: below sim_server/.

    Nothing is read before it is asked for. Methods raise ValueError where the text has no such declaration.
    """

    def __init__(self, path: str, root: Path = SOURCES):
        self._path, self._root = path, root
        self._structs: dict[str, type[c.Structure]] = {}

    @cached_property
    def text(self) -> str:
        """The text with its headers in front of it, each once."""
        seen: dict[Path, str] = {}

        def read(path: Path) -> None:
            if path in seen:
                return
            seen[path] = ""
            text = path.read_text()
            for name in re.findall(r'^#include "([^"]+)"', text, re.MULTILINE):
                folders = (path.parent, *(self._root / folder for folder in FOLDERS))
                if header := next((p for f in folders if (p := (f / name).resolve()).exists()), None):
                    read(header)
            del seen[path]  # to stand behind its headers
            seen[path] = text

        read((self._root / self._path).resolve())
        return "\n".join(seen.values())

    @cached_property
    def enumerators(self) -> dict[str, int]:
        """Numbers of all enumerators by name."""
        return {name: number for body in self._enums.values() for name, number in body.items()}

    def enumeration(self, name: str) -> dict[str, int]:
        """Numbers of one enumeration by name, in order."""
        if name not in self._enums:
            raise ValueError(f"no enum {name} in {self._path}")
        return self._enums[name]

    @cached_property
    def _enums(self) -> dict[str, dict[str, int]]:
        text = re.sub(r"//[^\n]*", "", self.text)
        found = re.findall(r"\benum (\w*) ?\{(.*?)\}", text, re.DOTALL)
        return {name: {n: int(number) for n, number in re.findall(r"(\w+) = (-?\d+)", body)} for name, body in found}

    @cached_property
    def _bodies(self) -> dict[str, str]:
        pattern = r"^struct (?:__align__\(\d+\) )?(\w+) \{(.*?)\};"
        return dict(re.findall(pattern, self.text, re.DOTALL | re.MULTILINE))

    def constant(self, name: str) -> Any:
        """A constexpr number: int, or float where its type is double."""
        pattern = rf"^(?:static )?constexpr (\w+) (?:[^;]*,\s*)?{name} = ([-+.\w]+)"
        found = re.search(pattern, self.text, re.MULTILINE)
        if found is None:
            raise ValueError(f"no constant {name} in {self._path}")
        return (float if found[1] in ("double", "float") else int)(found[2])

    def members(self, struct: str) -> list[Member]:
        """Members of a struct, in order."""
        if struct not in self._bodies:
            raise ValueError(f"no struct {struct} in {self._path}")
        try:
            return list(split_members(self._bodies[struct]))
        except ValueError as error:
            raise ValueError(f"{self._path}, struct {struct}: {error}") from None

    def struct(self, cls: type[Struct]) -> type[Struct]:
        """Class decorator: gives a ctypes structure the members of the struct of the same name.

        Structs that are members must be decorated before, or remain without a name.
        """
        cls._fields_ = [(m.name, self._type(m)) for m in self.members(cls.__name__)]
        self._structs[cls.__name__] = cls
        return cls

    def dtype(self, struct: str) -> np.dtype:
        """A struct as NumPy sees it."""
        return np.dtype(self._structure(struct))

    def assertions(self, *structs: str) -> str:
        """C++ statements that hold if the compiler lays out these structs as Python does: every offset and size.

        Without names: of all structs that Python has asked for. An NVRTC that does not know offsetof compares sizes and
        alignments of the members, in the order of the text.
        """
        sizes, offsets = [], []
        for struct in structs or tuple(self._structs):
            made: Any = self._structure(struct)
            for name, kind in made._fields_:
                size, alignment, offset = c.sizeof(kind), c.alignment(kind), getattr(made, name).offset
                member, at = f"{struct}::{name}", f"__builtin_offsetof({struct}, {name})"
                found = f"sizeof({member}) == {size} && alignof(decltype({member})) == {alignment}"
                sizes.append(f'static_assert({found}, "{struct}.{name}");')
                offsets.append(f'static_assert({at} == {offset}, "{struct}.{name}");')
            sizes.append(f'static_assert(sizeof({struct}) == {c.sizeof(made)}, "{struct}");')
        return "\n".join(["", *sizes, f"#if {HAS_OFFSETOF}", *offsets, "#endif", ""])

    def checked(self) -> str:
        """The text itself with `assertions` of the structs asked for: a compiler refuses it if it has other layouts."""
        return (self._root / self._path).read_text() + self.assertions()

    def check_sizes(self, library: c.CDLL) -> None:
        """Raises RuntimeError if a library was compiled with other sizes of these structs (native/sizes.h)."""
        library.wf_sizes.restype = c.POINTER(StructSize)
        for each in takewhile(lambda size: size.name, map(library.wf_sizes().__getitem__, count())):
            name = each.name.decode()
            if (ours := c.sizeof(self._structure(name))) != each.bytes:
                raise RuntimeError(f"struct {name} of {self._path} has {each.bytes} bytes compiled, {ours} in Python")

    def _structure(self, struct: str) -> type[c.Structure]:
        if struct not in self._structs:
            self.struct(type(struct, (c.Structure,), {}))
        return self._structs[struct]

    def _type(self, member: Member) -> Any:
        made: Any = c.c_void_p if member.pointer else self._value(member.kind)
        for extent in reversed(member.shape):
            made *= int(extent) if extent.isdigit() else self.constant(extent)
        return made

    def _value(self, kind: str) -> Any:
        if kind in NUMBERS:
            return NUMBERS[kind]
        if kind in self._enums:
            return c.c_int32
        if kind.endswith("*") or re.search(rf"typedef [^;]*\(\*{kind}\)", self.text):
            return c.c_void_p
        if alias := re.search(rf"typedef ([\w ]+) {kind};", self.text):
            return self._value(alias[1])
        return self._structure(kind)
