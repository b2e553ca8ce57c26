# SPDX-License-Identifier: MIT
"""Lists the arrays that steps carry on, whatever effects, scheme and device a scene has.

The texts of the kernels say what is written: every array that a launch of the step does not declare const is state,
but for those of DERIVED, which each step makes anew before it reads them. So an effect needs no list of its own. What
native code writes beside the launches is listed by the engine (`state` in backends/base.py).
"""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.backends.base import Launch
from sim_server.backends.state import StateArray, rows_in, same_body
from sim_server.simulation import Simulation

DERIVED = frozenset({
    "nodal_impulse", "scaled_gradients", "twist", "tangent", "corners", "edges",  # of elements
    "strain", "dilatation", "mean_dilatation", "patch_gradients",  # of strain cells and patches
    "sums", "b", "diagonal", "mean", "b_material", "y", "values", "block",  # of the system
    "pull",  # of pushes and grabs
})  # fmt: skip
TOTALS = frozenset({  # counted or first times of a run, or what factors have to know: no reset takes it back
    "refused", "dropped", "left_before", "changed_at", "at_rest", "copied_at",
})  # fmt: skip
# Since there are checkpoints; those without them go on all the same.
ADDED = frozenset({"last_b", "differences", "guess"})


def state_arrays(simulation: Simulation) -> list[StateArray]:
    """Returns all arrays that one step leaves to the next, but for interactions and poses of what clients move."""
    return [*launch_arrays(simulation), *simulation.engine.state()]


def launch_arrays(simulation: Simulation) -> list[StateArray]:
    """Returns those of them that launches write, or other code of effects and of the world."""
    found: dict[int, StateArray] = {}
    moved = {id(a) for m in simulation.movers for a in m.frame_arrays()}
    for launch in simulation.step_launches:
        if launch.mailed and simulation.touch is not None and launch.name.startswith("touch."):
            continue  # its arrays are those of its interactions, or made by `others`
        for member, array in launch.written():
            if member in DERIVED or not array.size or id(array) in found:
                continue
            name = _unused(f"{launch.name}.{member}", {each.name for each in found.values()})
            resets = member not in TOTALS and id(array) not in moved
            state = _array(simulation, name, array, launch, resets)
            found[id(array)] = replace(state, added=member in ADDED)
    w = simulation.world
    others: dict[str, NDArray[Any]] = {"world.free": w.free, "world.reaction": w.reaction}
    if simulation.touch is not None:
        others |= {f"touch.{name}": array for name, array in simulation.touch.balance_arrays().items()}
    for name, array in others.items():
        if array.size and id(array) not in found:
            found[id(array)] = _array(simulation, name, array, None, True)
    return list(found.values())


def _unused(name: str, used: set[str]) -> str:
    """Returns the name, or with a number behind it where several effects have one text."""
    return next(n for n in (name, *(f"{name}#{k}" for k in range(2, len(used) + 3))) if n not in used)


def _array(
    simulation: Simulation, name: str, array: NDArray[Any], launch: Launch | None, resets: bool
) -> StateArray:  # fmt: skip
    backend = simulation.world.backend

    def read() -> NDArray[Any]:
        return backend.fetch(array).copy()

    def write(values: NDArray[Any]) -> None:
        array[...] = values
        backend.push(array)

    return StateArray(name, read, write, _rows(simulation, array, launch), resets)


def _rows(simulation: Simulation, array: NDArray[Any], launch: Launch | None) -> Callable[[int], Any] | None:
    """Returns the function that finds the rows of a body in an array; None: it has no rows of single bodies."""
    for effect in simulation.effects.values():
        if (rows := effect.rows_of_bodies(array)) is not None:
            return rows
    w = simulation.world
    if len(array) == w.nodes:
        return rows_in(simulation.system.body)
    if array is w.reaction:
        return same_body
    if launch is not None and launch.domain == "elements":
        of = [e.elements[:, 0] for e in simulation.effects.values() if e.elements is not None]
        bodies = [simulation.system.body[corner] for corner in of if len(corner) == len(array)]
        if bodies and all(np.array_equal(bodies[0], other) for other in bodies):
            return rows_in(bodies[0])
    return None
