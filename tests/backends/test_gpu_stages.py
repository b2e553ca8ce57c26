# SPDX-License-Identifier: MIT
"""Decisions of the Rosenbrock-W step on a GPU, made by threads of the processor."""

import ctypes as c
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from sim_server.backends.compiler import INCLUDE, SOURCES, compiler
from sim_server.backends.gpu.rosenbrock import DECISION, EULER, FACTOR, ITERATE, STAGE_DECISION
from sim_server.backends.gpu.solver import PCG_BODY
from sim_server.backends.gpu.structs import STAGE_RESULT, STAGE_STATE
from sim_server.backends.kinds import Kind

BLOCK = 32  # items of a thread block
PATIENCE, INCONSISTENT = DECISION.constant("PATIENCE"), DECISION.constant("INCONSISTENT")
OPEN, MADE = DECISION.enumeration("StepPhase").values()
TEXT = """
#define BLOCK_ITEMS 32
#include "cuda_threads.h"
#include "stage_decision.cu"
extern "C" void decide_all(int blocks, const StageDecision* t) { launch(blocks, BLOCK_ITEMS, [&] { decide(*t); }); }
extern "C" int may_use(const StageState* s, const PcgBody* body) { return may_use_factor(*s, *body); }
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    folder = tmp_path_factory.mktemp("stages")
    (folder / "clock.cuh").write_text("#pragma once\nstatic long long nanoseconds() { return 77; }\n")
    (folder / "stages.cpp").write_text(TEXT)
    paths = [f"-I{p}" for p in (folder, Path(__file__).parent, SOURCES / "backends/gpu", INCLUDE)]
    command = [compiler(), "-std=c++17", "-O1", "-shared", "-fPIC", "-pthread", "-Dreal=double", *paths]
    subprocess.run([*command, str(folder / "stages.cpp"), "-o", str(folder / "stages.so")], check=True)
    return c.CDLL(str(folder / "stages.so"))


class Bodies:
    """So many nodes each, with a factor of step 4, after an attempt in step 9. size: of the estimates of each body."""

    def __init__(self, sizes: list[int], estimates: list[float], bound: float = 1.0):
        count, nodes = len(sizes), sum(sizes)
        self.sizes, self.body = sizes, np.repeat(np.arange(count, dtype=np.int32), sizes)
        self.estimate = np.random.default_rng(0).uniform(0.1, 0.9, nodes) * np.repeat(estimates, sizes)
        self.estimate[np.cumsum(sizes) - 1] = estimates
        self.state = np.zeros(count, STAGE_STATE)
        self.state["form"], self.state["factor_step"], self.state["spring_step"] = FACTOR, 4, -1
        self.rows = np.zeros(count, PCG_BODY)
        self.rows["plan"], self.rows["factor_step"], self.rows["kind"] = 1, 4, Kind.CHOLESKY
        self.phase, self.largest, self.bound = (
            np.full(count, OPEN, np.int32),
            np.zeros(count, "i8"),
            np.full(count, bound),
        )
        self.moving, self.left, self.finished = np.ones(count, np.int32), np.zeros(1, np.int32), np.zeros(1, "u4")
        self.results, self.step, self.clock = np.zeros((16, count), STAGE_RESULT), np.full(1, 9, "i8"), np.zeros(1)
        self.stamps, self.counters = np.zeros((16, 2), "i8"), np.full(5, 3, "u4")
        self.begun = np.zeros(1, "i8")
        self.params = np.zeros((), STAGE_DECISION)
        for name in ("state", "phase", "largest", "bound", "rows", "estimate", "body", "results", "left"):
            self.params[name] = getattr(self, name).ctypes.data
        end: Any = self.params["end"]
        for name, array in {
            "clock": self.clock, "step": self.step, "pool_counters": self.counters, "finished_blocks": self.finished,
            "timestamps": self.stamps, "moving": self.moving, "begun": self.begun,
        }.items():  # fmt: skip
            end[name] = array.ctypes.data
        end["dt"], end["counters"], end["capacity"], end["bodies"] = 0.5, 5, 16, count

    def decide(self, library: c.CDLL, attempt: int) -> None:
        self.params["attempt"], self.params["nodes"] = attempt, len(self.body)
        library.decide_all(-(-len(self.body) // BLOCK), c.c_void_p(self.params.ctypes.data))
        assert self.finished[0] == 0 and not self.largest.any()

    @property
    def ended(self) -> bool:
        """True if the step has ended; then nothing is left of it."""
        if self.step[0] == 9:
            assert not self.stamps.any() and (self.counters == 3).all()
            return False
        assert (
            self.step[0] == 10
            and self.clock[0] == 5.0
            and self.stamps[9, 1] == self.stamps[10, 0] == self.begun[0] == 77
        )
        assert not self.counters.any() and not self.moving.any() and (self.phase == OPEN).all() and self.left[0] == 0
        assert (self.state["form"] == ITERATE).all()
        return True


@pytest.mark.parametrize("sizes", [[5], [32], [100], [70, 3, 1, 64, 20]])
def test_a_step_that_does_ends_with_the_largest_estimate_of_each_body(library, sizes):
    bodies = Bodies(sizes, [0.1 * (k + 1) for k in range(len(sizes))])
    bodies.decide(library, FACTOR)
    assert bodies.ended and (bodies.results[9]["form"] == FACTOR).all()
    assert bodies.results[9]["estimate"].tolist() == [0.1 * (k + 1) for k in range(len(sizes))]


def test_each_body_goes_back_by_itself(library):
    bodies = Bodies([40, 40, 40, 40], [0.5, 2.0, np.nan, 3.0])
    bodies.decide(library, FACTOR)
    assert not bodies.ended and bodies.left[0] == 3 and bodies.phase.tolist() == [MADE, OPEN, OPEN, OPEN]
    assert (bodies.state["form"][1:] == ITERATE).all() and bodies.state["patience"].tolist() == [0, *[PATIENCE] * 3]
    bodies.estimate[40:120] = 0.4
    bodies.decide(library, ITERATE)
    assert not bodies.ended and bodies.left[0] == 1 and bodies.phase.tolist() == [MADE, MADE, MADE, OPEN]
    bodies.decide(library, EULER)
    assert bodies.ended and bodies.results[9]["form"].tolist() == [FACTOR, ITERATE, ITERATE, EULER]
    assert bodies.results[9]["estimate"].tolist() == [0.5, 0.4, 0.4, 3.0]
    assert bodies.state["patience"].tolist() == [0, PATIENCE, PATIENCE, PATIENCE]


def test_a_body_that_had_to_iterate_has_not_made_the_first_attempt(library):
    bodies = Bodies([10, 10], [0.0, 0.0])
    bodies.state["form"][0], bodies.state["patience"][0] = ITERATE, 2
    bodies.decide(library, FACTOR)
    assert not bodies.ended and bodies.phase.tolist() == [OPEN, MADE] and bodies.state["patience"].tolist() == [1, 0]


def test_a_body_at_rest_is_done_whatever_its_form(library):
    bodies = Bodies([10, 10], [0.0, 0.0])
    bodies.state["form"][0], bodies.moving[:] = ITERATE, 0
    bodies.decide(library, FACTOR)
    assert bodies.ended and bodies.results[9]["form"].tolist() == [ITERATE, FACTOR]


def test_a_factor_that_the_forces_contradict_is_not_used(library):
    bodies = Bodies([10, 10, 10], [0.1, 0.1, 0.1])
    bodies.state["inconsistency"] = [0.9 * INCONSISTENT, 1.1 * INCONSISTENT, np.nan]
    bodies.decide(library, FACTOR)
    assert bodies.phase.tolist() == [MADE, OPEN, OPEN] and bodies.state["patience"].tolist() == [0, PATIENCE, PATIENCE]


def test_when_a_factor_may_stand_alone(library):
    bodies = Bodies([1], [0.0])

    def may(**changes: Any) -> bool:
        state, row = bodies.state.copy(), bodies.rows.copy()
        for name, value in changes.items():
            (row if name in ("plan", "kind") else state)[name] = value
        return bool(library.may_use(c.c_void_p(state.ctypes.data), c.c_void_p(row.ctypes.data)))

    assert may() and not may(plan=0) and not may(kind=Kind.BLOCK_JACOBI)
    assert not may(patience=1) and may(patience=1, factor_step=3), "a new factor has its own chance"
    assert may(spring_step=3) and not may(spring_step=4) and not may(spring_step=7), (
        "it may know a spring that has gone"
    )


def test_springs_of_a_step_are_remembered(library):
    bodies = Bodies([10, 10], [0.1, 0.1])
    bodies.state["springs"][1], bodies.state["form"][1] = 1, ITERATE
    bodies.decide(library, FACTOR)
    assert bodies.state["spring_step"].tolist() == [-1, 9] and not bodies.state["springs"].any()
