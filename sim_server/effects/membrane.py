# SPDX-License-Identifier: MIT
"""Elastic membranes on the surface of an object: capsules of organs, skins, walls of balloons, coatings.

A membrane is as thin as a surface: it bears forces in its plane, and bends freely. It lies on the triangles of the
surface all of whose nodes are in `where` (without it on the whole outside), and moves with their nodes. Its material is
the compressible neo-Hookean solid of neo_hookean in plane stress. With the deformation gradient F (3x2) of a triangle,
I1 = tr F^T F, J = sqrt(det F^T F), its ratio of areas, and the stretch e^z across it::

    W = mu/2 (I1 + e^2z - 3) - mu (ln J + z) + lambda/2 (ln J + z)^2,    mu = E / (2 (1 + nu))

where z makes the stress across the membrane vanish, (1 - 2 nu) (e^2z - 1) + 2 nu (ln J + z) = 0. `poisson` = 0.5 is
allowed: then W = mu/2 (I1 + 1/J^2 - 3). The energy is W times `thickness` times the area at rest. At small strains it
is Hooke's law in plane stress: E t / (1 - nu^2) against stretching. Below J = 0.05 ln J goes on as a parabola.

`prestretch` is how much longer the membrane is in the object's rest shape, in all directions, than without stress:
above 1 it presses on what it encloses, as a capsule does. `thickness` is that without stress. `density` adds its mass
to the nodes.

The stiffness matrix has blocks of 3x3 between the corners of a triangle. It is the exact tangent where the membrane is
stretched. Where it is compressed, the negative eigenvalues of d2W/dF2, by which it would wrinkle, are left out, so that
A stays positive definite; the forces are exact, but Newton-Raphson needs more iterations. There are no wrinkles finer
than the triangles. Bending is left out: that of a capsule, E t^3 / 12 (1 - nu^2), is far below what the elements under
it bear, and sums of squared angles between triangles, which keep A positive definite, are right for special meshes
only. Where a plate is to bend, make it of elements.

Usual ranges: capsule of the liver young 1 to 10 MPa, thickness 0.05 to 0.2 mm; skin 0.1 to 1 MPa, 1 to 2 mm; rubber
1 MPa, 0.1 to 2 mm; prestretch 1 to 1.3.

Sources: Bonet and Wood, Nonlinear Continuum Mechanics for Finite Element Analysis, 2nd edition, 2008, section 6.4.3
(the law); Smith, de Goes and Kim, Analytic eigensystems for isotropic distortion energies, 2019, and Kim, A finite
element formulation of Baraff-Witkin cloth, 2020 (eigenvalues, of 3x2 F, too); Umale et al., Experimental mechanical
characterization of abdominal organs: liver, kidney and spleen, 2013 (capsules).
"""

from typing import Annotated, Any

import numpy as np
from pydantic import Field

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.effects._base import Effect
from sim_server.effects._surfaces import Surfaces
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.scene import Scene
from sim_server.scene.live import STIFFNESS, Live
from sim_server.scene.parameters import Parameters, Positive, Where

SCOPE = "object"
TEXT = "effects/membrane.cu"


class Params(Parameters):
    young: Annotated[Positive, STIFFNESS] = Field(description="Young's modulus [Pa]")
    poisson: Annotated[float, Live(0, 0.5)] = Field(ge=0, le=0.5, description="Poisson's ratio [-]")
    thickness: Annotated[Positive, Live(0.1, 10, logarithmic=True, relative=True)] = Field(
        description="without stress [m]"
    )
    where: Where | None = Field(
        default=None, description="triangles of the surface, by their nodes; without it the whole outside"
    )
    prestretch: Annotated[float, Live(0.8, 1.5)] = Field(
        default=1.0, ge=0.5, le=2, description="lengths at rest over those without stress [-]"
    )
    density: Positive | None = Field(default=None, description="adds its mass to the object [kg/m3]")


