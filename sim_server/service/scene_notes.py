# SPDX-License-Identifier: MIT
"""Notes on a loaded scene: valid, but perhaps not what its author meant."""

import numpy as np
from numpy.typing import NDArray

from sim_server.mechanics.world import Body
from sim_server.service.locking_note import locking_notes
from sim_server.simulation import Simulation

NEARLY_INCOMPRESSIBLE = 0.4999  # Poisson's ratio; beyond it solves were seen to miss their tolerance
NAMED = 3  # objects named in a line


def scene_notes(simulation: Simulation) -> list[str]:
    """Returns lines: bodies that fall apart or fall freely, nearly incompressible materials, and elements that lock.

    A body falls if gravity acts on it and no element connects it to a fixed node or a roller, even if clients may grab
    it; not where there are obstacles, on which it may land. In a quasi-static scene such a body is refused.
    """
    locking = [f"{_names(bodies)} {text}" for bodies, text in locking_notes(simulation)]
    return [line for line in (_loose(simulation), _incompressible(simulation), *locking) if line]


def _loose(simulation: Simulation) -> str:
    world = simulation.world
    pulled = (
        world.inertia
        and not (world.obstacles or world.attachments or world.springs)
        and world.at_start(world.gravity_of).any()
    )
    part, elastic = _parts(simulation)
    fixed = world.free == 0
    if world.rollers is not None:
        fixed |= world.rollers.limited > 0
    held = np.isin(part, part[fixed])
    apart, falling, partly = [], [], []
    for body in world.bodies:
        loose = int((~held[body.nodes]).sum())
        if not elastic[body.nodes].any():
            apart.append(body)
        elif pulled and loose == body.last - body.first:
            falling.append(body)
        elif pulled and loose:
            partly.append(body)
    said = [f"{_names(apart)} without elasticity: each node moves by itself"] if apart else []
    said += [f"{_names(falling)} without fixed nodes: in free fall under gravity"] if falling else []
    said += [f"{_names(partly)} with parts that no element connects to a fixed node: these fall"] if partly else []
    return "; ".join(said)


def _parts(simulation: Simulation) -> tuple[NDArray[np.int32], NDArray[np.bool_]]:
    """Returns the connected part of each node, and whether the node belongs to an element, (nodes,) each."""
    n = simulation.world.nodes
    elements = [e.elements for e in simulation.effects.values() if e.elements is not None]
    ends = [e[:, [0, k]] for e in elements for k in range(1, e.shape[1])]
    pairs = np.concatenate([np.zeros((0, 2), np.int32), *ends])
    elastic = np.zeros(n, dtype=bool)
    elastic[pairs] = True
    return connected_parts(n, pairs), elastic


def connected_parts(nodes: int, pairs: NDArray[np.int32]) -> NDArray[np.int32]:
    """Returns the lowest node that each node is connected with. pairs: neighbours, (k, 2).

    SciPy has a function for it, whose import takes a fifth of a server's start.
    """
    part = np.arange(nodes, dtype=np.int32)
    while (part[pairs[:, 0]] != part[pairs[:, 1]]).any():
        ends = part[pairs]
        lowest = ends.min(axis=1)
        for k in range(2):
            np.minimum.at(part, ends[:, k], lowest)
        while (part != part[part]).any():
            part = part[part]
    return part


def _incompressible(simulation: Simulation) -> str:
    found = [(b, p) for e in simulation.effects.values() for b, (_, p) in e.elastic.items()]
    above = {b: float(p.max()) for b, p in found if p.max() > NEARLY_INCOMPRESSIBLE}
    if not above:
        return ""
    bodies = [simulation.world.bodies[b] for b in sorted(above)]
    return (
        f"{_names(bodies)} with a Poisson's ratio of {max(above.values()):.10g}: above {NEARLY_INCOMPRESSIBLE} solves "
        "may not reach their tolerance"
    )


def _names(bodies: list[Body]) -> str:
    more = f" and {len(bodies) - NAMED} more" if len(bodies) > NAMED else ""
    return "object" + "s" * (len(bodies) > 1) + " " + ", ".join(repr(b.name) for b in bodies[:NAMED]) + more
