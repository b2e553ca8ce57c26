# SPDX-License-Identifier: MIT
"""Kernel texts: compiled with a cache, their errors shown, their arguments checked."""

import ctypes
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from sim_server.backends import compiler as backend
from sim_server.backends.cpu.device import CpuModule
from sim_server.backends.gpu import kernel_fusion
from sim_server.backends.gpu.device import PRECISIONS, own_headers
from sim_server.backends.gpu.device import options as device_options
from sim_server.backends.gpu.energies import BALANCE_TEXT
from sim_server.backends.gpu.step_sequence import EPILOGUE
from sim_server.backends.kernel_binding import domain_of, members_of
from sim_server.scene.elements import PATCHED
from tests.support import nvrtc

PUSH = """#include "kernel.h"
struct Push {
    int n;            // items
    const real* v;    // (n,)
    real* x;          // (n,) in, out
    const int* twist; // (n,)
    real h;
};
KERNEL(push, Push) { p.x[i] += p.h * p.v[i] * p.twist[i]; }
"""


@pytest.fixture
def folder(tmp_path, monkeypatch) -> Path:
    """Kernel texts of a test's own, with the package's headers and an empty cache."""
    texts = tmp_path / "texts"
    texts.mkdir()
    (texts / "push.cu").write_text(PUSH)
    monkeypatch.setattr(backend, "SOURCES", texts)
    monkeypatch.setenv("WARPFACTOR_CACHE", str(tmp_path / "cache"))
    return texts


def arguments(n: int = 5, real: str = "f8") -> dict:
    return {"v": np.ones(n, real), "x": np.zeros(n, real), "twist": np.arange(n, dtype=np.int32), "h": 0.5}


def libraries(folder: Path) -> set[str]:
    return {p.name for p in (folder.parent / "cache").iterdir()}


@pytest.mark.parametrize(("real", "dtype"), [("double", "f8"), ("float", "f4")])
def test_a_text_is_compiled_bound_and_run(folder, real, dtype):
    given = arguments(real=dtype)
    launch = CpuModule("push.cu", real).bind("push", 5, **given)
    launch()
    launch()
    np.testing.assert_array_equal(given["x"], [0, 1, 2, 3, 4])
    assert given["x"].dtype == dtype
    assert (launch.name, launch.items) == ("push.push", 5)


