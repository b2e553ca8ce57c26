# SPDX-License-Identifier: MIT
"""The structs of the GPU solver stand twice, in C and in NumPy: same names, same order, same sizes."""

import re

import numpy as np
import pytest

from sim_server.backend import HERE
from sim_server.gpu.device import PRECISIONS
from sim_server.gpu.device import options as device_options
from sim_server.gpu.planned import PLAN
from sim_server.gpu.shares import SHARE
from sim_server.gpu.solver import BODY, RESULT, SOLVE, threads_and_blocks
from tests.core import nvrtc

SIZES = {"int": 4, "unsigned": 4, "float": 4, "double": 8, "long long": 8}
TEXT = (HERE / "gpu/solve.cuh").read_text()


def fields(name: str) -> list[tuple[str, int]]:
    """Names and bytes of a struct's fields, pointers 8."""
    body = re.search(rf"struct (?:__align__\(\d+\) )?{name} \{{(.*?)\}};", TEXT, re.DOTALL)
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
    ("name", "layout"), [("Plan", PLAN), ("Body", BODY), ("Result", RESULT), ("Solve", SOLVE), ("Share", SHARE)]
)
def test_both_sides_agree(name: str, layout: np.dtype) -> None:
    assert layout.names is not None
    ours = [(n, layout[n].itemsize) for n in layout.names]
    assert fields(name) == ours


@pytest.mark.parametrize(("threads", "blocks"), [(256, 1), (128, 2), (64, 4)])
def test_the_solver_spills_no_registers(threads, blocks):
    """What does not fit into registers would cost a trip through L2 in each phase: it did, and doubled the time."""
    if (library := nvrtc.library()) is None:
        pytest.skip("needs the package nvidia-cuda-nvrtc")
    options = [*device_options(PRECISIONS["float64"]), f"-I{HERE / 'gpu'}", "--ptxas-options=-v"]
    options += [f"-DTHREADS={threads}", f"-DPER_PROCESSOR={blocks}", "-arch=sm_90"]
    code, said = nvrtc.compiled(library, HERE / "gpu/pcg.cu", options)
    spilled = [int(n) for n in re.findall(r"(\d+) bytes (?:stack frame|spill stores|spill loads)", said)]
    assert code and spilled and max(spilled) <= 32, said


def test_thread_blocks_take_all_registers():
    for bodies, nodes in ((1, 720), (400, 720), (1000, 160)):
        threads, blocks = threads_and_blocks(np.full(bodies, nodes), 132)
        assert (threads, blocks) in ((256, 1), (128, 2), (64, 4)) and threads * blocks == 256
