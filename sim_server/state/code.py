# SPDX-License-Identifier: MIT
"""Which code a run is made by, beside this package: effects of other packages; and the digest of all of it."""

import hashlib
from typing import TYPE_CHECKING

from sim_server.effects import codes_outside
from sim_server.simulation import Simulation

if TYPE_CHECKING:
    from sim_server.effects._outside import Code  # imported where a scene lists such an effect


def codes(simulation: Simulation) -> "list[Code]":
    """Returns what code those effects of the scene are that are of other packages."""
    scene = simulation.scene
    return codes_outside({*scene.effects, *(name for o in scene.objects for name in o.effects)})


def build_id(simulation: Simulation) -> str:
    """Returns a digest of what a run depends on beside its scene: equal ones repeat it bit for bit."""
    built, others = simulation.world.backend.build(), codes(simulation)
    if not others:
        return built
    variant, mark, _ = built.rpartition(":")
    return variant + mark + hashlib.sha256("\0".join([built, *map(str, others)]).encode()).hexdigest()[:24]
