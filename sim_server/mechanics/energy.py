# SPDX-License-Identifier: MIT
"""What energies are summed from, collected from a scene's world and effects."""

from collections.abc import Mapping
from typing import Protocol

import numpy as np

from sim_server.arrays import Float64
from sim_server.backends.cpu import structs
from sim_server.backends.energies import ElementEnergies, Energies
from sim_server.mechanics.world import World
from sim_server.scene.solver_options import OnRunaway

SLACK_OF_SUBSTEPS: float = structs.LOOP.constant("SLACK_OF_SUBSTEPS")


class EnergyContributor(Protocol):
    """An effect, as far as it takes part in the energy balance."""

    name: str

    def balance_arrays(self) -> dict[str, Float64]:
        """Arrays of it that the balance reads, by name."""

    def all_energies(self) -> list[ElementEnergies]:
        """Potential energies of its elements, in the order in which they are launched."""


def collected_energies(
    world: World, effects: Mapping[str, EnergyContributor], before: Float64, still: list[Float64],
    on_runaway: OnRunaway | None,
) -> Energies:  # fmt: skip
    """Returns the input of an engine. before, still, on_runaway: as of Energies."""
    arrays = {name: array for effect in effects.values() for name, array in effect.balance_arrays().items()}
    gravity = arrays.pop("gravity", np.zeros(3))
    world.backend.keep(gravity)
    balance = np.zeros(len(world.bodies), structs.BALANCE)
    driving = {effect.name for effect in effects.values() if "load" in effect.balance_arrays()} - {"traction"}
    unlisted = driving - {name for body in world.bodies for name in body.effects}  # of all nodes
    for body, b in zip(world.bodies, balance, strict=True):
        b["mass"] = world.mass[body.nodes].sum()
        b["driven"] = float(bool(unlisted or driving & body.effects.keys()))
        b["slack"] = SLACK_OF_SUBSTEPS if world.explicit else 0
        b["diagonal"] = np.linalg.norm(np.ptp(world.rest[body.nodes], axis=0))
    return Energies(
        starts=np.array([*(b.first for b in world.bodies), world.nodes], np.int32),
        mass=world.mass, free=world.free, x=world.x, v=world.v, before=before, still=still, gravity=gravity,
        touch=arrays, elastic=[e for x in effects.values() for e in x.all_energies()],
        balance=balance, inertia=world.inertia, on_runaway=on_runaway,
    )  # fmt: skip
