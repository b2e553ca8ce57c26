# SPDX-License-Identifier: MIT
"""The inputs of schemes of time integration and their memory, as the loop of a CPU reads them."""

import ctypes as c
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Int32
from sim_server.backends.central_difference import NODAL as NODAL_OF_SUBSTEPS
from sim_server.backends.central_difference import CentralDifference
from sim_server.backends.cpu import structs
from sim_server.backends.euler_form import EulerForm
from sim_server.backends.rosenbrock import NODAL, Rosenbrock
from sim_server.backends.state import StateArray, host_array, memory_of, same_body

LISTS = ("first", "again", "end")  # of launches


class NativeStages:
    """The input of the Rosenbrock-W step and its memory, attached to a loop. number: of each launch by id."""

    def __init__(self, stages: Rosenbrock, loop: structs.Loop, launches: Any, number: dict[int, int]):
        self._input = stages
        self._lists = {k: np.array([number[id(x)] for x in getattr(stages, k)], np.int32) for k in LISTS}
        self._state = (structs.StageState * loop.bodies)()
        for state in self._state:
            state.factor_step = state.euler_step = -1
        self.native = structs.Stages(
            firsts=len(stages.first), agains=len(stages.again), ends=len(stages.end), factor_alone=stages.factor_alone,
            state=c.addressof(self._state),
        )  # fmt: skip
        for name in NODAL:
            setattr(self.native, name, number[id(getattr(stages, name))])
        for name, array in self._lists.items():
            setattr(self.native, name, array.ctypes.data)
        self._first_stage = np.zeros((len(stages.mass), 9))
        self.native.first_stage = self._first_stage.ctypes.data
        for name in ("estimate", "bound", "mass", "share", "weight", "diagonal",
                     "start_x", "start_v", "b", "inertial_increment", "unheld", "held_moves"):  # fmt: skip
            setattr(self.native, name, getattr(stages, name).ctypes.data)
        loop.stages = c.addressof(self.native)
        tell_bodies_apart(stages.parts, launches, number)

    def state(self) -> list[StateArray]:
        """Returns what steps carry on."""
        return [host_array("engine.stages", memory_of(self._state, len(self._state)), same_body)]


def tell_bodies_apart(parts: Mapping[int, Int32 | None], launches: Any, number: dict[int, int]) -> None:
    """Gives launches the first item of each body. parts: by id of a launch; number: of each launch by id."""
    for key, part in parts.items():
        launches[number[key]].parts = None if part is None else part.ctypes.data


class NativeEuler:
    """The input of steps of backward Euler in a scene of another scheme, attached to a loop."""

    def __init__(self, euler: EulerForm, loop: structs.Loop, launches: Any, number: dict[int, int]):
        self._input, detect = euler, [number[id(x)] for x in euler.detect]
        self._launch = np.array([number[id(x)] for x in euler.assemble], np.int32)
        self._settle = np.array([number[id(x)] for x in euler.settle], np.int32)
        self._result = (structs.SolveResult * loop.bodies)()
        self._own: dict[str, NDArray[Any]] = {
            "end_x": np.zeros_like(euler.start_x), "takes": np.zeros(loop.bodies, np.int32),
            "assembled": np.zeros(loop.bodies, np.int32), "launch": self._launch, "settle": self._settle,
            "touching": np.zeros(loop.bodies, np.int32), "solution": np.zeros_like(euler.start_x),
        }  # fmt: skip
        self.native = structs.EulerForm(
            launches=len(self._launch), settles=len(self._settle), detect=min(detect, default=0), detects=len(detect),
            restore=number[id(euler.restore)], advance=number[id(euler.advance)],
            own_coefficients=tuple(euler.coefficients.tolist()), euler_coefficients=euler.euler_coefficients,
            result=c.addressof(self._result),
        )  # fmt: skip
        for name, array in self._own.items():
            setattr(self.native, name, array.ctypes.data)
        for name in ("coefficients", "start_x", "start_v", "before", "earlier", "diagonal", "block_scale"):
            setattr(self.native, name, getattr(euler, name).ctypes.data)
        loop.euler = c.addressof(self.native)
        tell_bodies_apart(euler.parts, launches, number)

    def state(self) -> list[StateArray]:
        """Returns what steps carry on."""
        return [
            host_array("engine.euler.touching", self._own["touching"], same_body),
            host_array("engine.euler.solution", self._own["solution"], resets=False),
        ]


class NativeSubsteps:
    """The input of explicit substeps and its memory, attached to a loop. number: of each launch by id."""

    def __init__(self, given: CentralDifference, loop: structs.Loop, number: dict[int, int]):
        self._input = given
        self._stable = np.zeros(loop.bodies, structs.STABLE_STEP)
        given.set_bodies(self._stable)
        self._result = (structs.SolveResult * loop.bodies)()
        self.native = structs.CentralDifference(
            held=given.held, stable=self._stable.ctypes.data, result=c.addressof(self._result),
            **{name: number[id(getattr(given, name))] for name in NODAL_OF_SUBSTEPS},
        )  # fmt: skip
        for name in ("substep", "shift_time", "mass", "free", "force", "kept_x", "kept_force", "mode", "failed"):
            setattr(self.native, name, getattr(given, name).ctypes.data)
        self.native.state.round = 1
        loop.substeps = c.addressof(self.native)

    def state(self) -> list[StateArray]:
        """Returns what steps carry on: the estimate of the stable substep, which no reset takes back."""
        state = np.frombuffer(self.native.state, np.uint8)
        arrays: dict[str, NDArray[Any]] = {
            "stable": self._stable.view(np.uint8),
            "state": state,
            "mode": self._input.mode,
        }
        return [host_array(f"engine.substeps.{name}", array, resets=False) for name, array in arrays.items()]
