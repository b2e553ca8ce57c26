# SPDX-License-Identifier: MIT
"""Steps of a scene in single precision, as a GPU makes them in float32, on a processor: the launches of its step built
with real = float. Only the solve between them is a direct one in double precision."""

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve

from sim_server.backends.cpu.device import CpuLaunch
from sim_server.backends.kernel_binding import members_of
from sim_server.simulation import Simulation
from tests.texts import module_in


class SingleSteps:
    """A scene of one body, one linearization and no contact, begun where the simulation is.

    sim: gives the launches, and stays as it is. real: "double" makes the steps of the simulation itself.
    """

    def __init__(self, sim: Simulation, real: str = "float"):
        self.sim, self._real, self._twins = sim, real, dict[int, NDArray[Any]]()
        launches = [self._twin(launch) for launch in sim.step_launches]
        names = [launch.name for launch in launches]
        first = names.index("nodes.advance")
        self._assemble, self._advance = launches[:first], launches[first:]

    def _twin(self, launch: Any) -> CpuLaunch:
        given: dict[str, Any] = {}
        members = members_of(launch.text, launch.struct, {"real": self._real, "local": self._real})
        for f, value in zip(members, launch.values, strict=True):
            if f.dtype == np.float32:
                value = self._twins.setdefault(id(value), value.astype(np.float32))
            given[f.name] = value
        module = module_in(launch.module.path, self._real)
        return module.bind(launch.name.split(".")[1], given.pop("n"), **given)

    def of(self, array: NDArray[Any]) -> NDArray[Any]:
        """The twin of an array of the simulation."""
        return self._twins.get(id(array), array)

    def launch(self, name: str) -> CpuLaunch:
        """One of those of the step."""
        return next(launch for launch in self._assemble if launch.name == name)

    def assemble(self, until: str = "") -> None:
        """Runs the launches that make A and b, or those before one of them."""
        for launch in self._assemble:
            if launch.name == until:
                return
            launch()

    def step(self) -> bool:
        """Makes a step; returns whether it was solved, so the body does not count as at rest."""
        s = self.sim.system
        s.moving[:] = 0
        self.assemble()
        if moving := bool(s.moving[0]):
            s.values[...] = self.of(s.values)
            y = spsolve(self.sim.matrix(0).tocsc(), self.of(s.b_material).ravel().astype(float))
            self.of(s.y)[...] = y.reshape(-1, 3)
        for launch in self._advance:
            launch()
        return moving
