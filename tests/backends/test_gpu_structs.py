# SPDX-License-Identifier: MIT
"""Structs of the GPU loop and of its kernels as Python has read them, against both compilers; shapes of launches."""

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from sim_server.backends.compiler import INCLUDE, SOURCES, compiler
from sim_server.backends.declarations import Declarations
from sim_server.backends.gpu import structs
from sim_server.backends.gpu.conditions import LINKED
from sim_server.backends.gpu.contact import TEXT as CONTACT_TEXT
from sim_server.backends.gpu.device import PRECISIONS, own_headers
from sim_server.backends.gpu.device import options as device_options
from sim_server.backends.gpu.energies import BALANCE_TEXT, ELASTIC_TEXT
from sim_server.backends.gpu.inverse.apply_inverse import APPLICATION
from sim_server.backends.gpu.inverse.expansion_batches import INVERSE
from sim_server.backends.gpu.measured import TEXT as MEASURED_TEXT
from sim_server.backends.gpu.momentum import MOMENTUM
from sim_server.backends.gpu.newton import BLOCK_NODES, NEWTON, bodies_of, node_ranges
from sim_server.backends.gpu.rosenbrock import DECISION
from sim_server.backends.gpu.solver_layout import (
    DECLARED,
    DECLARED_CORRECTED,
    DECLARED_WARPS,
    threads_alone,
    threads_and_blocks,
)
from sim_server.backends.gpu.step_sequence import EPILOGUE
from sim_server.backends.gpu.structs import PCG
from tests.support import nvrtc


def asserted(tmp_path: Path, include: str, *declarations: Declarations) -> Path:
    """A text that includes another and holds what Python assumes of its structs."""
    path = tmp_path / "asserted.cu"
    path.write_text(f'#include "{include}"\n' + "".join(d.assertions() for d in declarations))
    return path


def test_the_compiler_agrees_with_all_that_the_loop_shares(tmp_path):
    source = asserted(tmp_path, "backends/gpu/loop.h", structs.LOOP)
    results = structs.LOOP.assertions("PcgResult", "NewtonResult", "ContactResult", "StepTimestamp")
    source.write_text(source.read_text() + results)
    assert "GpuLoop.frame_copies" in source.read_text()
    command = [compiler(), "-std=c++17", "-fsyntax-only", "-x", "c++", f"-I{SOURCES}", f"-I{INCLUDE}", str(source)]
    assert subprocess.run(command, capture_output=True, text=True).stderr == ""


@pytest.mark.parametrize(
    ("text", "declarations"),
    [
        ("pcg_structs.cuh", PCG), ("newton.cu", NEWTON), ("energy_balance.cu", BALANCE_TEXT),
        ("elastic_energy.cu", ELASTIC_TEXT), ("step_epilogue.cu", EPILOGUE), ("stages.cuh", structs.STAGES),
        ("stage_decision.cu", DECISION), ("momentum.cu", MOMENTUM),
        ("contact_state.cuh", structs.CONTACT), ("contact.cu", CONTACT_TEXT),
        ("measured.cu", MEASURED_TEXT), ("step_records.cu", structs.RECORDS), ("copy_list.cu", structs.COPIES),
        ("inverse/build_inverse.cu", INVERSE), ("inverse/apply_inverse.cu", APPLICATION),
    ],
    ids=lambda value: value if isinstance(value, str) else "layouts",
)  # fmt: skip
def test_the_compiler_for_gpus_agrees(text: str, declarations: Declarations, tmp_path: Path) -> None:
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    source = asserted(tmp_path, text, declarations)
    options = [
        *device_options(PRECISIONS["float64"]),
        *own_headers(),
        "-arch=sm_90",
        "--Ofast-compile=max",
        "-DBLOCK_ITEMS=32",
    ]
    code, said = nvrtc.compiled(library, source, options)
    assert code and not said and "static_assert" in source.read_text(), said