def test_a_cache_that_cannot_be_made_is_named(folder, monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("WARPFACTOR_CACHE", str(tmp_path / "file" / "cache"))
    with pytest.raises(backend.CompileError, match=r"kept in .*file/cache: Not a directory; WARPFACTOR"):
        CpuModule("push.cu").address("push")


def test_nothing_is_compiled_twice(folder):
    CpuModule("push.cu").address("push")
    first = libraries(folder)
    assert len(first) == 1
    assert next(iter(first)).startswith("push-")
    stamp = next((folder.parent / "cache").iterdir()).stat().st_mtime_ns
    CpuModule("push.cu").address("push")
    assert libraries(folder) == first
    assert next((folder.parent / "cache").iterdir()).stat().st_mtime_ns == stamp


def test_the_cache_knows_text_headers_flags_and_precision(folder, monkeypatch):
    source = folder / "push.cu"
    (folder / "mine.cuh").write_text("#define FACTOR 2\n")
    source.write_text(PUSH.replace('"kernel.h"', '"kernel.h"\n#include "mine.cuh"').replace("p.h *", "FACTOR * p.h *"))

    def result() -> float:
        given = arguments()
        CpuModule("push.cu").bind("push", 5, **given)()
        return given["x"][1]

    assert result() == 1.0
    (folder / "mine.cuh").write_text("#define FACTOR 6\n")
    assert result() == 3.0  # a header alone was edited
    assert len(libraries(folder)) == 2
    source.write_text(source.read_text().replace("* p.twist", "* 10 * p.twist"))
    assert result() == 30.0
    assert len(libraries(folder)) == 3
    monkeypatch.setattr(backend, "FLAGS", [*backend.FLAGS, "-DUNUSED"])
    assert result() == 30.0
    assert len(libraries(folder)) == 4
    CpuModule("push.cu", "float").address("push")
    assert len(libraries(folder)) == 5
    (folder / "mine.cuh").write_text("#define FACTOR 2\n")
    source.write_text(PUSH)
    assert result() == 0.5


def test_a_text_that_does_not_compile_says_why_and_leaves_nothing(folder):
    (folder / "push.cu").write_text(PUSH.replace("p.h", "p.nonsense"))
    with pytest.raises(backend.CompileError, match=r"push\.cu did not compile:[\s\S]*nonsense"):
        CpuModule("push.cu").address("push")
    assert not any(name.endswith(".so") for name in libraries(folder))


def test_without_a_compiler_the_message_says_what_to_do(folder, monkeypatch):
    backend.compiler.cache_clear()
    monkeypatch.setenv("PATH", str(folder))
    monkeypatch.delenv("CXX", raising=False)
    try:
        with pytest.raises(backend.CompileError, match=r"no C\+\+ compiler found .*apt-get install g\+\+"):
            backend.compiler()
    finally:
        backend.compiler.cache_clear()


WRONG = {
    "missing": ({"h": None}, "takes"),
    "unknown": ({"extra": 1.0}, "takes"),
    "single precision": ({"x": np.zeros(5, np.float32)}, "x must be a contiguous array of float64"),
    "wide integers": ({"twist": np.arange(5)}, "twist must be a contiguous array of int32"),
    "not contiguous": ({"v": np.ones(10)[::2]}, "v must be a contiguous array of float64"),
    "column major": ({"v": np.asfortranarray(np.ones((5, 2)))}, "v must be a contiguous array of float64"),
    "a list": ({"v": [1.0] * 5}, "v must be a contiguous array of float64"),
    "a number": ({"x": 3.0}, "x must be a contiguous array of float64"),
    "an array for a number": ({"h": np.ones(5)}, "array"),
    "a word for a number": ({"h": "fast"}, "real number|float"),
}


@pytest.fixture(scope="module")
def kept(tmp_path_factory) -> str:
    """A cache for tests that do not look at it: the first compiles."""
    return str(tmp_path_factory.mktemp("kept"))


@pytest.mark.parametrize(("change", "message"), WRONG.values(), ids=WRONG.keys())
def test_arguments_that_do_not_fit_are_refused(folder, kept, monkeypatch, change, message):
    monkeypatch.setenv("WARPFACTOR_CACHE", kept)
    given = {k: v for k, v in (arguments() | change).items() if v is not None}
    with pytest.raises(TypeError, match=message):
        CpuModule("push.cu").bind("push", 5, **given)


def test_kernels_and_members_that_cannot_be_found_are_named(folder):
    module = CpuModule("push.cu")
    with pytest.raises(backend.CompileError, match=r"no kernel pull in push\.cu"):
        module.bind("pull", 5, **arguments())
    (folder / "odd.cu").write_text(PUSH.replace("real h;", "real h[3];"))
    (folder / "odd.cu").write_text((folder / "odd.cu").read_text().replace("p.h *", "p.h[0] *"))
    with pytest.raises(backend.CompileError, match=r"struct Push: cannot read the member 'h'"):
        CpuModule("odd.cu").bind("push", 5, **arguments())


def test_layouts_are_those_of_the_compiler(folder):
    """Ints, reals and pointers in any order: the compiler pads as ctypes does."""
    body = "int n; real a; int k; const real* v; int m; real b; real* out;".replace("; ", ";\n    ")
    text = f'#include "kernel.h"\nstruct Odd {{\n    {body}\n}};\n'
    text += "KERNEL(odd, Odd) { p.out[i] = p.a + 10 * p.k + 100 * p.v[i] + 1000 * p.m + 10000 * p.b; }\n"
    (folder / "odd.cu").write_text(text)
    for real, dtype in (("double", "f8"), ("float", "f4")):
        out = np.zeros(3, dtype)
        launch = CpuModule("odd.cu", real).bind("odd", 3, a=1.0, k=2, v=np.full(3, 3, dtype), m=4, b=5.0, out=out)
        launch()
        assert (out == 54321).all()
        assert ctypes.sizeof(launch.params) in (40, 48, 56)


SOURCES = backend.SOURCES
LAWS = sorted(p.relative_to(SOURCES).as_posix() for p in SOURCES.glob("effects/*.cuh"))
FRAME = "kernels/hyperelastic.cu"  # of the laws: no text by itself
PATCH_FRAMES = ("kernels/hyperelastic_cells.cu", "kernels/hyperelastic_patches.cu")  # of those in PATCHED
GPU_TEXTS = sorted(p.relative_to(SOURCES).as_posix() for p in SOURCES.rglob("*.cu"))
GPU_TEXTS = [path for path in GPU_TEXTS if path not in (FRAME, *PATCH_FRAMES)] + [f"{FRAME}+{law}" for law in LAWS]
GPU_TEXTS += [f"{frame}+effects/{law}.cuh" for frame in PATCH_FRAMES for law in PATCHED]
TEXTS = [path for path in GPU_TEXTS if not path.startswith("backends/gpu/")]
WHOLE = {f"backends/gpu/{name}.cu" for name in ("apply_factor", "newton", "pcg")}


@pytest.mark.slow
@pytest.mark.parametrize("path", TEXTS)
def test_every_text_of_the_package_compiles_without_warnings(path, tmp_path):
    """In both precisions; -Wall is on, and a warning is an error here."""
    for real in ("double", "float"):
        command = [backend.compiler(), *backend.FLAGS, "-Werror", "-fsyntax-only", f"-Dreal={real}", "-x", "c++"]
        command += [f"-I{backend.INCLUDE}", "-"]
        result = subprocess.run(command, input=backend.read_text(path)[1], capture_output=True, text=True)
        assert result.returncode == 0, result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("arch", [pytest.param("sm_80", marks=pytest.mark.long), "sm_90"])
@pytest.mark.parametrize("path", GPU_TEXTS)
def test_every_text_of_the_package_compiles_for_gpus(path, arch, tmp_path):
    """By NVRTC, which needs no GPU and no driver; what it says counts as a failure too.

    In double precision for sm_90 with all optimization; those named in WHOLE are compiled so in test_gpu_structs.py.
    """
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    own = path.startswith("backends/gpu/")
    for name, types in PRECISIONS.items():
        if name == "mixed" and own and "local*" not in backend.read_text(path)[1]:
            continue  # the same: they know no elements
        if name == "float32" and arch == "sm_80":
            continue  # the other processor: what it lacks would be missed in double or mixed precision
        options = nvrtc.arch(arch, "max" if own else "mid", whole=name == "float64" and path not in WHOLE)
        options += [*device_options(types), *own_headers()]  # as they are compiled there
        text = tmp_path / "text.cu"
        text.write_text(backend.read_text(path)[1])
        code, said = nvrtc.compiled(library, text, options)
        assert len(code) > 1000 and not said, said


def test_the_gpu_compiler_names_an_error(tmp_path):
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    text = tmp_path / "wrong.cu"
    text.write_text('#include "kernel.h"\nINLINE number f() { return missing; }\n')
    code, said = nvrtc.compiled(library, text, ["-arch=sm_90", f"-I{backend.INCLUDE}"])
    assert not code and "missing" in said


def test_a_process_without_kernels_compiles_none(tmp_path):
    code = "import sim_server.scene, sim_server.simulation, sim_server.backends.compiler as b; print(b.compiled)"
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=SOURCES.parent)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize("name", ["nodes", "time_integration"])
@pytest.mark.parametrize("arch", ["sm_80", "sm_90"])
def test_the_last_kernel_of_a_step_compiles_with_the_end_of_the_step(arch, name, tmp_path):
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    advance = _launch(f"kernels/{name}.cu", "Advance", f"{name}.advance")
    end = kernel_fusion.Epilogue(EPILOGUE.checked(), "StepEpilogue", "finish_step", np.zeros(()))
    text = tmp_path / "last.cu"
    text.write_text(kernel_fusion.FusedSource([advance], kernel_fusion.BlockShape(32, 1), end).source)  # type: ignore[list-item]
    code, said = nvrtc.compiled(
        library, text, [f"-arch={arch}", "-std=c++17", f"-I{backend.INCLUDE}", f"-I{SOURCES / 'backends/gpu'}"]
    )
    assert len(code) > 1000 and not said, said


