# SPDX-License-Identifier: MIT
"""Energy of each body in every step, and the handling of runaways (criterion: kernels/energy_balance.cuh)."""

import ctypes as c
from typing import Any

import numpy as np

from sim_server.arrays import Float64, Int32
from sim_server.backends.cpu import structs
from sim_server.backends.kinds import BALANCE
from sim_server.effects._base import Effect, ElementEnergies
from sim_server.mechanics.world import World
from sim_server.scene.solver_options import OnRunaway

_numbers = BALANCE.enumeration("OnRunaway")
CODES: dict[OnRunaway | None, int] = {  # None: bodies are not watched at all
    "freeze": _numbers["FREEZE"],
    "go_on": _numbers["GO_ON"],
    None: _numbers["UNWATCHED"],
}


class Energies:
    """What the loop needs to know of a scene for that.

    gravity (3,) [m/s2]. before (n, 3): gets x when a step began [m]; still: arrays (n, 3) that are 0 in a body at rest.
    balance (bodies,) of structs.BALANCE: on a CPU what the loop works with.
    """

    def __init__(
        self, world: World, effects: dict[str, Effect], before: Float64, still: list[Float64],
        on_runaway: OnRunaway | None,
    ):  # fmt: skip
        self.world, self.before, self.still, self.on_runaway = world, before, still, on_runaway
        self.gravity: Float64 = getattr(effects.get("gravity"), "g", np.zeros(3))
        world.backend.keep(self.gravity)
        self.touch: Any = effects.get("touch")
        self.elastic: list[ElementEnergies] = [e for x in effects.values() if (e := x.energies()) is not None]
        self.balance = np.zeros(len(world.bodies), structs.BALANCE)
        for body, b in zip(world.bodies, self.balance, strict=True):
            b["mass"] = world.mass[body.nodes].sum()
            b["diagonal"] = np.linalg.norm(np.ptp(world.rest[body.nodes], axis=0))

    def parts(self, elements: ElementEnergies) -> Int32:
        """(bodies + 1,) where the elements of each body begin."""
        return np.searchsorted(elements.owner, np.arange(len(self.world.bodies) + 1)).astype(np.int32)


class NativeEnergies:
    """Energies in memory that the loop of the CPU can read."""

    def __init__(self, energies: Energies):
        self._energies, w = energies, energies.world
        self._parts = [energies.parts(e) for e in energies.elastic]
        self._bindings = [
            structs.Binding(params=c.addressof(e.launch.params), items=e.launch.items) for e in energies.elastic
        ]
        self._elastic = (structs.Elastic * max(len(energies.elastic), 1))()
        for entry, e, parts, binding in zip(self._elastic, energies.elastic, self._parts, self._bindings, strict=False):
            entry.launch.kernel, entry.launch.binding = e.launch.function, c.addressof(binding)
            entry.energy, entry.parts = e.energy.ctypes.data, parts.ctypes.data
        self._still = (c.c_void_p * len(energies.still))(*(array.ctypes.data for array in energies.still))
        self.native = structs.Energies()
        arrays = {
            "gravity": energies.gravity,
            "mass": w.mass,
            "before": energies.before,
            "free": w.free,
            "balance": energies.balance,
        }
        if energies.touch is not None:
            arrays |= {name: getattr(energies.touch, name) for name in ("force", "spring", "anchor")}
        arrays["left"] = self._left = np.zeros((2, w.nodes, 3))
        for name, array in arrays.items():
            setattr(self.native, name, array.ctypes.data)
        self.native.still, self.native.stills = c.addressof(self._still), len(self._still)
        self.native.elastic, self.native.elastics = c.addressof(self._elastic), len(energies.elastic)
        self.native.on_runaway, self.native.inertia = CODES[energies.on_runaway], int(w.inertia)