def test_the_compiler_for_gpus_refuses_another_layout(tmp_path):
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    source = asserted(tmp_path, "pcg_structs.cuh", PCG)
    source.write_text(source.read_text().replace("sizeof(PcgBody::planes) == 4", "sizeof(PcgBody::planes) == 8"))
    code, said = nvrtc.compiled(library, source, [*device_options(PRECISIONS["float64"]), *own_headers()])
    assert not code and "PcgBody.planes" in said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("threads", "blocks", "more"),
    [(256, 1, []), (128, 2, []), (64, 4, []), (64, 4, ["-DNEWTON_PHASES"]), (256, 1, ["-DSTAGES"]),
     (256, 1, ["-DCONTACT_PASSES"]), (64, 4, ["-DCONTACT_PASSES"]), (256, 1, ["-DSMOOTHED"]), (256, 1, ["-DALONE"]),
     (64, 4, ["-DALONE"])],
)  # fmt: skip
def test_the_solver_spills_no_registers(threads, blocks, more):
    """What does not fit into registers would cost a trip through L2 in each phase: it did, and doubled the time."""
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    options = [*device_options(PRECISIONS["float64"]), *own_headers(), "--ptxas-options=-v"]
    options += [f"-DTHREADS={threads}", f"-DPER_PROCESSOR={blocks}", "-arch=sm_90", *more]
    code, said = nvrtc.compiled(library, SOURCES / "backends/gpu/pcg.cu", options)
    spilled = [int(n) for n in re.findall(r"(\d+) bytes (?:stack frame|spill stores|spill loads)", said)]
    most = 96 if "-DALONE" in more else 32  # of what lives through an iteration
    assert code and spilled and max(spilled) <= most, said


@pytest.mark.slow
@pytest.mark.parametrize(
    ("threads", "features"),
    [(256, "NEWTON_PHASES ERRORS BUDGETS CUTS SPLITS"), (256, "CORRECTED NEWTON_PHASES ERRORS BUDGETS CUTS HELPED"),
     (512, "ALONE ERRORS BUDGETS"), (512, "ALONE CORRECTED CONTACT_PASSES ERRORS")],
)  # fmt: skip
def test_the_solver_declares_no_more_shared_memory_than_is_kept_for_it(threads, features):
    """Of scenes whose solves do most: a launch with more would be refused."""
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    options = [*device_options(PRECISIONS["float64"]), *own_headers(), "--ptxas-options=-v", "-arch=sm_90"]
    options += [f"-DTHREADS={threads}", "-DPER_PROCESSOR=1", *(f"-D{feature}" for feature in features.split())]
    code, said = nvrtc.compiled(library, SOURCES / "backends/gpu/pcg.cu", options)
    declared = [int(n) for n in re.findall(r"(\d+) bytes smem", said)]
    kept = DECLARED_CORRECTED if "CORRECTED" in features else DECLARED
    assert code and declared and max(declared) <= kept + (DECLARED_WARPS if threads > 256 else 0), said


def test_bodies_of_which_half_of_a_does_not_fit_get_more_warps():
    found = [threads_alone(np.full(300, n), np.full(300, 10 * n), 233472) for n in (100, 300, 380, 400, 720)]
    assert found == [256, 256, 256, 512, 512]
    assert threads_alone(np.array([720, 720, 100]), np.array([8000, 8000, 1000]), 233472) == 512, "by most of them"


def test_thread_blocks_take_all_registers():
    """256 threads a multiprocessor: in more blocks where there are more bodies, in most where these are small, unless
    fewer have A in shared memory."""
    found = {
        (bodies, nodes): threads_and_blocks(np.full(bodies, nodes), np.full(bodies, 10 * nodes), 132, 233472)
        for bodies, nodes in (
            (1, 720),
            (124, 720),
            (125, 720),
            (264, 160),
            (265, 160),
            (265, 50),
            (265, 60),
            (265, 110),
            (265, 120),
            (400, 720),
            (1000, 299),
            (1000, 300),
        )
    }
    assert {pair for (bodies, _), pair in found.items() if bodies <= 124} == {(256, 1)}
    assert {key for key, pair in found.items() if pair == (128, 2)} == {
        (125, 720), (264, 160), (400, 720), (1000, 300), (265, 60), (265, 110),
    }  # fmt: skip
    assert {key for key, pair in found.items() if pair == (64, 4)} == {
        (265, 160), (1000, 299), (265, 50), (265, 120),
    }  # fmt: skip