def test_the_first_kernel_of_a_step_compiles_with_the_energy_balance(tmp_path):
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    advance = _launch("kernels/time_integration.cu", "Advance", "time_integration.advance")
    first = kernel_fusion.Prologue(BALANCE_TEXT.checked(), "EnergyBalance", "balance_energy", np.zeros(()), 3)
    text = tmp_path / "first.cu"
    shape = kernel_fusion.BlockShape(32, 1)
    text.write_text(kernel_fusion.FusedSource([advance], shape, prologue=first).source)  # type: ignore[list-item]
    folders = [f"-I{folder}" for folder in (backend.INCLUDE, SOURCES / "backends/gpu")]
    code, said = nvrtc.compiled(library, text, ["-arch=sm_90", "-std=c++17", *folders])
    assert len(code) > 1000 and not said, said


def _launch(path: str, struct: str, name: str, mailed: bool = False) -> SimpleNamespace:
    """What fusing reads of a DeviceLaunch, its arrays by name at addresses of their own."""
    text = backend.read_text(path)[1]
    fields = members_of(text, struct, {"real": "double", "local": "double"})
    arrays = {
        f.name: SimpleNamespace(data=SimpleNamespace(ptr=hash(f.name) & 0xFFFFF00), shape=(9, 3), size=27)
        for f in fields if f.dtype is not None
    }  # fmt: skip
    params = np.zeros((), [(f.name, "u8" if f.dtype is not None else "f8") for f in fields])
    sums = f"SUM_KERNEL({name.split('.')[1]}," in text
    return SimpleNamespace(
        text=text, struct=struct, name=name, sums=sums, mailed=mailed, fields=fields, arrays=arrays, params=params,
        mail_address=64, items=9, domain=domain_of(text, struct),
    )  # fmt: skip


