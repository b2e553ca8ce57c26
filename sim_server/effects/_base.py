# SPDX-License-Identifier: MIT
"""Base of the effects: elements that couple nodes, and launches that add to the system of a step."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Generic, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch, PendingUpdate
from sim_server.backends.energies import ElementEnergies
from sim_server.backends.measured import Measured
from sim_server.backends.rank_one import RankOne
from sim_server.errors import InputError
from sim_server.mechanics.system import Coupled, Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene

T = TypeVar("T")


@dataclass(frozen=True)
class Refusal:
    """An element whose deformation its law does not define.

    element: its number in the object's mesh; time: of the first occurrence [s]; J: determinant of F there.
    """

    effect: str
    body: int
    element: int
    time: float
    J: float

    def __str__(self) -> str:
        return f"element {self.element} has J = {self.J:.3g}, which {self.effect} does not define"


class EffectUpdates(Protocol):
    """What an effect that changes while steps run needs of the simulation."""

    def update_effect(self, effect: "Effect", launch: Launch) -> PendingUpdate:
        """Gives the mailed launch of the effect other arguments, those of `launch`, from one of the next steps on."""
        ...


class Effect:
    """Base of all effects. A file under effects/ has `build(world, listed) -> Effect`.

    name: as scenes list it.
    elements (m, c): node numbers (of the scene) of the elements whose c corners the effect couples, or None. A corner
        without a part in anything may repeat another one.
    holds: whether its elements count where a scene without inertia asks if every part is held.
    rotated: the bodies whose elements add their rotations to system.mean for the warp; nodes of other bodies get
    theirs by shape matching. elastic: by body index, Young's modulus [Pa] and Poisson's ratio of its elements, (m,)
    each, for viewers.
    """

    name = ""
    elements: Int32 | None = None
    holds = True
    rotated: tuple[Body, ...] = ()
    elastic: Mapping[int, tuple[Float64, Float64]] = MappingProxyType({})

    def cuttable(self, body: Body) -> bool:
        """Returns whether it goes on rightly where elements of a body are removed (cutting.py)."""
        return False

    def splittable(self, body: Body) -> bool:
        """Returns whether it goes on rightly where a body is split along faces of its elements (cutting.py)."""
        return False

    @property
    def comes_first(self) -> bool:
        """True if its launches run before those of other effects."""
        return False

    @property
    def coupled(self) -> Coupled | None:
        """What the system is to have places for (`stencil` of the launches)."""
        return self.elements

    @property
    def element_nodes(self) -> list[Int32]:
        """One node of each item of its launches over elements, triangles, cells and patches, in their order."""
        return [] if self.elements is None else [self.elements[:, 0]]

    @property
    def known_to_workers(self) -> bool:
        """True if its part of A follows from scene, mesh and positions, so that workers can assemble A, too."""
        return True

    def known_to_workers_at(self, step: int) -> bool:
        """The same for the matrix A assembled after `step` completed steps."""
        return self.known_to_workers

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        """Launches that add the effect to system.b, .diagonal, .block, .sums and .mean.

        stencil: places of its elements in the system; accumulate: add to sums, which another effect has written.
        At most one launch may be of a MAILED_KERNEL, whose arguments change while steps run.
        """
        return []

    def join(self, others: Sequence["Effect"]) -> None:
        """Called once all effects of the scene are built, these, before any launches are made. Raises InputError."""

    def history(self) -> list[Launch]:
        """Launches that advance what the material remembers by the step that has ended, from where it has ended.

        They begin every step, once, before all other launches, so that attempts, trials of a search and passes of
        contact find the memory as the last step has left it. A body that was frozen has not moved: they leave it out.
        """
        return []

    def force_launches(self, system: System, stencil: Stencil | None, frames: bool) -> list[Launch] | None:
        """Launches that add its forces alone to system.b, and what else it adds to .diagonal; None if it has none such.

        For steps that need no A: the launches of `launches` then run in steps that do. They must not read or write
        .block, .sums. frames: add the rotations of the elements to .mean, too
        """
        return self.launches(system, stencil, False) if stencil is None else None

    def elastic_in(self, scene: Scene) -> Mapping[int, tuple[Float64, Float64]]:
        """Returns `elastic` by the parameters of a scene."""
        return {}

    def unchangeable(self, scene: Scene) -> Mapping[tuple[int, str], str]:
        """Returns why live parameters cannot change to those of `scene` while steps run, {} for most.

        Those whose change would need other launches, by index of the body (-1: of the whole scene) and key.
        """
        return {}

    def connect(self, simulation: EffectUpdates) -> None:
        """Called once the loop exists. An effect that changes while steps run keeps `simulation`."""

    def rows_of_bodies(self, array: NDArray[Any]) -> Callable[[int], Any] | None:
        """Returns the function that finds the rows of a body in an array of this effect, for resets.

        None for arrays that have a row for each node, body or element, or no rows of single bodies.
        """
        return None

    def balance_arrays(self) -> dict[str, Float64]:
        """Returns arrays that the energy balance of a step reads, by their names in backends.energies; {} for most.

        gravity: acceleration (3,) [m/s2]. force (n, 3) [N], spring (n,) [N/m], anchor (n, 3) [m]: of pushes and grabs.
        load (n, 3): of all loads [N] (_loads.py).
        """
        return {}

    def rank_one(self) -> RankOne | None:
        """Returns what it adds to A beside blocks, on a CPU alone; None for most."""
        return None

    def energies(self) -> ElementEnergies | None:
        """Potential energies of its elements; None for an effect without."""
        return None

    def all_energies(self) -> list[ElementEnergies]:
        """`energies`, and others that are launched after them in this order."""
        return [] if (elements := self.energies()) is None else [elements]

    def energy(self) -> float:
        """Potential energy of the present state [J]; 0 for an effect without one.

        NaN where an element has a deformation that its law does not define.
        """
        total = 0.0
        for elements in self.all_energies():
            elements.launch()
            total += float(elements.launch.fetch("energy").sum(dtype=float))
        return total

    def measured(self) -> list[Measured]:
        """Numbers that its kernels leave in each step for the records, the log and clients, by body; [] for most."""
        return []

    def refusals(self) -> list[Refusal]:
        """Elements whose deformation the law does not define (e.g. J <= 0), by the time of the first occurrence.

        States tried by the line search count, too. The solver finds their forces not finite (status not_finite) and
        leaves the velocity as it was.
        """
        return []


def check_beside_law(effect: Effect, bodies: Sequence[Body], others: Sequence[Effect]) -> None:
    """Raises InputError for a body without another effect whose elements hold its parts together, as a law's do."""
    for body in bodies:
        beside = [e for e in others if e is not effect and e.name in body.effects and e.elements is not None]
        if not any(e.holds for e in beside):
            raise InputError(
                f"object {body.name!r}, effect {effect.name}: nothing beside it gives the object a shape; list a "
                "material beside it, as neo_hookean or corotational"
            )


