# SPDX-License-Identifier: MIT
"""Holders with Newton-Raphson on a GPU: its kernels, run by threads of the processor, beside the loop of the CPU."""

import ctypes as c
from typing import Any

import numpy as np
import pytest

from sim_server.backends.gpu import kernel_fusion
from tests.backends import fake_cupy
from tests.backends.newton_on_threads import OnThreads, compiled
from tests.holders.holder_scenes import held_bar, left, right
from tests.support import nvrtc

MOTION = [{"time": 0.0}, {"time": 0.2, "translate": [0.1, 0.2, 0], "rotate": [0, 40, 90]}]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> c.CDLL:
    return compiled(tmp_path_factory.mktemp("newton"))


@pytest.mark.parametrize("scheme", ["backward_euler", "newmark", "bdf2", "generalized_alpha", "quasi_static"])
def test_steps_and_forces_are_those_of_the_cpu(library, monkeypatch, scheme):
    keys: dict[str, Any] = {
        "integrator": {"scheme": scheme, "linearizations": 12, "tolerance": 1e-10},
        "gravity": (0, -9.81, 0), "damping": (0.2, 0.01), "cells": (4, 1, 2), "solver": {"tolerance": 1e-13},
    }  # fmt: skip
    cpu, beside = (held_bar(left(), right(keyframes=MOTION), **keys) for _ in range(2))
    kernels, largest = OnThreads(library, beside, monkeypatch), 0.0
    for number in range(5):
        result = kernels.step(number)
        cpu.engine.run(1)
        record = cpu.engine.records()[0]
        assert result["linearizations"][0] == record["linearizations"] > 1
        np.testing.assert_allclose(beside.world.x, cpu.world.x, atol=1e-9)
        np.testing.assert_allclose(beside.world.v, cpu.world.v, atol=1e-7)
        largest = max(largest, float(np.abs(cpu.world.reaction).max()))
        np.testing.assert_allclose(beside.world.reaction, cpu.world.reaction, atol=1e-6 * largest)
    assert largest > 0


def test_later_assemblies_leave_what_the_forces_are_made_of(tmp_path, monkeypatch):
    """The right-hand side at held nodes of the last one: no array that stays in registers. Without holders it may."""
    monkeypatch.setattr(nvrtc, "compiled", lambda *_: (b"code", ""))
    asked, fused = [], kernel_fusion.FusedSource

    def source(launches: Any, shape: Any, epilogue: Any, private: frozenset[int], guard: Any, *rest: Any) -> Any:
        if guard:
            asked.append(private)
        return fused(launches, shape, epilogue, private, guard, *rest)

    monkeypatch.setattr(kernel_fusion, "FusedSource", source)
    newton = {"scheme": "newmark", "linearizations": 3}
    with fake_cupy.installed(tmp_path, None, monkeypatch):
        for holders, kept in (((left(),), False), ((), True)):
            asked.clear()
            sim = held_bar(*holders, integrator=newton, device="gpu", **({} if holders else {"fixed": "X < 0.01"}))
            b = int(sim.engine.gpu.twin(sim.system.b).data.ptr)
            assert asked and any(b in private for private in asked) == kept
