# SPDX-License-Identifier: MIT
"""The structs of the GPU solver stand twice, in C and in NumPy: same names, same order, same sizes."""

import re

import numpy as np
import pytest

from sim_server.backends.compiler import SOURCES
from sim_server.backends.cpu.structs import BALANCE
from sim_server.backends.gpu.device import PRECISIONS, own_headers
from sim_server.backends.gpu.device import options as device_options
from sim_server.backends.gpu.energies import ELASTIC_ENERGY, ENERGY_BALANCE, NODE_CHUNK, SUMS
from sim_server.backends.gpu.inverse.device_plan import DEVICE_PLAN
from sim_server.backends.gpu.newton import (
    BLOCK_NODES,
    LANES,
    NEWTON_ARGUMENTS,
    NODE_RANGE,
    SEARCH,
    bodies_of,
    node_ranges,
)
from sim_server.backends.gpu.row_partition import ROW_RANGE
from sim_server.backends.gpu.solver import PCG_ARGUMENTS, PCG_BODY, PCG_RESULT, threads_and_blocks
from sim_server.backends.gpu.structs import ENERGY_RECORD, NEWTON_RESULT
from tests.support import nvrtc

SIZES = {"int": 4, "unsigned": 4, "float": 4, "double": 8, "long long": 8}
TEXTS = "".join(
    (SOURCES / name).read_text()
    for name in ("backends/gpu/pcg_structs.cuh", "backends/gpu/newton.cu", "kernels/newton_line_search.cuh")
)


def fields(name: str) -> list[tuple[str, int]]:
    """Names and bytes of a struct's fields, pointers 8."""
    body = re.search(rf"struct (?:__align__\(\d+\) )?{name} \{{(.*?)\}};", TEXTS, re.DOTALL)
    assert body, name
    found = []
    for line in re.sub(r"//.*", "", body[1]).split(";"):
        declaration = re.match(r"\s*(?:const )?(long long|struct \w+|[\w<>]+)(\s*\*?)\s*(.*)", line.strip(), re.DOTALL)
        if not line.strip():
            continue
        assert declaration, line
        kind, star, names = declaration.groups()
        for each in re.split(r",\s*", names):
            pointer = "*" in star or each.startswith("*")
            found.append((each.strip("* "), 8 if pointer else SIZES[kind]))
    return found


@pytest.mark.parametrize(
    ("name", "layout"),
    [
        ("DevicePlan", DEVICE_PLAN), ("PcgBody", PCG_BODY), ("PcgResult", PCG_RESULT), ("PcgArguments", PCG_ARGUMENTS),
        ("RowRange", ROW_RANGE), ("NodeRange", NODE_RANGE),
        ("NewtonResult", NEWTON_RESULT), ("Search", SEARCH), ("NewtonArguments", NEWTON_ARGUMENTS),
    ],
)  # fmt: skip
def test_both_sides_agree(name: str, layout: np.dtype) -> None:
    assert layout.names is not None
    ours = [(n, layout[n].itemsize) for n in layout.names]
    assert fields(name) == ours


@pytest.mark.slow
@pytest.mark.parametrize(
    ("threads", "blocks", "more"), [(256, 1, []), (128, 2, []), (64, 4, []), (64, 4, ["-DNEWTON_PHASES"])]
)
def test_the_solver_spills_no_registers(threads, blocks, more):
    """What does not fit into registers would cost a trip through L2 in each phase: it did, and doubled the time."""
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    options = [*device_options(PRECISIONS["float64"]), *own_headers(), "--ptxas-options=-v"]
    options += [f"-DTHREADS={threads}", f"-DPER_PROCESSOR={blocks}", "-arch=sm_90", *more]
    code, said = nvrtc.compiled(library, SOURCES / "backends/gpu/pcg.cu", options)
    spilled = [int(n) for n in re.findall(r"(\d+) bytes (?:stack frame|spill stores|spill loads)", said)]
    assert code and spilled and max(spilled) <= 32, said