class Build(Protocol):
    """Function `build` of an effect's module, which makes the effect.

    listed: the bodies that have it, each with its parameters (scene effects: all bodies). Bodies whose parameters have
    different values of `variant` are built apart, as each variant has its own kernels.
    """

    def __call__(self, world: World, listed: list[tuple[Body, Any]]) -> Effect: ...


def params_in(scene: Scene, name: str, bodies: Sequence[Body]) -> list[Any]:
    """Returns the parameters that bodies have in a scene, maybe with other values than at the start."""
    return [scene.objects[body.index].effects[name] for body in bodies]


class PerBody(Generic[T]):
    """A function of bodies and their parameters, which is called again only for other parameters than the last.

    name: of the effect whose parameters these are. compute: may raise InputError
    """

    def __init__(self, name: str, bodies: Sequence[Body], compute: Callable[[Body, Any], T]):
        self._name, self._bodies, self._compute = name, bodies, compute
        self._last: dict[int, tuple[Any, T]] = {}  # by index of the body: parameters, result

    def __call__(self, scene: Scene) -> list[T]:
        """Returns the results by the parameters of a scene, in the order of the bodies."""
        for body, params in zip(self._bodies, params_in(scene, self._name, self._bodies), strict=True):
            if body.index not in self._last or self._last[body.index][0] != params:
                self._last[body.index] = params, self._compute(body, params)
        return [self._last[body.index][1] for body in self._bodies]


def per_node(world: World, listed: list[tuple[Body, Any]], value: str) -> Float64:
    """Returns the parameter `value` of each listed body at its nodes, 0 elsewhere; (nodes,)."""
    out = np.zeros(world.nodes)
    for body, params in listed:
        out[body.nodes] = getattr(params, value)
    return out