def kernels(launches: list[SimpleNamespace], monkeypatch) -> list[tuple[list, frozenset[int]]]:
    """Which launches are put together into one kernel each, and which arrays need no memory there."""
    monkeypatch.setattr(kernel_fusion, "FusedKernel", lambda together, end, private, *_: (together, private))
    return kernel_fusion.fuse(launches)  # type: ignore[arg-type]


NODES = [
    ("kernels/nodes.cu", "Start", "nodes.start"),
    ("effects/corotational_nodes.cu", "CorotationalNodes", "corotational_nodes.gather"),
    ("effects/corotational_exact_nodes.cu", "CorotationalExactNodes", "corotational_exact_nodes.gather"),
    ("effects/mass_spring_nodes.cu", "MassSpringNodes", "mass_spring_nodes.gather"),
    ("effects/touch.cu", "Apply", "touch.apply", True), ("effects/gravity.cu", "Gravity", "gravity.gravity"),
    ("kernels/gather_forces.cu", "GatherForces", "gather_forces.gather"),
    ("kernels/shape_matching.cu", "Match", "shape_matching.match"),
    ("kernels/nodes.cu", "Rotate", "nodes.rotate"),
]  # fmt: skip
ELEMENTS = [
    ("effects/corotational.cu", "CorotationalElements", "corotational.elements"),
    ("effects/corotational_qr.cu", "CorotationalQrElements", "corotational_qr.elements"),
    ("effects/corotational_exact.cu", "CorotationalExactElements", "corotational_exact.elements"),
    ("effects/mass_spring.cu", "Springs", "mass_spring.springs"),
]  # fmt: skip
CELLS = [
    ("effects/corotational_cells.cu", "CorotationalCells", "corotational_cells.measure"),
    ("effects/corotational_cells.cu", "CorotationalCells", "corotational_cells.measure_near"),
]
CELL_ELEMENTS = [
    ("effects/corotational_cells.cu", "CorotationalCellElements", "corotational_cells.elements"),
    ("effects/corotational_cells.cu", "CorotationalExactCellElements", "corotational_cells.exact_elements"),
    ("effects/corotational_cells.cu", "CorotationalCellImpulses", "corotational_cells.impulses"),
]
CELL_NODES = [
    NODES[0],
    ("effects/corotational_cell_sums.cu", "CellNodes", "corotational_cell_sums.gather"),
    ("effects/corotational_cell_sums.cu", "ExactCellNodes", "corotational_cell_sums.gather_exact"),
    ("kernels/patch_blocks.cu", "PatchNodes", "patch_blocks.own_blocks"),
    ("effects/corotational_cell_sums.cu", "TwistNodes", "corotational_cell_sums.gather_twists"),
    *NODES[-1:],
]
CELL_BLOCKS = [
    ("effects/corotational_cell_sums.cu", "CellBlocks", "corotational_cell_sums.blocks"),
    ("effects/corotational_cell_sums.cu", "ExactCellBlocks", "corotational_cell_sums.blocks_exact"),
    ("kernels/patch_blocks.cu", "PatchBlocks", "patch_blocks.blocks"),
    ("effects/corotational_cell_sums.cu", "TwistBlocks", "corotational_cell_sums.twist_blocks"),
    ("kernels/rotate_blocks.cu", "RotateBlocks", "rotate_blocks.rotate_blocks"),
]
LAW_ELEMENTS = [
    (f"{FRAME}+effects/neo_hookean.cuh", "HyperelasticElements", "neo_hookean.elements"),
    (f"{FRAME}+effects/mooney_rivlin.cuh", "HyperelasticElements", "mooney_rivlin.elements"),
    (f"{PATCH_FRAMES[0]}+effects/neo_hookean.cuh", "HyperelasticPatchElements", "neo_hookean.elements"),
    ("effects/fibres.cu", "FibresElements", "fibres.elements"),
    ("effects/prony.cu", "PronyElements", "prony.elements"),
    ("effects/plasticity.cu", "PlasticElements", "plasticity.elements"),
    ("effects/damage.cu", "DamageElements", "damage.elements"),
    ("effects/poroelasticity.cu", "PoreElements", "poroelasticity.elements"),
]
LAW_PATCHES = [
    (f"{PATCH_FRAMES[1]}+effects/neo_hookean.cuh", "PatchPressures", "neo_hookean.pressures"),
    (f"{PATCH_FRAMES[1]}+effects/mooney_rivlin.cuh", "PatchPressures", "mooney_rivlin.pressures"),
]
OTHER_SCHEME = [("kernels/time_integration.cu", "Inertia", "time_integration.inertia"), *NODES[1:]]
BLOCKS = [
    ("effects/corotational_blocks.cu", "CorotationalBlocks", "corotational_blocks.blocks"),
    ("effects/corotational_exact_blocks.cu", "CorotationalExactBlocks", "corotational_exact_blocks.blocks"),
    ("effects/mass_spring_blocks.cu", "MassSpringBlocks", "mass_spring_blocks.blocks"),
    ("kernels/gather_blocks.cu", "GatherBlocks", "gather_blocks.gather"),
    ("kernels/rotate_blocks.cu", "RotateBlocks", "rotate_blocks.rotate_blocks"),
]