def test_thread_blocks_take_all_registers():
    """256 threads a multiprocessor: in more blocks where there are more bodies, in most where these are small."""
    found = {
        (bodies, nodes): threads_and_blocks(np.full(bodies, nodes), 132)
        for bodies, nodes in (
            (1, 720),
            (124, 720),
            (125, 720),
            (264, 160),
            (265, 160),
            (400, 720),
            (1000, 299),
            (1000, 300),
        )
    }
    assert {pair for (bodies, _), pair in found.items() if bodies <= 124} == {(256, 1)}
    assert {key for key, pair in found.items() if pair == (128, 2)} == {(125, 720), (264, 160), (400, 720), (1000, 300)}
    assert {key for key, pair in found.items() if pair == (64, 4)} == {(265, 160), (1000, 299)}


@pytest.mark.slow
@pytest.mark.parametrize("arch", ["sm_80", "sm_90"])
@pytest.mark.parametrize("precision", PRECISIONS)
def test_the_search_compiles_with_the_layouts_of_this_side_and_spills_no_registers(precision, arch):
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    sizes = {
        "NEWTON_ARGUMENTS": NEWTON_ARGUMENTS,
        "SEARCH": SEARCH,
        "NODE_RANGE": NODE_RANGE,
        "NEWTON_RESULT": NEWTON_RESULT,
    }
    options = [
        *device_options(PRECISIONS[precision]),
        *own_headers(),
        "--ptxas-options=-v",
        f"-arch={arch}",
    ]
    options += [f"-D{name}_BYTES={layout.itemsize}" for name, layout in sizes.items()]
    code, said = nvrtc.compiled(library, SOURCES / "backends/gpu/newton.cu", options)
    spilled = [int(n) for n in re.findall(r"(\d+) bytes (?:stack frame|spill stores|spill loads)", said)]
    assert code and len(spilled) >= 12 and max(spilled) == 0, said


@pytest.mark.parametrize("precision", PRECISIONS)
def test_the_account_of_energy_compiles_with_the_layouts_of_this_side(precision, tmp_path):
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    sizes = {
        "ENERGY_BALANCE": ENERGY_BALANCE,
        "BALANCE": BALANCE,
        "ENERGY_RECORD": ENERGY_RECORD,
        "ELASTIC_ENERGY": ELASTIC_ENERGY,
    }
    options = [*device_options(PRECISIONS[precision]), *own_headers(), "-arch=sm_90"]
    options += [f"-D{name}_BYTES={layout.itemsize}" for name, layout in sizes.items()]
    options += [f"-DNODE_CHUNK_BYTES={NODE_CHUNK.itemsize}", f"-DSUMS_BYTES={8 * SUMS}"]
    for name in ("energy_balance", "elastic_energy"):
        code, said = nvrtc.compiled(library, SOURCES / f"backends/gpu/{name}.cu", options)
        assert code and not said, said


def test_the_nodes_of_a_body_are_shared_out_in_stretches():
    text = (SOURCES / "backends/gpu/newton.cu").read_text()
    assert f"BLOCK_NODES = {BLOCK_NODES}, LANES = {LANES}," in text
    found, start = node_ranges(np.array([[0, 1], [1, 1 + 2 * BLOCK_NODES], [1 + 2 * BLOCK_NODES, 5 + 3 * BLOCK_NODES]]))
    assert start.tolist() == [0, 1, 3, 5]
    assert found["body"].tolist() == [0, 1, 1, 2, 2]
    nodes = [n for row in found for n in range(row["first"], row["last"])]
    assert nodes == list(range(5 + 3 * BLOCK_NODES)) and (found["last"] - found["first"]).max() == BLOCK_NODES


def test_the_body_of_each_item_is_known_where_all_launches_agree():
    start = np.array([0, 2, 2, 5], np.int32)
    found = bodies_of([start, start.copy()])
    assert found is not None and found.tolist() == [0, 0, 2, 2, 2] and found.dtype == np.int32
    assert bodies_of([start, None]) is None and bodies_of([start, start + 0 * start + [0, 1, 0, 0]]) is None
    assert bodies_of([]) is None and bodies_of([np.zeros(3, np.int32)]) is None
