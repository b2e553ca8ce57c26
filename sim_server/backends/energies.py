# SPDX-License-Identifier: MIT
"""Input of an engine for the energy of each body in every step, and for what becomes of one that runs away.

kernels/energy_balance.cuh says when a body runs away.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32, Int64
from sim_server.backends.kinds import ON_RUNAWAY
from sim_server.scene.solver_options import OnRunaway

CODES: dict[OnRunaway | None, int] = {  # None: bodies are not watched at all
    "freeze": ON_RUNAWAY["FREEZE"],
    "go_on": ON_RUNAWAY["GO_ON"],
    "halve": ON_RUNAWAY["FREEZE"],  # what short steps do not help
    None: ON_RUNAWAY["UNWATCHED"],
}


@dataclass(frozen=True)
class ElementEnergies:
    """Potential energies of the elements of an effect, which `launch` leaves in energy (m,) [J].

    owner (m,): index of the body of each element, ascending.
    """

    launch: Any
    energy: Float64
    owner: Int64


@dataclass(frozen=True)
class Energies:
    """Arrays of a scene that energies are summed from.

    starts: (bodies + 1,) first node of each body
    mass: (n,) lumped [kg]
    free: (n,) 1, or 0 at fixed nodes
    x, v: (n, 3) [m], [m/s]
    before: (n, 3) gets x when a step begins [m]
    still: arrays (n, 3) that are 0 in a body at rest
    gravity: (3,) [m/s2]
    touch: arrays force, spring and anchor of the effect touch, and load of the effects with loads, by name
    elastic: energies of the elements of each effect that has any
    balance: (bodies,) of structs.BALANCE; on a CPU what the loop works with
    inertia: False in a quasi-static scene
    on_runaway: what becomes of a body that runs away; None: bodies are not watched
    """

    starts: Int32
    mass: Float64
    free: Float64
    x: Float64
    v: Float64
    before: Float64
    still: list[Float64]
    gravity: Float64
    touch: dict[str, NDArray[Any]]
    elastic: list[ElementEnergies]
    balance: NDArray[Any]
    inertia: bool
    on_runaway: OnRunaway | None

    @property
    def freezes(self) -> bool:
        """True if a body that runs away is frozen, at the latest after its step was made again."""
        return self.on_runaway in ("freeze", "halve")

    def parts(self, elements: ElementEnergies) -> Int32:
        """Returns where the elements of each body begin, (bodies + 1,)."""
        return np.searchsorted(elements.owner, np.arange(len(self.starts))).astype(np.int32)