@pytest.mark.slow
@pytest.mark.parametrize(("real", "local"), [("double", "double"), ("double", "float"), ("float", "float")])
@pytest.mark.parametrize(
    "group",
    [NODES, OTHER_SCHEME, BLOCKS, ELEMENTS, LAW_ELEMENTS, LAW_PATCHES, CELLS, CELL_ELEMENTS, CELL_NODES, CELL_BLOCKS],
    ids=[
        "nodes",
        "other scheme",
        "blocks",
        "elements",
        "laws",
        "their patches",
        "cells",
        "their elements",
        "their nodes",
        "their blocks",
    ],
)
def test_launches_put_together_compile_in_every_precision(group, real, local, tmp_path, monkeypatch):
    """With rows in registers, and one argument for each array whatever launches have it."""
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    launches = [_launch(*given) for given in group]
    for launch, (path, struct, *_) in zip(launches, group, strict=True):
        launch.fields = members_of(backend.read_text(path)[1], struct, {"real": real, "local": local})
    ((together, private),) = kernels(launches, monkeypatch)
    assert together == launches
    shape = kernel_fusion.BlockShape(64, 4)
    made = kernel_fusion.FusedSource(launches, shape, None, private)  # type: ignore[arg-type]
    assert private or group in (ELEMENTS, LAW_ELEMENTS, LAW_PATCHES, CELLS, CELL_ELEMENTS)
    assert made.source.count("[3];") >= len(private)
    text = tmp_path / "together.cu"
    text.write_text(made.source)
    options = ["-arch=sm_90", "-std=c++17", f"-Dreal={real}", f"-Dlocal={local}", f"-I{backend.INCLUDE}"]
    code, said = nvrtc.compiled(library, text, options)
    assert len(code) > 1000 and not said, said