class Membrane(Effect):
    """Membranes of all bodies that list the effect.

    elements (m, 4): corners of the triangles, the first again as the fourth, which has no part in anything.
    gradients (4, m) [1/m], volume (m,) [m3], constants (2, m): as in membrane.cu, whose results are corners (4, m, 9)
    and edges (6, m, 9)
    """

    holds = False

    def __init__(self, world: World, listed: list[tuple[Body, Any]]):
        self.world = world
        surfaces = Surfaces(world, "membrane", listed)
        triangles, rest = surfaces.corners, world.rest
        self.elements: Int32 = np.ascontiguousarray(triangles[:, [0, 1, 2, 0]])
        self.owner = world.body_of(triangles[:, 0]).astype(np.int64)
        area, flat = _flattened(rest[triangles])
        given = surfaces.of_triangles(lambda p: [p.young, p.poisson, p.thickness, p.prestretch])

        def constants(scene: Scene) -> Float64:
            young, poisson, _, _ = given(scene).T
            return np.stack([young / (2 * (1 + poisson)), poisson])

        def volume(scene: Scene) -> Float64:
            _, _, thickness, prestretch = given(scene).T
            return np.asarray(area * thickness / prestretch**2)

        self.constants = world.follow("membrane", compute=constants)
        self.volume = world.follow("membrane", compute=volume)
        self.gradients = world.follow("membrane", compute=lambda scene: flat * given(scene)[:, 3])
        density = world.at_start(surfaces.of_triangles(lambda p: [p.density or 0.0]))[:, 0]
        np.add.at(world.mass, triangles, (density * self.volume / 3)[:, None])
        m = len(triangles)
        self.corners, self.edges, self._energy = np.zeros((4, m, 9)), np.zeros((6, m, 9)), np.zeros(m)

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        assert stencil is not None
        w, m = self.world, len(self.elements)
        elements = w.backend.module(TEXT).bind(
            "elements", m, corner=self.elements, x=w.x, v=w.damping_velocity, gradients=self.gradients,
            volume=self.volume, constants=self.constants, h=w.force_coefficient,
            stiffness_coefficient=w.stiffness_coefficient(self.owner), corners=self.corners, edges=self.edges,
        )  # fmt: skip
        gather = w.backend.module("kernels/gather_forces.cu").bind(
            "gather", w.nodes, elements=m, start=stencil.corner_start, slots=stencil.corners, rows=self.corners,
            b=system.b, block=system.block,
        )  # fmt: skip
        blocks = w.backend.module("kernels/gather_blocks.cu").bind(
            "gather", len(system.sums), elements=m, accumulate=int(accumulate), start=stencil.pair_start,
            pairs=stencil.pairs, edges=self.edges, sums=system.sums,
        )  # fmt: skip
        return [elements, gather, blocks]

    def energies(self) -> ElementEnergies:
        """Volume times W [J]."""
        launch = self.world.backend.module(TEXT).bind(
            "energy", len(self.elements), corner=self.elements, x=self.world.x, gradients=self.gradients,
            volume=self.volume, constants=self.constants, energy=self._energy,
        )  # fmt: skip
        return ElementEnergies(launch, self._energy, self.owner)


def _flattened(corners: Float64) -> tuple[Float64, Float64]:
    """Returns areas (m,) [m2] of triangles (m, 3, 3), and rest gradients of corners 1 and 2 in the plane of each,
    along its edge 01 and across it, (4, m) [1/m]."""
    first, second = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    base, area = np.linalg.norm(first, axis=1), np.linalg.norm(np.cross(first, second), axis=1) / 2
    along, height = (first * second).sum(axis=1) / base, 2 * area / base
    zero = np.zeros(len(base))
    return area, np.stack([1 / base, -along / (base * height), zero, 1 / height])


def build(world: World, listed: list[tuple[Body, Any]]) -> Membrane:
    """The membranes of the listed objects; raises InputError for a part of a surface without triangles."""
    return Membrane(world, listed)
