# SPDX-License-Identifier: MIT
"""The objects of a scene, one after another in the same arrays, so that one launch serves all of them."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Backend
from sim_server.errors import InputError
from sim_server.mechanics.rollers import Rollers
from sim_server.mechanics.splitting import Splitter, Splitting, split_of, with_spares
from sim_server.mesh import Mesh, posed
from sim_server.mesh.shape_functions import MASS_PARTS, quadratic_gradients
from sim_server.mesh.surface import volumes
from sim_server.scene import Scene, SceneObject
from sim_server.scene.elements import Kind, kind_of_elements
from sim_server.scene.holders import Holder
from sim_server.scene.obstacles import Obstacle
from sim_server.scene.ties import Attachment, Spring

if TYPE_CHECKING:
    from sim_server.mesh.skin import Skin

T = TypeVar("T")


@dataclass(frozen=True)
class Body:
    """The part of the arrays that belongs to one object: nodes [first, last).

    friction: of its surface; 0 if unused. skin: a finer surface for viewers, which no step uses. elements: their kind
    """

    index: int
    name: str
    mesh: Mesh
    first: int
    last: int
    effects: dict[str, Any]
    friction: float = 0.0
    skin: "Skin | None" = None
    elements: Kind = "linear"

    @property
    def nodes(self) -> slice:
        """Its rows in every nodal array."""
        return slice(self.first, self.last)

    @property
    def tets(self) -> Int32:
        """Corners (m, 4) in node numbers of the scene."""
        return self.mesh.tets + np.int32(self.first)  # as the mesh has them, before it was split

    @property
    def centroids(self) -> Float64:
        """Centroids (m, 3) of the elements at rest, before the pose [m]; of a quadratic one for each of its eight tets,
        which thus have the same constants."""
        return self.mesh.centroids


@dataclass(frozen=True)
class LiveArray:
    """An array that kernels read and that follows parameters of the scene which may change while steps run.

    of: tables of the scene with these parameters: names of effects, friction or spring. compute: its contents.
    """

    array: NDArray[Any]
    of: tuple[str, ...]
    compute: Callable[[Scene], NDArray[Any]]


class AddsLoad(Protocol):
    """An effect that adds to the loads, as far as its place among the launches goes."""

    @property
    def elements(self) -> Int32 | None:
        """Elements that couple nodes; launches of effects with some come first."""


class World:
    """State and node data of a scene.

    rest (n, 3): before the pose [m]; x (n, 3): positions [m]; v (n, 3): velocities [m/s]; mass (n,): lumped [kg];
    uncut_mass (n,): with all elements, where some may be removed [kg];
    free (n,): 1, or 0 at fixed nodes; held (n,): 1 at nodes of holders, which are fixed, too; held_nodes (held,): these
    nodes in the order of the launches over them; held_moves (bodies,): 1 where a holder moves in a step by stages;
    without_elements (n,): 1 at free nodes whose elements were all removed; None: none can be
    splitting: the bodies that may be split along faces, None if none may
    touchable (n,): 1 at nodes that may touch obstacles, where that changes as objects are cut; None: as `free`
    rollers: nodes that may move along some directions only, None without any; alpha, beta (bodies,):
    Rayleigh damping of the mass [1/s] and of the stiffness [s] at the start; damping: both by the
    parameters of a scene; dt: time step [s];
    live_arrays: those that follow parameters of the scene (`follow`);
    projection: of the elements' stiffness, the scene's choice;
    obstacles, holders, attachments, springs: of the scene; reaction (bodies, k, 6): force [N] and torque [N m] of each
    body on each of the k holders, attachments and springs in the last step; gravity_of: acceleration by the parameters
    of a scene, 0 without the effect [m/s2];
    load (n, 3): forces of loads in the last evaluation [N], empty without any; loading: the effects that add to it, in
    the order in which they were built;
    backend: where kernels run.

    Effects use the following of the integrator in place of dt and v (formulas: integrator.py; symbols:
    docs/notation.md). In backward Euler force_coefficient and dx_dv are dt, both velocities are v.

    force_coefficient [s]: factor of forces in b
    dx_dv [s]: derivative of the positions by the velocities at the end of the step
    balance_point: part of the step after which the forces balance, and for which the step solves; 1 but in
        generalized_alpha, where positions, velocities and dv of a solve are those of that point [-]
    coefficients (2,): force_coefficient and dx_dv as kernels read them whose arguments change while steps run
    usual_tangent: an exact tangent of corotational elements is not wanted in the launches that are made
    predictor (n, 3) [m/s]: the step moves x by dx_dv (predictor + dv), dv the solution
    damping_velocity (n, 3) [m/s]: (dx_dv predictor + beta v) / (dx_dv + beta). Elements take it for their velocity: the
        impulse stiffness_coefficient (K damping_velocity) then holds displacement and damping
    explicit: True for explicit substeps (central_difference.py); b is then a force, and damping_velocity is v
    forces_alone: True for schemes with launches that make forces without A
    inertia: False in a quasi-static scene. searches: True with several linearizations a step. plain: True for backward
        Euler with one
    """

    def __init__(self, scene: Scene, backend: Backend):
        self.backend = backend
        self._scene = scene
        self.live_arrays: list[LiveArray] = []
        self.dt = float(scene.dt)
        self.projection = scene.projection
        self.bodies: list[Body] = []
        meshes = [(o, o.load_mesh()) for o in scene.objects]
        first = 0
        splitters: dict[int, Splitter] = {}
        for index, (o, mesh) in enumerate(meshes):
            kind = kind_of_elements(o, mesh, scene.integrator)
            if spares := getattr(o.effects.get("cutting"), "spare", 0):
                splitters[index] = Splitter(o.name, mesh, spares)
                mesh = with_spares(mesh, splitters[index], split_of(scene, index, splitters[index]))
                meshes[index] = o, mesh
            last = first + len(mesh.rest)
            given = dict(o.effects), o.friction or 0.0, o.load_skin(mesh), kind
            self.bodies.append(Body(len(self.bodies), o.name, mesh, first, last, *given))
            first = last
        self.splitting: Splitting | None = None
        if splitters:
            self.splitting = Splitting(splitters, [body.first for body in self.bodies], first)
        self.obstacles: Sequence[Obstacle] = scene.obstacles or []
        self.holders: Sequence[Holder] = scene.holders or []
        self.attachments: Sequence[Attachment] = scene.attachments or []
        self.springs: Sequence[Spring] = scene.springs or []
        columns = len(self.holders) + len(self.attachments) + len(self.springs)
        self.reaction = np.zeros((len(self.bodies), columns, 6))
        backend.keep(self.reaction, exact=True)
        self.gravity_of: Callable[[Scene], Float64] = lambda _: np.zeros(3)
        self.rest = np.concatenate([mesh.rest for _, mesh in meshes])
        self.x = np.concatenate([posed(mesh.rest, o.pose.rotate, o.pose.translate) for o, mesh in meshes])
        self.v = np.zeros_like(self.x)
        self.mass = np.concatenate([_lumped(o, mesh, splitters.get(k)) for k, (o, mesh) in enumerate(meshes)])
        self.uncut_mass = self.mass
        self.free, self.held = np.ones(first), np.zeros(first, np.int32)
        self.held_nodes, self.held_moves = np.zeros(0, np.int32), np.zeros(len(self.bodies), np.int32)
        self.touchable: Float64 | None = None
        self.without_elements: Float64 | None = None
        self.rollers: Rollers | None = None
        self.load, self.loading = np.zeros((0, 3)), list[AddsLoad]()
        self.alpha, self.beta = np.zeros(len(self.bodies)), np.zeros(len(self.bodies))
        self.damping: Callable[[Scene], tuple[Float64, Float64]] = lambda _: (self.alpha, self.beta)
        integrator = scene.integrator
        self.force_coefficient, self.dx_dv = integrator.force_coefficient(self.dt), integrator.dx_dv(self.dt)
        self.balance_point = integrator.balance_point
        self.usual_tangent = False
        self.coefficients = np.array([self.force_coefficient, self.dx_dv])
        self.inertia = integrator.scheme != "quasi_static"
        self.searches = integrator.linearizations > 1
        self.plain = integrator.scheme == "backward_euler" and not self.searches
        self.explicit = integrator.explicit
        self.forces_alone = self.explicit or integrator.scheme == "ros2"
        self.predictor = self.v if self.plain else np.zeros_like(self.v)
        self.damping_velocity = self.v if self.plain or self.explicit else np.zeros_like(self.v)

    def at_start(self, compute: Callable[[Scene], T]) -> T:
        """Returns compute(scene) of the scene as it was built."""
        return compute(self._scene)

    def follow(self, *of: str, compute: Callable[[Scene], NDArray[Any]]) -> Any:
        """Returns compute(scene), an array whose contents are computed again when parameters of these tables change.

        of: as of LiveArray. compute: must not change anything; raises InputError for values that cannot be used
        """
        array = np.ascontiguousarray(compute(self._scene))
        self.live_arrays.append(LiveArray(array, of, compute))
        return array

    def follow_into(self, array: NDArray[Any], *of: str, compute: Callable[[Scene], NDArray[Any]]) -> None:
        """Has an array that there is follow parameters, as `follow` does for a new one."""
        array[...] = compute(self._scene)
        self.live_arrays.append(LiveArray(array, of, compute))

    def elements_of(self, bodies: Sequence[Body], order: NDArray[np.integer]) -> Int32:
        """Returns the elements (m, 4) of bodies, one after another, in an order (m,), by nodes of the scene.

        Those of bodies that may be split follow the scene.
        """
        splitting = self.splitting
        if splitting is None or not any(body.index in splitting.splitters for body in bodies):
            return np.ascontiguousarray(np.concatenate([body.tets for body in bodies])[order])

        def compute(scene: Scene) -> Int32:
            return np.ascontiguousarray(np.concatenate([splitting.tets(scene, body) for body in bodies])[order])

        elements: Int32 = self.follow("cutting", compute=compute)
        splitting.note(elements, compute)
        return elements

    def share_load(self, effect: AddsLoad) -> Float64:
        """Returns `load` for an effect to add to."""
        if not self.loading:
            self.load = np.zeros((self.nodes, 3))
            self.backend.keep(self.load)
        self.loading.append(effect)
        return self.load

    @contextmanager
    def made_with(self, force_coefficient: float, dx_dv: float, usual_tangent: bool) -> Iterator[None]:
        """Launches made inside have these coefficients [s], and usual_tangent; their forces balance at the end."""
        given = self.force_coefficient, self.dx_dv, self.usual_tangent, self.balance_point
        self.force_coefficient, self.dx_dv, self.usual_tangent = force_coefficient, dx_dv, usual_tangent
        self.balance_point = 1.0
        try:
            yield
        finally:
            self.force_coefficient, self.dx_dv, self.usual_tangent, self.balance_point = given

    def gravity(self) -> Float64:
        """Acceleration (3,) [m/s2]."""
        array: Float64 = self.follow("gravity", compute=self.gravity_of)
        return array

    def damp(self, damping: Callable[[Scene], tuple[Float64, Float64]]) -> None:
        """Sets alpha and beta, (bodies,) each, as functions of the parameters of a scene."""
        self.damping = damping
        self.alpha[:], self.beta[:] = damping(self._scene)

    def stiffness_coefficient(self, owner: NDArray[Any]) -> Float64:
        """force_coefficient (dx_dv + beta) of the body of each element, (len(owner),) [s2]: factor of K in A."""
        force_coefficient, dx_dv = self.force_coefficient, self.dx_dv
        return self._of_beta(lambda beta: (force_coefficient * (dx_dv + beta))[owner])

    def euler_block_scale(self) -> Float64:
        """Factor of K in A of backward Euler over that of the scheme, of each body [-]."""
        force_coefficient, dx_dv = self.force_coefficient, self.dx_dv
        return self._of_beta(lambda beta: self.dt * (self.dt + beta) / (force_coefficient * (dx_dv + beta)))

    def inverse_time(self, owner: NDArray[Any]) -> Float64:
        """1 / (dx_dv + beta) of the body of each node, (len(owner),) [1/s]."""
        dx_dv = self.dx_dv
        return self._of_beta(lambda beta: 1 / (dx_dv + beta[owner]))

    def beta_of_nodes(self, factor: float = 1.0) -> Float64:
        """factor times beta of each node's body, (n,) [s]."""
        return self._of_beta(lambda beta: factor * np.repeat(beta, [b.last - b.first for b in self.bodies]))

    def alpha_of_nodes(self) -> Float64:
        """alpha of each node's body, (n,) [1/s]."""
        counts = [b.last - b.first for b in self.bodies]
        array: Float64 = self.follow("rayleigh", compute=lambda scene: np.repeat(self.damping(scene)[0], counts))
        return array

    def _of_beta(self, compute: Callable[[Float64], Float64]) -> Float64:
        array: Float64 = self.follow("rayleigh", compute=lambda scene: compute(self.damping(scene)[1]))
        return array

    @property
    def nodes(self) -> int:
        """Number of nodes of all bodies."""
        return len(self.rest)

    def body(self, name: str) -> Body:
        """Returns a body by name; raises KeyError."""
        for body in self.bodies:
            if body.name == name:
                return body
        raise KeyError(f"no object {name!r}; there are {', '.join(b.name for b in self.bodies)}")

    def body_of(self, nodes: Int32) -> Int32:
        """Returns the index of the body of each node, (len(nodes),)."""
        firsts = np.array([b.first for b in self.bodies])
        return (np.searchsorted(firsts, nodes, "right") - 1).astype(np.int32)

    def with_effect(self, name: str) -> list[tuple[Body, Any]]:
        """The bodies that list the effect, with its parameters."""
        return [(b, b.effects[name]) for b in self.bodies if name in b.effects]


def _lumped(o: SceneObject, mesh: Mesh, splitter: Splitter | None = None) -> Float64:
    """Nodal masses [kg], (n,): parts of each adjacent element's, a quarter of a linear one's, or all equal; those of
    the mesh as it is whole, 0 at spare nodes."""
    if mesh.quadratic is None:
        volume = volumes(mesh.rest, mesh.tets)
    else:
        volume = quadratic_gradients(mesh.rest, mesh.quadratic)[0].sum(axis=1)
    total = o.mass if o.mass is not None else (o.density or 0) * volume.sum()
    if not np.isfinite(total):
        raise InputError(f"object {o.name!r}: its mass is not finite")
    if o.masses == "equal":
        own = splitter.nodes if splitter else len(mesh.rest)
        return np.where(np.arange(len(mesh.rest)) < own, total / own, 0.0)
    if mesh.quadratic is not None:
        nodes, share = mesh.quadratic, (total * volume[:, None] / volume.sum() * MASS_PARTS).ravel()
    else:
        nodes, share = mesh.tets, np.repeat(total * volume / volume.sum() / 4, 4)
    return np.bincount(nodes.ravel(), weights=share, minlength=len(mesh.rest)).astype(np.float64)
