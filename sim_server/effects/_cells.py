# SPDX-License-Identifier: MIT
"""Corotational strain cells in patches: what corotational.py makes of bodies whose elements are not linear.

A cell c has one deformation gradient F = sum_a x_a (x) G_a over its nodes, R the rotation nearest to F = R S, volume V;
a patch p of cells one mean dilatation (mesh/strain_cells.py). The energy is ::

    W = sum_c V (mu |S - I|^2 + lambda_c / 2 tr(S - I)^2) + sum_p kappa / 2 V_p theta_p^2

    theta_p = sum_c V tr(S - I) / V_p

with kappa = lambda - lambda_c, in a patch with several constants their mean by volume. With lambda_c = -2/3 mu cells
have energy of their deviators alone: so in patches of tetrahedra. Points of quadratic elements keep lambda_c =
min(lambda, mu): without, an element resists none of the three quadratic motions whose strain is a multiple of I that
is 0 on average, and meshes of few elements across are too soft; with it they lock no more. Forces are its slope ::

    f_a = -sum_c V R (2 mu (S - I) + (lambda_c tr(S - I) + kappa theta_p) I) G_a

and the usual tangent, with R held, is that of the cells and one matrix of rank one for each patch, g_a = R G_a ::

    K_ab = sum_c V (mu (g_b g_a^T + (g_a . g_b) I) + lambda_c g_a g_b^T) + sum_p kappa V_p g_p,a g_p,b^T

with g_p,a = sum_c V R G_a / V_p, positive semi-definite as it is. The exact one adds the twists of each cell, as in
corotational.py with the pressure p = kappa theta_p + lambda_c tr(S - I) in the place of lambda tr(S - I).

Of `smoothed` elements cells around edges have the deviators, and theta_p is of one cell that is the whole patch
(mesh/cell_builders.py). The twists of each are kept from being negative by themselves, so that the exact tangent is a
little stiffer than the forces.

Source: Bonet and Burton, A simple average nodal pressure tetrahedral element, 1998; de Souza Neto, Andrade Pires and
Owen, F-bar-based linear triangles and tetrahedra (patches), 2005.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim_server.arrays import Float64, Int32, Int64
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.backends.state import rows_in
from sim_server.effects._base import Effect, PerBody
from sim_server.effects._patch_blocks import patch_blocks
from sim_server.mechanics.clusters import PatchedCells, members, sliced, united
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.mesh.cell_builders import edge_cells, tetrahedron_cells
from sim_server.mesh.quadratic_cells import quadratic_cells
from sim_server.mesh.strain_cells import DEVIATOR, DILATATION, StrainCells, joined
from sim_server.scene import Scene
from sim_server.scene.regions import region_numbers

Constants = tuple[Float64, Float64]
TEXT, PATCHES, SUMS = (f"effects/corotational_{name}.cu" for name in ("cells", "patches", "cell_sums"))


@dataclass(frozen=True)
class Lists:
    """Lists that kernels gather by: start (n + 1,) into cells, and slots of these."""

    start: Int32
    cells: Int32
    slots: Int32


class StrainCellElements(Effect):
    """Strain cells of all bodies that list the effect with one kind of tangent, body after body.

    elements (m, 4): tetrahedra of the bodies; cells: of all bodies, with nodes of the scene and elements as numbered
    here; owner (cells,): index of the body. Results of a step: quaternion (cells, 4); strain (15, cells), dilatation
    (cells, 2); mean_dilatation (patches, 2); at slots (mechanics/clusters.py) scaled_gradients (slots, 4) and
    nodal_impulse (slots, 3) [N s]; twist (cells, 6), of the exact tangent; patch_gradients (corners, 4).
    """

    def __init__(
        self, world: World, listed: list[tuple[Body, Any]], constants: Callable[[Body, Any], Constants]
    ):  # fmt: skip
        self.world, self.exact = world, listed[0][1].tangent == "exact"
        self.rotated = tuple(body for body, _ in listed)
        self.elements: Int32 = np.concatenate([body.tets for body in self.rotated])
        self._constants = PerBody("corotational", self.rotated, constants)
        self.elastic = world.at_start(self.elastic_in)
        parts = [cells_of(body, params) for body, params in listed]
        self.cells = joined(parts, [(body.first, len(body.tets)) for body in self.rotated])
        counts = [len(part.volume) for part in parts]
        self.owner = _owner(self.rotated, counts)
        self._keeps_lambda = np.repeat([body.elements == "quadratic" for body in self.rotated], counts)
        self._patch_owner = _owner(self.rotated, [part.patches for part in parts])
        self._lay_out()
        self._follow()
        m, slots = len(self.cells.volume), len(self.slices.nodes)
        self.quaternion, self.near = np.zeros((m, 4)), np.zeros((m, 4))  # near: of `forces`, begun at its last ones
        self.strain, self.dilatation = np.zeros((15, m)), np.zeros((m, 2))
        self.mean_dilatation = np.zeros((self.cells.patches, 2))
        self.scaled_gradients, self.nodal_impulse = np.zeros((slots, 4)), np.zeros((slots, 3))
        self.twist = np.zeros((m if self.exact else 0, 6))
        self.patch_gradients = np.zeros((len(self._coupled.patches.nodes), 4))
        self._energy, self._patch_energy = np.zeros(m), np.zeros(self.cells.patches)
        self._energy_dilatation = np.zeros(m)

    def _lay_out(self) -> None:
        """Makes slices, patches and the lists of both."""
        cells = self.cells
        self.slices = sliced(cells.start, cells.nodes, cells.gradients)
        strained, dilating = cells.has(DEVIATOR), cells.has(DILATATION)
        clusters = self.slices.clusters.taken(dilating)
        patches, start, corners = united(clusters, cells.patch, cells.patches)
        alone = self.slices.clusters.taken(dilating & ~strained)
        self._coupled = PatchedCells(self.slices.clusters.taken(strained), patches, alone)
        self._corners = Lists(start, clusters.owner[corners], clusters.slots[corners])
        start, order = members(cells.patch[dilating], cells.patches)
        self._members = Lists(start, np.flatnonzero(dilating)[order].astype(np.int32), np.zeros(0, np.int32))
        self.volume = cells.volume * dilating
        self.patch_volume = np.bincount(cells.patch, self.volume, cells.patches)
        self.inverse_volume = 1 / self.patch_volume

    def _follow(self) -> None:
        """Makes the arrays that follow the material constants."""
        cells, volume = self.cells, self.cells.volume
        strained = cells.has(DEVIATOR)

        def constants(scene: Scene) -> tuple[Float64, Float64, Float64]:
            """mu of the cells, kappa of the patches and lambda_c of the cells [Pa]."""
            young, poisson = np.concatenate([*self.elastic_in(scene).values()], axis=1)[:, cells.element]
            mu, whole = young / (2 * (1 + poisson)), young * poisson / ((1 + poisson) * (1 - 2 * poisson))
            own = np.where(self._keeps_lambda, np.minimum(whole, mu), -2 / 3 * mu)
            kappa = np.bincount(cells.patch, self.volume * (whole - own), cells.patches)
            return mu, kappa / self.patch_volume, own

        def moduli(scene: Scene) -> Float64:
            mu, kappa, own = constants(scene)
            return np.stack([mu * strained, kappa[cells.patch] * cells.has(DILATATION), own * strained, mu]) * volume

        def share(scene: Scene) -> Float64:
            mu, kappa, _ = constants(scene)
            return np.sqrt(kappa[cells.patch] * volume / (mu * self.patch_volume[cells.patch]))

        follow = self.world.follow
        self.moduli, self.share = (follow("corotational", compute=made) for made in (moduli, share))
        self.stiffness = follow("corotational", compute=lambda scene: constants(scene)[1] / self.patch_volume)

    @property
    def coupled(self) -> PatchedCells:
        return self._coupled

    @property
    def element_nodes(self) -> list[Int32]:
        cells, patches = self.slices.clusters, self._coupled.patches
        return [cells.first_nodes, patches.first_nodes, patches.nodes]

    def rows_of_bodies(self, array: NDArray[Any]) -> Callable[[int], Any] | None:
        return rows_in(self.owner) if array is self.near or array is self.quaternion else None

    def elastic_in(self, scene: Scene) -> Mapping[int, Constants]:
        return {body.index: found for body, found in zip(self.rotated, self._constants(scene), strict=True)}

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        assert stencil is not None and stencil.patches is not None
        w = self.world
        exact = self.exact and not w.usual_tangent
        twist = {"twist": self.twist} if exact else {}
        elements = w.backend.module(TEXT).bind(
            "exact_elements" if exact else "elements", len(self.owner), scaled_gradients=self.scaled_gradients,
            **self._of_elements(self.quaternion), **twist,
        )  # fmt: skip
        gradients = w.backend.module(PATCHES).bind(
            "gradients", len(self.patch_gradients), start=self._corners.start, slots=self._corners.slots,
            cells=self._corners.cells, scaled_gradients=self.scaled_gradients, share=self.share,
            patch_gradients=self.patch_gradients,
        )  # fmt: skip
        gather = w.backend.module(SUMS).bind(
            "gather_exact" if exact else "gather", w.nodes, start=stencil.corner_start, corners=stencil.corners,
            owners=stencil.corner_owners, nodal_impulse=self.nodal_impulse, scaled_gradients=self.scaled_gradients,
            quaternion=self.quaternion, b=system.b, block=system.block, mean=system.mean, **twist,
        )  # fmt: skip
        owners = {"owners": stencil.pair_owners, **twist} if exact else {}
        blocks = w.backend.module(SUMS).bind(
            "blocks_exact" if exact else "blocks", len(system.sums), accumulate=int(accumulate),
            start=stencil.pair_start, pairs=stencil.pairs, scaled_gradients=self.scaled_gradients, sums=system.sums,
            **owners,
        )  # fmt: skip
        own, of_patches = patch_blocks(w, system, stencil.patches, self.patch_gradients)
        forces = [*self._measured("measure", self.quaternion), elements, gradients, gather]
        return [*forces, own, blocks, of_patches, *self._of_dilating(system, stencil.dilating, exact)]

    def _of_dilating(self, system: System, stencil: Stencil | None, exact: bool) -> list[Launch]:
        """Returns the gathers of cells that have a dilatation alone."""
        if stencil is None:
            return []
        w, lists = self.world, {"start": stencil.corner_start, "corners": stencil.corners}
        if not exact:
            module = w.backend.module("effects/corotational_nodes.cu")
            return [module.bind("gather_impulses", w.nodes, nodal_impulse=self.nodal_impulse, b=system.b, **lists)]
        sums, twist = w.backend.module(SUMS), {"twist": self.twist, "scaled_gradients": self.scaled_gradients}
        gather = sums.bind(
            "gather_twists", w.nodes, owners=stencil.corner_owners, nodal_impulse=self.nodal_impulse, b=system.b,
            block=system.block, **lists, **twist,
        )  # fmt: skip
        blocks = sums.bind(
            "twist_blocks", len(system.sums), start=stencil.pair_start, pairs=stencil.pairs,
            owners=stencil.pair_owners, sums=system.sums, **twist,
        )  # fmt: skip
        return [gather, blocks]

    def force_launches(self, system: System, stencil: Stencil | None, frames: bool) -> list[Launch] | None:
        assert stencil is not None
        w = self.world
        damped = self.exact and w.beta[self.owner].any()  # by the tangent: without it both have one force
        impulses = w.backend.module(TEXT).bind(
            "impulses", len(self.owner), exact=int(damped), **self._of_elements(self.near)
        )  # fmt: skip
        lists = {"start": stencil.corner_start, "corners": stencil.corners, "nodal_impulse": self.nodal_impulse}
        if frames:
            gather = w.backend.module(SUMS).bind(
                "gather_frames", w.nodes, owners=stencil.corner_owners, quaternion=self.near, b=system.b,
                mean=system.mean, **lists,
            )  # fmt: skip
        else:
            gather = w.backend.module("effects/corotational_nodes.cu").bind(
                "gather_impulses", w.nodes, b=system.b, **lists
            )  # fmt: skip
        others = self._of_dilating(system, stencil.dilating, exact=False)
        return [*self._measured("measure_near", self.near), impulses, gather, *others]

    def _measured(self, kernel: str, quaternion: Float64) -> list[Launch]:
        """Returns the launches up to the mean dilatations."""
        w = self.world
        measure = w.backend.module(TEXT).bind(
            kernel, len(self.owner), nodes=self.slices.nodes, x=w.x, v=w.damping_velocity, volume=self.volume,
            quaternion=quaternion, strain=self.strain, dilatation=self.dilatation, **self._of_slices(),
        )  # fmt: skip
        means = w.backend.module(PATCHES).bind(
            "means", self.cells.patches, start=self._members.start, cells=self._members.cells,
            dilatation=self.dilatation, inverse_volume=self.inverse_volume, mean_dilatation=self.mean_dilatation,
        )  # fmt: skip
        return [measure, means]

    def _of_slices(self) -> dict[str, Any]:
        s = self.slices
        return {"slots": len(s.nodes), "first": s.first, "width": s.width, "gradients": s.gradients}

    def _of_elements(self, quaternion: Float64) -> dict[str, Any]:
        """Arguments of what makes nodal impulses."""
        w = self.world
        return {
            **self._of_slices(), "patch": self.cells.patch, "mean_dilatation": self.mean_dilatation,
            "moduli": self.moduli, "stiffness_coefficient": w.stiffness_coefficient(self.owner),
            "h": w.force_coefficient, "quaternion": quaternion, "strain": self.strain,
            "nodal_impulse": self.nodal_impulse,
        }  # fmt: skip

    def energies(self) -> ElementEnergies:
        """What the cells have by themselves [J]."""
        launch = self.world.backend.module(TEXT).bind(
            "energy", len(self.owner), nodes=self.slices.nodes, x=self.world.x, volume=self.volume,
            moduli=self.moduli, dilatation=self._energy_dilatation, energy=self._energy, **self._of_slices(),
        )  # fmt: skip
        return ElementEnergies(launch, self._energy, self.owner)

    def all_energies(self) -> list[ElementEnergies]:
        """These, and kappa V_p theta_p^2 / 2 of the patches [J]."""
        launch = self.world.backend.module(PATCHES).bind(
            "energy", self.cells.patches, start=self._members.start, cells=self._members.cells,
            dilatation=self._energy_dilatation, stiffness=self.stiffness, energy=self._patch_energy,
        )  # fmt: skip
        return [self.energies(), ElementEnergies(launch, self._patch_energy, self._patch_owner)]


def cells_of(body: Body, params: Any) -> StrainCells:
    """Strain cells of a body, in an order that keeps neighbours near in memory."""
    mesh = body.mesh
    if body.elements == "quadratic":
        assert mesh.quadratic is not None
        return quadratic_cells(mesh.rest, mesh.quadratic).in_order()
    region = region_numbers(params.young, body.centroids, body.mesh.elements_of)
    make = edge_cells if body.elements == "smoothed" else tetrahedron_cells
    return make(mesh.rest, mesh.tets, region).in_order()


def _owner(bodies: tuple[Body, ...], counts: list[int]) -> Int64:
    return np.repeat([body.index for body in bodies], counts)
