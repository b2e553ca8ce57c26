# SPDX-License-Identifier: MIT
"""The input of Newton-Raphson and its memory, as the loop of a CPU reads them."""

import ctypes as c
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64
from sim_server.backends.cpu import structs
from sim_server.backends.newton import Newton


class NativeNewton:
    """The input of Newton-Raphson and its memory, attached to a loop and its launches.

    late: of each assembling launch, whether a trial can do without it
    """

    def __init__(self, newton: Newton, late: Sequence[bool], loop: structs.Loop, launches: Any):
        self._room = np.zeros((18, len(newton.arrays["mass"])))
        self._search = (structs.Search * loop.bodies)()
        self._arrays, self._late = newton.arrays, np.array(late, np.int32)
        options = newton.options
        limits = structs.Limits(options.linearizations, options.trials, options.tolerance)
        self.native = structs.Newton(most=limits, dx_dv=newton.dx_dv)
        for name, array in {**newton.arrays, "room": self._room, "late": self._late}.items():
            setattr(self.native, name, array.ctypes.data)
        self.native.search = c.addressof(self._search)
        self.native.detect, self.native.detects = newton.detect.start, newton.detect.stop - newton.detect.start
        loop.newton = c.addressof(self.native)
        self._parts = newton.parts
        for launch, part in zip(launches, newton.parts, strict=False):
            launch.parts = None if part is None else part.ctypes.data

    def search_in_contact(self, bodies: int) -> Float64:
        """Adds what searches with contact need; returns the predictor of contact."""
        moved = np.zeros((self._room.shape[1], 3))
        most, entered = np.zeros(bodies, np.int32), np.zeros(bodies, np.int32)
        self._touch: dict[str, NDArray[Any]] = {"moved": moved, "most_touching": most, "entered": entered}
        for name, array in self._touch.items():
            setattr(self.native, name, array.ctypes.data)
        return moved