@pytest.mark.parametrize("group", [OTHER_SCHEME, BLOCKS], ids=["nodes", "blocks"])
def test_what_lets_further_linearizations_return_comes_in_front_and_changes_nothing_else(group, tmp_path, monkeypatch):
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    launches = [_launch(*given) for given in group]
    ((_, private),) = kernels(launches, monkeypatch)
    plain, guarded = (
        kernel_fusion.FusedSource(launches, kernel_fusion.BlockShape(64, 4), None, private, guard)  # type: ignore[arg-type]
        for guard in (None, kernel_fusion.PhaseGuard(64, 128, 192))
    )
    before, after = (made.source.split("fused(int n")[1].splitlines()[1:] for made in (plain, guarded))
    added = [k for k, line in enumerate(after) if line not in before]
    assert any("return" in after[k] for k in added)
    assert [line for k, line in enumerate(after) if k not in added] == before, "nothing else is changed"
    assert max(added) < next(k for k, line in enumerate(after) if "::" in line), "before anything of a launch"
    assert guarded.values == [64, 128, 192, *plain.values]
    text = tmp_path / "guarded.cu"
    text.write_text(guarded.source)
    options = ["-arch=sm_90", "-std=c++17", "-Dreal=double", "-Dlocal=double", f"-I{backend.INCLUDE}"]
    code, said = nvrtc.compiled(library, text, options)
    assert len(code) > 1000 and not said, said


def test_elements_of_effects_of_different_numbers_are_not_put_together(monkeypatch):
    def launch(domain: str, items: int, mailed: bool = False) -> SimpleNamespace:
        text = f"struct Items {{\n    int n;  // {domain}\n}};"
        return SimpleNamespace(text=text, struct="Items", domain=domain, items=items, mailed=mailed, fields=[])

    tetrahedra, springs, also = launch("elements", 6), launch("elements", 19), launch("elements", 6)
    start, touch = launch("nodes", 5), launch("nodes", 2, mailed=True)
    found = kernels([tetrahedra, springs, also, start, touch], monkeypatch)
    assert [together for together, _ in found] == [[tetrahedra, also], [springs], [start, touch]]
