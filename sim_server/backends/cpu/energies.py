# SPDX-License-Identifier: MIT
"""Energies in memory that the loop of the CPU can read."""

import ctypes as c

import numpy as np

from sim_server.arrays import Float64
from sim_server.backends.cpu import structs
from sim_server.backends.energies import CODES, Energies


class NativeEnergies:
    """Keeps `native` and the memory that it points to alive."""

    def __init__(self, energies: Energies):
        e = self._energies = energies
        self._parts = [e.parts(elements) for elements in e.elastic]
        self._bindings = [structs.Binding(params=c.addressof(x.launch.params), items=x.launch.items) for x in e.elastic]
        self._elastic = (structs.Elastic * max(len(e.elastic), 1))()
        for entry, x, parts, binding in zip(self._elastic, e.elastic, self._parts, self._bindings, strict=False):
            entry.launch.kernel, entry.launch.binding = x.launch.function, c.addressof(binding)
            entry.energy, entry.parts = x.energy.ctypes.data, parts.ctypes.data
        self._still = (c.c_void_p * len(e.still))(*(array.ctypes.data for array in e.still))
        self.balance = e.balance
        self._left = np.zeros((2, len(e.mass), 3))
        self.native = structs.Energies()
        arrays = {"gravity": e.gravity, "mass": e.mass, "before": e.before, "free": e.free, "balance": e.balance}
        for name, array in (arrays | e.touch | {"left": self._left}).items():
            setattr(self.native, name, array.ctypes.data)
        self.native.still, self.native.stills = c.addressof(self._still), len(self._still)
        self.native.elastic, self.native.elastics = c.addressof(self._elastic), len(e.elastic)
        self.native.on_runaway, self.native.inertia = CODES[e.on_runaway], int(e.inertia)

    def resume(self, x: Float64, v: Float64) -> None:
        """Has the balances go on from a state that was written."""
        self._left[0], self._left[1], self.native.begun = x, v, 1
