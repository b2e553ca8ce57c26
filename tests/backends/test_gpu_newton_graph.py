# SPDX-License-Identifier: MIT
"""Linearizations and trials as the graph of a step has them: a loop, launch by launch beside the unrolled form."""

import ctypes as c
import re
from collections.abc import Iterator
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import pytest

from sim_server.backends.gpu.cuda import CudaDevice
from sim_server.backends.gpu.step_graphs import FEW
from sim_server.errors import DeviceError, InputError
from sim_server.scene.integrator_options import MAX_STATES
from sim_server.simulation import Simulation
from tests.backends import fake_cupy
from tests.scenes import bar, scene
from tests.support import nvrtc

BARS = [bar((2, 1, 1), name="held", fixed="X < 0.01", touch={"max_force": 9.0}), bar((3, 1, 1), name="free")]
TRIAL = ["pcg", "update_state", "elements", "nodes", "accept_trial"]


@pytest.fixture
def cupy(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    monkeypatch.setattr(nvrtc, "compiled", lambda *_: (b"code", ""))
    with fake_cupy.installed(tmp_path, None, monkeypatch) as fake:
        yield fake


def simulation(monkeypatch: pytest.MonkeyPatch, loops: bool, **options: Any) -> Simulation:
    monkeypatch.setattr(fake_cupy.Device, "has_conditions", loops)
    return Simulation(scene(*BARS, dt=0.02, integrator=options), "gpu")


def decide(cupy: ModuleType, needed: int) -> None:
    """Stands for the decisions of a step that needs so many trials."""
    left = [needed]

    def accept_trial(arguments: Any, loop: Any) -> None:
        left[0] -= 1
        if left[0] == 0:
            fake_cupy.end_search(arguments, loop)
        elif loop:
            fake_cupy.go_on(loop, True)

    def finish_step(*arguments: Any) -> None:
        ended = arguments[-1]
        c.c_int32.from_address(int(ended["active"])).value = int(ended["count"])
        left[0] = needed

    cupy.kernels.update(accept_trial=accept_trial, finish_step=finish_step)


def made(cupy: ModuleType, sim: Simulation) -> list[tuple[Any, ...]]:
    """Makes a step; returns what was launched after its first assembly."""
    sim.engine.assemble()
    cupy.ran.clear()
    sim.engine.solve()
    return list(cupy.ran)


def name(launch: tuple[Any, ...]) -> str:
    """Kernel, or the domain of a fused one."""
    kernel, text = launch[:2]
    if kernel != "fused":
        return kernel
    return "end" if "finish_step" in text else re.findall(r"\bint n; +// (\w+)", text)[0]


def comparable(launches: list[tuple[Any, ...]]) -> list[tuple[Any, ...]]:
    """With addresses and other large numbers in the order of their first appearance, since those of two scenes
    differ. Addresses may be below 2^32, as those of the heap of Debian's Python are."""
    known: dict[int, int] = {}

    def numbers(argument: np.ndarray) -> list[Any]:
        if argument.dtype.names:  # and not what lies between its members
            return [x for name in argument.dtype.names for x in numbers(argument[name])]
        found = argument.view(np.uint64) if argument.itemsize == 8 else argument
        return [known.setdefault(x, len(known)) if x >> 20 else x for x in found.ravel().tolist()]

    told = ("update_state", "accept_trial")  # whose last argument is the loop
    given = [launch[4][:-1] if launch[0] in told else launch[4] for launch in launches]
    return [(*launch[:4], [numbers(x) for x in kept]) for launch, kept in zip(launches, given, strict=True)]


@pytest.mark.parametrize("scheme", ["backward_euler", "bdf2"])
def test_a_loop_makes_the_launches_of_the_unrolled_form_that_do_anything(cupy, monkeypatch, scheme):
    options: dict[str, Any] = {"linearizations": 3, "trials": 2, "scheme": scheme}
    sims = [simulation(monkeypatch, loops, **options) for loops in (True, False)]
    for needed in (1, 2, 5, 9):
        decide(cupy, needed)
        looped, unrolled = (made(cupy, sim) for sim in sims)
        names = [name(launch) for launch in looped]
        later = ["blocks", *TRIAL]
        assert names == [*TRIAL, *later * (needed - 1), "end"], names
        others = [name(launch) for launch in unrolled]
        assert others == [*TRIAL, *later * 8, "end"]
        last = [k for k, found in enumerate(others) if found == "accept_trial"][needed - 1]
        effective = unrolled[: last + 1] + unrolled[others.index("end") :]
        assert comparable(effective) == comparable(looped)


def test_later_linearizations_have_a_matrix_of_their_own(cupy, monkeypatch):
    """That of the first one stays, for factors; no launch copies it."""
    sim = simulation(monkeypatch, True, linearizations=3, trials=2)
    decide(cupy, 3)
    first = int(sim.engine.gpu.twin(sim.system.values).data.ptr)
    assert sim.engine.loop.values == first
    launches = made(cupy, sim)
    of = {kernel: [int(x[4][0]["values"]) for x in launches if x[0] == kernel] for kernel in ("pcg", "update_state")}
    for found in of.values():
        assert found[0] == first and len(set(found[1:])) == 1 and found[1] != first, found
    assert of["pcg"] == of["update_state"]
    later = of["pcg"][1]
    for launch in launches:
        if name(launch) in ("nodes", "blocks"):
            addresses = [int(x) for x in launch[4] if x.dtype == np.uint64]
            assert later in addresses and first not in addresses
            needed = "== 0))" if name(launch) == "blocks" else "!= 2))"  # solved next; not done
            assert f"phase[body[block * BLOCK_ITEMS + threadIdx.x]] {needed} return;" in launch[1]


def test_the_search_begins_beside_the_first_blocks_and_ends_where_the_state_advances(cupy, monkeypatch):
    sim = simulation(monkeypatch, True, linearizations=3, scheme="bdf2")
    sim.engine.assemble()
    begins = [(name(x), x) for x in cupy.ran if x[0] == "fused" and "begin_beside(prologue" in x[1]]
    assert [domain for domain, _ in begins] == ["blocks"]
    cupy.ran.clear()
    sim.engine.solve()
    ends = [x for x in cupy.ran if name(x) == "end"]
    assert begins[0][1][4][-1].tobytes() == ends[0][4][-1].tobytes()  # with the same arguments
    lines = [line.strip() for line in ends[0][1].splitlines()]
    items = lines.index("if (threadIdx.x < BLOCK_ITEMS && i < n) {")
    assert lines.index("end_within(opened);") < items and lines[items + 1] == "end_item(opened, i);"


def test_one_linearization_has_the_launches_of_a_solve_alone(cupy, monkeypatch):
    sim = simulation(monkeypatch, True)
    assert [name(launch) for launch in made(cupy, sim)] == ["pcg", "end"]
    cupy.ran.clear()
    sim.engine.assemble()
    assert [name(x) for x in cupy.ran if x[0] != "stamp_begin"] == ["elements", "nodes", "blocks"]


@pytest.mark.parametrize("loops", [True, False])
def test_how_many_trials_there_may_be(cupy, monkeypatch, loops):
    """A loop has as many as a step needs; without it they bound the graph of a step, and that of many steps."""
    few, more = (simulation(monkeypatch, loops, linearizations=n, trials=0) for n in (FEW, FEW + 1))
    assert [[bool(graph) for graph in row] for row in few.engine.loop.graphs] == [[True, True, True]] * 2
    assert [[bool(graph) for graph in row] for row in more.engine.loop.graphs] == [[True, loops, loops]] * 2
    most = {"linearizations": MAX_STATES // 4, "trials": 4}
    if loops:
        assert simulation(monkeypatch, loops, **most).engine.loop.graphs[0][1]
        return
    words = rf"linearizations = 256 with trials = 4: .* 1280, .* CUDA 12.4; allowed: .* up to {MAX_STATES}"
    with pytest.raises(InputError, match=words):
        simulation(monkeypatch, loops, **most)


def test_a_driver_without_conditional_nodes_has_no_loops():
    class OldDevice(CudaDevice):
        def __init__(self) -> None:
            self.cp, self.context, self._driver = None, 0, SimpleNamespace(cuGraphAddNode=None)

    old = OldDevice()
    assert old.has_conditions is False
    with pytest.raises(DeviceError, match=r"too old .* cuStreamGetCaptureInfo_v2; CUDA 12.4 or above has it"):
        old.repeat(np.ones(1, np.int32))
