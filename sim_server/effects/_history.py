# SPDX-License-Identifier: MIT
"""Materials that remember: common part of prony, plasticity, damage and poroelasticity. They are listed beside a law of
tetrahedra.

What they remember are strains in the turning frame of the element: with the rotation R nearest to F, S = R^T F and
the strain S - I. A rotation of the body leaves all of it as it is. Their stress T need not be coaxial with S, so that
R T alone would turn an element that is free; the forces are those whose work is T : dS ::

    f_a = -V R (T + A) grad N_a,   A skew,   A S + S A = S T - T S

so momentum and angular momentum stay. As with corotational elements the change of R is left out of the tangent.

The memory advances once a step: every step begins with launches (`Effect.history`) that read where the last one has
ended, whatever attempts, linearizations, trials or passes of contact it took, and that no step has a second time. The
forces of a step then are a function of positions, beside a memory that does not change. So a body that a refused solve
sends back has the memory of the positions at which its steps ended; a frozen one has that of its last step. The memory
is state as positions are: resets, checkpoints and replays have it to the bit.

Schemes whose steps ask for the forces of more than one instant (ros2, central_difference) are refused, and so are
other elements than linear ones (`elements = "auto"` is linear then).
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.effects._base import Effect
from sim_server.effects._hyperelastic import Tetrahedra
from sim_server.errors import InputError
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene
from sim_server.scene.integrator_options import IntegratorOptions
from sim_server.scene.parameters import Parameters, complaint

SCHEMES = ("backward_euler", "newmark", "bdf2", "generalized_alpha", "quasi_static")


class ParamsWithHistory(Parameters):
    """The table of an effect with a memory."""

    def under(self, integrator: IntegratorOptions) -> "ParamsWithHistory":
        """Returns itself. Raises a complaint for a scheme that asks for the forces of several instants in a step."""
        if integrator.scheme not in SCHEMES:
            raise complaint(
                f"the memory of a material advances once a step, and integrator.scheme = {integrator.scheme!r} has "
                f"forces in between; allowed: {', '.join(SCHEMES)}"
            )
        return self


def beside_corotational(name: str, listed: list[tuple[Body, Any]]) -> None:
    """Raises InputError for a body without corotational elements by polar decomposition beside the effect `name`."""
    for body, _ in listed:
        law = body.effects.get("corotational")
        if law is None:
            raise InputError(
                f"object {body.name!r}, effect {name}: it takes from the forces of corotational elements: list "
                "corotational beside it"
            )
        if law.rotation != "polar":
            raise InputError(
                f'object {body.name!r}, effect {name}: its strains are those by corotational.rotation = "polar"; given '
                f"is {law.rotation!r}"
            )


class TetrahedraWithHistory(Tetrahedra):
    """Tetrahedra of all bodies that list an effect with a memory.

    text: path of its kernel text. memory: arrays (k, m) that a step carries on. last (k, m): constants with which the
    last step ended, for `advance`, which puts those of now in their place: parameters change before it runs. laws:
    effects with moduli listed beside it, by index of the body; shear (m,): shear moduli [Pa], once all are built.
    """

    text = ""

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        super().__init__(world, listed)
        self.memory: dict[str, Float64] = {}
        self.last = np.zeros((0, len(self.elements)))
        self.laws: dict[int, list[Effect]] = {body.index: [] for body in self.bodies}
        self.shear = np.zeros(0)

    def remember(self, **rows: int) -> None:
        """Makes the arrays of the memory, 0 at the start: (rows, m) by name."""
        self.memory = {name: np.zeros((count, len(self.elements))) for name, count in rows.items()}
        self.world.backend.keep(*self.memory.values())

    def remember_constants(self, *constants: Float64) -> None:
        """Makes `last`, of these constants, (k, m) or (m,) each, one after another."""
        self.last = np.vstack(constants)
        self.world.backend.keep(self.last)

    def join(self, others: Sequence[Effect]) -> None:
        for body in self.bodies:
            self.laws[body.index] = [e for e in others if e is not self and body.index in e.elastic]
        names = {law.name for laws in self.laws.values() for law in laws}
        self.shear = self.world.follow(self.name, *sorted(names), compute=self.shear_in)

    def shear_in(self, scene: Scene) -> Float64:
        """Returns the shear modulus of each element, (m,) [Pa]."""
        return self.elasticity(scene)[1]

    def elasticity(self, scene: Scene) -> tuple[Float64, Float64]:
        """Returns Lame's constants lambda and mu of the laws listed beside, summed, (m,) each [Pa]."""
        found = np.concatenate([self._of_body(body, scene) for body in self.bodies], axis=1)[:, self.order]
        return found[0], found[1]

    def _of_body(self, body: Body, scene: Scene) -> Float64:
        total = np.zeros((2, len(body.mesh.tets)))
        for law in self.laws[body.index]:
            young, poisson = law.elastic_in(scene)[body.index]
            mu = young / (2 * (1 + poisson))
            total += [2 * mu * poisson / (1 - 2 * poisson), mu]
        return total

    def watched(self) -> Int32:
        """A node of each element's body that is free unless the body is frozen, (m,)."""
        w = self.world
        node = {b.index: b.first + int(np.argmax(w.free[b.nodes] > 0)) for b in self.bodies}
        return np.array([node[body] for body in self.owner], np.int32)

    def advance(self, **arguments: Any) -> list[Launch]:
        """Returns the launch that advances the memory."""
        w = self.world
        launch: Launch = w.backend.module(self.text).bind(
            "advance", len(self.elements), tets=self.elements, x=w.x, gradients=self.gradients, free=w.free,
            watched=self.watched(), **self.memory, **arguments,
        )  # fmt: skip
        return [launch]

    def bind_elements(self, **arguments: Any) -> Launch:
        """Returns the launch that makes forces and tangent of the elements.

        arguments: those of its own. Without `h` among them the damping of the stiffness does not act on the effect.
        """
        w = self.world
        undamped = {"h": w.force_coefficient, "tangent": w.force_coefficient * w.dx_dv, "v": w.predictor}
        launch: Launch = w.backend.module(self.text).bind(
            "elements", len(self.elements), tets=self.elements, x=w.x, gradients=self.gradients, volume=self.volume,
            shear=self.shear, **self.memory, corners=self.corners, edges=self.edges,
            **(arguments if "h" in arguments else arguments | undamped),
        )  # fmt: skip
        return launch

    def bind_energy(self, **arguments: Any) -> ElementEnergies:
        """Returns the energies of the elements."""
        launch = self.world.backend.module(self.text).bind(
            "energy", len(self.elements), tets=self.elements, x=self.world.x, gradients=self.gradients,
            volume=self.volume, shear=self.shear, **self.memory, energy=self._energy, **arguments,
        )  # fmt: skip
        return ElementEnergies(launch, self._energy, self.owner)

    def rows_of_bodies(self, array: NDArray[Any]) -> Callable[[int], Any] | None:
        if all(array is not own for own in (*self.memory.values(), self.last)):
            return None
        return lambda body: (slice(None), self.owner == body)


class InCorotational(TetrahedraWithHistory):
    """What takes from the forces of corotational elements.

    No other law with moduli stands beside them: what is taken would be of both, and leave A indefinite.
    """

    @property
    def known_to_workers(self) -> bool:
        return False

    def join(self, others: Sequence[Effect]) -> None:
        super().join(others)
        for body in self.bodies:
            if more := [law.name for law in self.laws[body.index] if law.name != "corotational"]:
                raise InputError(
                    f"object {body.name!r}, effect {self.name}: it takes from the forces of corotational elements "
                    f"alone; {more[0]} cannot stand beside them"
                )
