# SPDX-License-Identifier: MIT
"""Structs, enumerators and constants as Python reads them from C++ texts, and as the compiler has them."""

import ctypes as c
import subprocess
from pathlib import Path

import numpy as np
import pytest

from sim_server.backends.compiler import INCLUDE, SOURCES, compiler
from sim_server.backends.cpu import structs as cpu
from sim_server.backends.declarations import Declarations, Member, split_members

TEXT = """
#include "other.h"
#include <atomic>
typedef void (*Kernel)(const void* params, int begin, int end);
typedef uint64_t Address;
constexpr int DEPTH = 2, PICTURES = 3;
constexpr double SLACK = 2, LONG = 4.5;
enum Phase { SOLVE = 0, TRY = 1 };  // TRY = 7 in a comment
enum { LOW = -1, HIGH = 5 };

struct Pair {
    int32_t first, last;   // nodes; not read: int x;
    double weight = -1;
};

struct All {
    char flag;
    Pair pair;
    std::atomic<int64_t> step, taken;
    std::atomic<const Pair*> mail;
    const double *x, *v;
    int32_t (*graph_launch)(void* graph,
                            void* stream);
    Kernel kernel;
    Address place;
    double** still;
    Inner pairs[DEPTH], one;
    void* graphs[2][PICTURES];
    char where[28];
    Phase phase;
    unsigned short* bits;
    uint8_t marked;
};
"""
OTHER = """
#pragma once
struct Inner { int a, b; };
"""


@pytest.fixture
def texts(tmp_path: Path) -> Declarations:
    (tmp_path / "kernels").mkdir()
    (tmp_path / "kernels/other.h").write_text(OTHER)
    (tmp_path / "text.h").write_text(TEXT)
    return Declarations("text.h", tmp_path)


def accepted(texts: str, folder: Path) -> str:
    """What the C++ compiler says against a text; empty: nothing."""
    (folder / "asserted.cpp").write_text(texts)
    folders = [f"-I{p}" for p in (folder, folder / "kernels", SOURCES, INCLUDE)]
    command = [compiler(), "-std=c++17", "-fsyntax-only", *folders, "-include", "cstdint", str(folder / "asserted.cpp")]
    return subprocess.run(command, capture_output=True, text=True).stderr


def test_a_struct_is_laid_out_as_the_compiler_does(texts, tmp_path):
    assert accepted('#include "text.h"\n' + texts.assertions("Pair", "Inner", "All"), tmp_path) == ""
    dtype = texts.dtype("All")
    assert dtype.names is not None and dtype.names[:4] == ("flag", "pair", "step", "taken")
    assert dtype["pairs"].shape == (2,) and dtype["still"] == np.dtype("u8")


def test_the_compiler_refuses_another_layout(texts, tmp_path):
    asserted = texts.assertions("Pair", "All")
    (tmp_path / "text.h").write_text(TEXT.replace("int32_t first, last;", "int32_t last, first;"))
    assert "Pair.first" in accepted('#include "text.h"\n' + asserted, tmp_path)


def test_a_decorated_structure_is_what_members_of_its_type_are(texts):
    @texts.struct
    class Pair(c.Structure):
        pass

    @texts.struct
    class All(c.Structure):
        pass

    found = All(pair=Pair(first=3, weight=0.5), where=b"here")
    assert isinstance(found.pair, Pair) and (found.pair.first, found.pair.weight) == (3, 0.5)
    assert found.where == b"here" and len(found.graphs) == 2 and len(found.graphs[0]) == 3


def test_numbers(texts):
    assert texts.enumeration("Phase") == {"SOLVE": 0, "TRY": 1}
    assert texts.enumerators == {"SOLVE": 0, "TRY": 1, "LOW": -1, "HIGH": 5}
    assert [texts.constant(name) for name in ("DEPTH", "PICTURES", "SLACK", "LONG")] == [2, 3, 2.0, 4.5]


def test_what_is_not_there_is_named(texts):
    for missing in (lambda: texts.dtype("None"), lambda: texts.constant("NONE"), lambda: texts.enumeration("None")):
        with pytest.raises(ValueError, match=r"text\.h"):
            missing()
    with pytest.raises(ValueError, match="int size"):
        list(split_members("int size() const { return 3; }"))


def test_members_of_a_kernel(texts):
    found = list(split_members("int n;  // nodes\n const real* x; own<local> r;\n real h;"))
    assert found == [
        Member("n", "int"), Member("x", "real", True, constant=True), Member("r", "own<local>", True),
        Member("h", "real"),
    ]  # fmt: skip


def test_the_compiler_agrees_with_all_that_the_loop_of_the_cpu_shares(tmp_path):
    asserted = '#include "backends/cpu/native/loop.h"\n' + cpu.LOOP.assertions()
    assert "sizeof(Loop)" in asserted and "Record.step" in asserted and accepted(asserted, tmp_path) == ""
