# SPDX-License-Identifier: MIT
"""Short steps of bodies that ran away, in memory that the loop of the CPU can read."""

import ctypes as c

import numpy as np

from sim_server.arrays import Float64
from sim_server.backends.cpu import structs
from sim_server.backends.halving import Halving
from sim_server.backends.state import StateArray, host_array, memory_of, same_body


class NativeHalving:
    """The input of short steps and their memory, attached to a loop. number: of each launch by id."""

    def __init__(self, given: Halving, loop: structs.Loop, number: dict[int, int]):
        self._input, nodes = given, len(given.before)
        self._launch = np.array([[number[id(x)] for x in listed] for listed in given.assemble], np.int32)
        self._advance = np.array([number[id(x)] for x in given.advance], np.int32)
        self._state = (structs.ShortSteps * loop.bodies)()
        self._result = (structs.SolveResult * loop.bodies)()
        self._made = np.zeros(loop.bodies, np.int32)
        self._own: dict[str, Float64] = {
            "start_x": np.zeros((nodes, 3)), "start_v": np.zeros((nodes, 3)),
            "room": np.zeros((len(given.left), nodes, 3)),
        }  # fmt: skip
        self._width = np.array([array.size // nodes for array in given.left], np.int32)
        self._array = (c.c_void_p * len(given.left))(*(array.ctypes.data for array in given.left))
        self.native = structs.Halving(
            levels=len(given.assemble), launches=self._launch.shape[1], launch=self._launch.ctypes.data,
            advance=self._advance.ctypes.data, end=-1 if given.end is None else number[id(given.end)],
            own_coefficients=tuple(given.coefficients.tolist()), array=c.addressof(self._array),
            arrays=len(given.left), width=self._width.ctypes.data, touched=given.touched.ctypes.data,
            state=c.addressof(self._state), made=self._made.ctypes.data, result=c.addressof(self._result),
        )  # fmt: skip
        arrays = self._own | {name: getattr(given, name) for name in ("coefficients", "before", "rotation")}
        arrays |= dict(zip(("predictor", "damping_velocity", "inertial_increment"), given.scheme, strict=False))
        for name, array in arrays.items():
            setattr(self.native, name, array.ctypes.data)
        loop.halving = c.addressof(self.native)

    def state(self) -> list[StateArray]:
        """Returns what steps carry on."""
        return [host_array("engine.halving", memory_of(self._state, len(self._state)), same_body)]
