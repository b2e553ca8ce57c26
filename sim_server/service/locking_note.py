# SPDX-License-Identifier: MIT
"""Notes on objects whose linear tetrahedra lock: by how much they bend too little, and what to do."""

from collections.abc import Iterator

import numpy as np

from sim_server.mechanics.world import Body
from sim_server.scene import SceneObject
from sim_server.scene.elements import PATCHED, element_errors
from sim_server.scene.integrator_options import IntegratorOptions
from sim_server.simulation import Simulation

LOCKS = 0.45  # Poisson's ratio above which a note is due, to two digits: laws may have it from other constants
POISSON = (0.45, 0.49, 0.499, 0.4999)
KEPT = {
    "kuhn": (0.696, 0.403, 0.136, 0.084),
    "mirrored": (0.857, 0.832, 0.824, 0.823),
    "unstructured": (0.843, 0.669, 0.299, 0.097),
}
"""Sag of a cantilever of 1 x 1 x 4 m over what it should be, at POISSON: bars of 5 x 5 x 20 cells, and 5,025 tetrahedra
of Gmsh (tests/bench/verification/locking.py measures them, tests/service/test_locking_note.py the bars)."""


def locking_notes(simulation: Simulation) -> Iterator[tuple[list[Body], str]]:
    """Yields bodies with the same mesh, Poisson's ratio and remedy, and what is to be said of them."""
    objects = {o.name: o for o in simulation.scene.objects}
    alike: dict[tuple[str, float, str], list[Body]] = {}
    for body, poisson in sorted(_nearly_incompressible(simulation).items()):
        b = simulation.world.bodies[body]
        mesh: str = objects[b.name].mesh.split or "unstructured"
        alike.setdefault((mesh, poisson, _remedy(objects[b.name], simulation.scene.integrator)), []).append(b)
    for (mesh, poisson, remedy), bodies in alike.items():
        of = "an unstructured mesh" if mesh == "unstructured" else f'split = "{mesh}"'
        lost = f"{100 * (1 - kept(mesh, poisson)):.0f} %"
        text = (
            f"with a Poisson's ratio of {poisson:.10g} and linear tetrahedra ({of}), which lock: a beam five of them "
            f"thick bends about {lost} too little; {remedy}"
        )
        yield bodies, text


def kept(mesh: str, poisson: float) -> float:
    """Returns the part of its sag that such a beam has, between the measured ones by the logarithm of 1/2 - poisson."""
    place = np.log10(0.5 - np.array(POISSON))
    at = np.log10(max(0.5 - poisson, 0.5 - POISSON[-1]))
    return float(np.interp(-at, -place, KEPT[mesh]))


def _nearly_incompressible(simulation: Simulation) -> dict[int, float]:
    """The largest Poisson's ratio of each body of linear tetrahedra, by its index, where it is above LOCKS."""
    found: dict[int, float] = {}
    for effect in simulation.effects.values():
        for body, (_, poisson) in effect.elastic.items():
            others = effect.name in ("corotational", *PATCHED) and simulation.world.bodies[body].elements != "linear"
            if not others and round(float(poisson.max()), 2) > LOCKS:
                found[body] = max(found.get(body, 0.0), float(poisson.max()))
    return found


def _remedy(o: SceneObject, integrator: IntegratorOptions) -> str:
    kinds = ("smoothed", "patch")
    others = [k for k in kinds if not list(element_errors([o.model_copy(update={"elements": k})], integrator))]
    ways = [f'elements = "{kind}" does not lock' for kind in others[:1]]
    ways += ['split = "mirrored" locks less'] if o.mesh.split == "kuhn" else []
    return ", ".join(ways) or "a finer mesh locks less"
