# SPDX-License-Identifier: MIT
"""Solves that go on with a smoothed factor where it is too old (smoothing_state.cuh): which scenes, and their state."""

from dataclasses import replace
from functools import partial

import numpy as np

from sim_server.backends.base import EngineInput
from sim_server.backends.gpu.cupy_types import DeviceArray
from sim_server.backends.gpu.device import Gpu
from sim_server.backends.gpu.state import device_arrays
from sim_server.backends.state import StateArray

LEAST_NODES = 4000
"""Of a body: an iteration of smaller ones is mostly latency, of which a smoothed one has twice as much, and their steps
are so short that an empty launch counts."""


class FactorSmoothing:
    """What solves leave to those that follow.

    memory: on the device, by name: slow (bodies,) with which factor a solve was slow last, and how slow (`slow_after`),
        largest (bodies,) eigenvalue that a smoothing is made for, 0 until one was estimated, unfinished (1,) step of
        the last solve that went on smoothed
    """

    def __init__(self, gpu: Gpu, bodies: int):
        new = partial(np.full, fill_value=-1, dtype=np.int64)
        self.memory: dict[str, DeviceArray] = {
            "slow": gpu.cp.asarray(new(bodies)),
            "largest": gpu.cp.asarray(np.zeros(bodies)),
            "unfinished": gpu.cp.asarray(new(1)),
        }

    def state(self) -> list[StateArray]:
        """Returns what a run that goes on needs."""
        found = device_arrays("engine.smoothing", self.memory, "slow", "largest")
        return [replace(array, added=True) for array in found]

    @classmethod
    def wanted(cls, gpu: Gpu, given: EngineInput) -> "FactorSmoothing | None":
        """Returns that of a scene with large bodies, on one GPU, whose steps are one plain solve each."""
        solver = given.solver
        others = (given.newton, given.stages, given.substeps, given.contact, given.cut)
        budgets = solver.budget or solver.step_budget
        if not solver.wants_factors or given.errors or budgets or any(part is not None for part in others):
            return None
        if solver.gpus > 1 or max(last - first for first, last in given.ranges) < LEAST_NODES:
            return None
        return cls(gpu, len(given.ranges))