def test_bodies_that_exchange_nothing_have_a_multiprocessor_each():
    """Many of them; of few, as many as there are more than multiprocessors would be a round of their own."""

    def shape(bodies, nodes, exchanges):
        given = np.full(bodies, nodes), np.full(bodies, 10 * nodes), 132, 233472
        return threads_and_blocks(*given, exchanges=exchanges)

    assert shape(512, 176, False) == shape(256, 756, False) == (256, 1)
    assert shape(512, 176, True) == (64, 4) and shape(256, 756, True) == (128, 2)
    assert shape(140, 756, False) == (128, 2) and shape(512, 16, False) == (64, 4)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("text", "threads", "blocks"),
    [("apply_factor", 256, 1), ("apply_factor", 128, 2), ("apply_factor", 64, 4), ("smoothed", 256, 1)],
)
def test_the_application_of_factors_spills_no_registers(text, threads, blocks):
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    options = [*device_options(PRECISIONS["float64"]), *own_headers(), "--ptxas-options=-v", "-arch=sm_90"]
    options += [f"-DTHREADS={threads}", f"-DPER_PROCESSOR={blocks}"]
    code, said = nvrtc.compiled(library, SOURCES / f"backends/gpu/{text}.cu", options)
    spilled = [int(n) for n in re.findall(r"(\d+) bytes (?:stack frame|spill stores|spill loads)", said)]
    assert code and spilled and max(spilled) == 0, said


def test_the_condition_of_a_branch_compiles():
    """To PTX with a function that the driver has, as conditions.py compiles it."""
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    options = ["-arch=sm_80", *LINKED[1:], "-std=c++17"]
    code, said = nvrtc.compiled(library, SOURCES / "backends/gpu/set_condition.cu", options)
    assert code and not said, said


@pytest.mark.slow
@pytest.mark.parametrize("arch", ["sm_80", "sm_90"])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_the_search_compiles_and_spills_no_registers(precision, arch):
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    options = [
        *device_options(PRECISIONS[precision]),
        *own_headers(),
        "--ptxas-options=-v",
        f"-arch={arch}",
    ]
    if arch == "sm_80":  # that tells loops, as conditions.py compiles it
        options += ["-DLOOPS", *LINKED[1:]]
    code, said = nvrtc.compiled(library, SOURCES / "backends/gpu/newton.cu", options)
    spilled = [int(n) for n in re.findall(r"(\d+) bytes (?:stack frame|spill stores|spill loads)", said)]
    assert code and len(spilled) >= 12 and max(spilled) == 0, said


def test_the_nodes_of_a_body_are_shared_out_in_stretches():
    found = node_ranges(np.array([[0, 1], [1, 1 + 2 * BLOCK_NODES], [1 + 2 * BLOCK_NODES, 5 + 3 * BLOCK_NODES]]))
    assert found["body"].tolist() == [0, 1, 1, 2, 2]
    assert found["first_range"].tolist() == [0, 1, 1, 3, 3] and found["ranges"].tolist() == [1, 2, 2, 2, 2]
    nodes = [n for row in found for n in range(row["first"], row["last"])]
    assert nodes == list(range(5 + 3 * BLOCK_NODES)) and (found["last"] - found["first"]).max() == BLOCK_NODES


def test_the_body_of_each_item_is_known_where_all_launches_agree():
    start = np.array([0, 2, 2, 5], np.int32)
    found = bodies_of([start, start.copy()])
    assert found is not None and found.tolist() == [0, 0, 2, 2, 2] and found.dtype == np.int32
    assert bodies_of([start, None]) is None and bodies_of([start, start + 0 * start + [0, 1, 0, 0]]) is None
    assert bodies_of([]) is None and bodies_of([np.zeros(3, np.int32)]) is None
