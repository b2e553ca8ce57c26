# SPDX-License-Identifier: MIT
"""Which kernels of a wheel are used on a processor, and that they are found without a compiler."""

import subprocess
from pathlib import Path

import numpy as np
import pytest

from sim_server.backends import compiler, processor_variants, wheel
from sim_server.backends.build_pool import CompileError, compilers
from sim_server.backends.cpu.device import CpuModule
from sim_server.backends.processor_variants import VARIANTS, choose
from tests.backends.test_compiler import PUSH, TEXTS, arguments

ZEN3 = VARIANTS["x86-64-v3"] | {"fpu", "sse2", "avx512f"}  # one part of what v4 needs is not v4


@pytest.fixture
def libraries(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder as a wheel has it, with all variants and nothing in them, of a compiler that is not here."""
    folder = tmp_path / "libraries"
    for name in VARIANTS:
        (folder / name).mkdir(parents=True)
    (folder / processor_variants.MADE_BY).write_text("g++ of long ago")
    monkeypatch.setattr(processor_variants, "LIBRARIES", folder)
    monkeypatch.setattr(compiler, "LIBRARIES", folder)
    monkeypatch.setenv("WARPFACTOR_CACHE", str(tmp_path / "cache"))
    return folder


@pytest.fixture(autouse=True)
def forgotten():
    """What a process finds out once, it finds out anew in each test, and behind the last."""
    found = (processor_variants.variant, processor_variants.made_by, compiler.compiler)
    for function in found:
        function.cache_clear()
    yield
    for function in found:
        function.cache_clear()


def test_each_variant_runs_where_a_faster_one_does():
    assert VARIANTS["x86-64-v4"] > VARIANTS["x86-64-v3"] > VARIANTS["x86-64"] == frozenset()
    assert list(VARIANTS) == [name for names in wheel.EVERY.values() for name in names]


def test_the_fastest_variant_that_the_processor_has_is_chosen(libraries):
    assert choose(libraries, VARIANTS["x86-64-v4"]) == "x86-64-v4"
    assert choose(libraries, ZEN3) == "x86-64-v3"
    assert choose(libraries, ZEN3 - {"fma"}) == "x86-64"
    assert choose(libraries, ZEN3, "native") is None
    assert choose(libraries, ZEN3, "x86-64") == "x86-64"
    (libraries / "x86-64-v3").rmdir()
    assert choose(libraries, ZEN3) == "x86-64"


def test_what_cannot_run_or_is_not_there_is_refused_by_name(libraries):
    lacks = r"WARPFACTOR_KERNELS=x86-64-v4: this processor lacks avx512bw, .*; allowed here: native, x86-64-v3, x86-64"
    with pytest.raises(CompileError, match=lacks):
        choose(libraries, ZEN3, "x86-64-v4")
    with pytest.raises(CompileError, match=r"=fast: this installation brings no such kernels; allowed here: native, "):
        choose(libraries, ZEN3, "fast")


def test_a_checkout_has_no_libraries_and_compiles_for_its_processor():
    assert not processor_variants.LIBRARIES.exists()
    assert processor_variants.variant() is None and ":" not in compiler.build_id()


def test_a_library_of_the_wheel_is_used_without_a_compiler_and_named_in_the_build(libraries, tmp_path, monkeypatch):
    """And one for another text is not: then a compiler is asked for."""
    texts = tmp_path / "texts"
    texts.mkdir()
    (texts / "push.cu").write_text(PUSH)
    monkeypatch.setattr(compiler, "SOURCES", texts)
    monkeypatch.setattr(compiler, "libraries", set())
    flags = compiler.flags_of("x86-64", ("real=double",))
    made = compiler.digest(texts / "push.cu", flags, None, "g++ of long ago")
    brought = libraries / "x86-64" / f"push-{made}.so"
    compilers.begin(compiler.job(texts / "push.cu", flags, None, brought))
    compilers.finish(brought)

    monkeypatch.setenv("PATH", str(texts))
    monkeypatch.delenv("CXX", raising=False)
    monkeypatch.setenv("WARPFACTOR_KERNELS", "x86-64")
    compiler.compiler.cache_clear()
    given = arguments()
    CpuModule("push.cu").bind("push", 5, **given)()
    np.testing.assert_array_equal(given["x"], 0.5 * np.arange(5))
    assert compiler.libraries == {brought.name} and not (tmp_path / "cache").exists()
    build = compiler.build_id()
    assert build.startswith("x86-64:")
    assert processor_variants.advice(build) == ""
    assert "for x86-64-v4 of a wheel, which WARPFACTOR_KERNELS=x86-64-v4 " in processor_variants.advice("x86-64-v4:12")
    assert processor_variants.advice("0123456789abcdef") == ""

    (texts / "push.cu").write_text(PUSH + "// another text\n")
    with pytest.raises(CompileError, match=r"no C\+\+ compiler found"):
        CpuModule("push.cu").address("push")


def test_a_wheel_holds_every_text_that_a_scene_may_ask_for():
    assert set(wheel.kernel_texts()) == set(TEXTS)
    names = {path.name for path in wheel.host_texts()}
    assert {"loop.cpp", "factor_check.cpp", "signed_distance.cpp", "incomplete.cpp"} <= names


def test_the_tag_tells_the_newest_glibc_that_a_library_asks_for(tmp_path):
    """Of a text that takes the square root and the hyperbolic tangent, and of one that takes the exponential too."""
    assert wheel.glibc_needed(tmp_path) == wheel.OLDEST
    needed = []
    for name, text in {"old": "tanh(x)", "new": "tanh(x) + exp(x)"}.items():
        source = tmp_path / f"{name}.cpp"
        source.write_text(f'#include <cmath>\nextern "C" double f(double x) {{ return std::{text}; }}\n')
        command = [compiler.compiler(), "-shared", "-fPIC", "-o", str(tmp_path / f"{name}.so"), str(source)]
        subprocess.run(command, check=True)
        needed.append(wheel.glibc_needed(tmp_path))
    assert needed[0] < needed[1] == (2, 29)
