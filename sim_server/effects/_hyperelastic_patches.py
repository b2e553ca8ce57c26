# SPDX-License-Identifier: MIT
"""Hyperelastic tetrahedra whose patches share the change of volume: `elements = "patch"` with laws of _hyperelastic.py.

These laws are a sum of W_s(I1, I2, J) and U(J), with U = b/2 ln^2 J, or b/2 (J - 1)^2 in stable_neo_hookean. W_s is the
law itself with such a bulk constant that its lambda of small strains is 0 (or lambda, where that is below 0), b is what
is left. Tetrahedra e have W_s of their own F, patches p of about eight of them (mesh/patches.py) U of one J, which is
the ratio of the patch's volume now to that at rest ::

    W = sum_e V W_s(F) + sum_p V_p U(J_p),   J_p = sum_e V J / V_p

so that where J is the same in a patch, W is the law's. W_s is kept, rather than the part of it that is without change
of volume, since its terms of J are what keeps single elements from being pressed flat; they are of the order of mu, and
do not lock. Forces and stiffness are those of elements with the law W_s + U'(J_p) J, and one matrix of rank one for
each patch ::

    K_ab = sum_e K_ab(W_s + U'(J_p) J) + sum_p V_p U''(J_p) g_p,a g_p,b^T,   g_p,a = sum_e V cof(F) D_a / V_p

Unless `[solver] projection` is "none", each element is made positive semi-definite by itself, as linear elements are,
and U'' is not below 0: a pressure that a patch as a whole would bear may so make the tangent a little stiffer. In a
patch with several constants, b is their mean by volume. Where U is not defined, J_p <= 0, some element is refused.

Source: as in _cells.py, and Pires, de Souza Neto and de la Cuesta Padilla, An assessment of the average nodal volume
formulation for the analysis of nearly incompressible solids under finite strains, 2004.
"""

from typing import Any

import numpy as np

from sim_server.arrays import Float64, Int32
from sim_server.backends.base import Launch
from sim_server.backends.energies import ElementEnergies
from sim_server.effects._hyperelastic import PROJECTIONS, Hyperelastic, Law, Values, lame
from sim_server.effects._patch_blocks import patch_blocks
from sim_server.mechanics.clusters import Clusters, PatchedTetrahedra, members, united
from sim_server.mechanics.system import Stencil, System
from sim_server.mechanics.world import Body, World
from sim_server.mesh.patches import patches
from sim_server.scene import Scene
from sim_server.scene.regions import region_numbers


class HyperelasticPatches(Hyperelastic):
    """Elements of one law in patches, and these. constants (k, m): of W_s.

    patch (m,): of each element; bulk, patch_volume (patches,): b [Pa], V_p [m3]. Results of a step: dilatation (m, 2);
    pressure (patches, 2); weight (patches,); areas (4, m, 3); patch_gradients (corners of patches, 4).
    """

    def __init__(self, world: World, listed: list[tuple[Body, Any]], law: Law):
        super().__init__(world, listed, law)
        m = len(self.elements)
        self._gather_patches(listed)
        count = len(self.patch_volume)
        self.bulk = world.follow(law.name, compute=self._bulk_of_patches)
        self.dilatation, self.pressure, self.weight = np.zeros((m, 2)), np.zeros((count, 2)), np.zeros(count)
        self.areas, self.patch_gradients = np.zeros((4, m, 3)), np.zeros((len(self._patches.nodes), 4))
        self._energy_dilatation, self._patch_energy = np.zeros(m), np.zeros(count)

    def _gather_patches(self, listed: list[tuple[Body, Any]]) -> None:
        """Makes patches, their members and the slots at their nodes."""
        m = len(self.elements)
        found = [_patches_of(self.law, body, params) for body, params in listed]
        counts = [int(number.max()) + 1 for number in found]
        before = np.cumsum([0, *counts]).astype(np.int32)
        number = np.concatenate([each + first for each, first in zip(found, before, strict=False)])
        self.patch: Int32 = number[self.order].astype(np.int32)
        self._patch_owner = np.repeat([body.index for body, _ in listed], counts)
        corners = (np.arange(4, dtype=np.int32) * np.int32(m) + np.arange(m, dtype=np.int32)[:, None]).ravel()
        starts = np.arange(0, 4 * m + 1, 4, dtype=np.int32)
        clusters = Clusters(starts, self.elements.ravel(), corners)
        self._patches, self._slot_start, slots = united(clusters, self.patch, int(before[-1]))
        self._slots: Int32 = clusters.slots[slots]
        self._patch_of_corner = self._patches.owner
        self._member_start, self._members = members(self.patch, int(before[-1]))
        self.patch_volume: Float64 = np.bincount(self.patch, self.volume).astype(np.float64)
        floor = np.zeros(len(self.patch_volume))
        floor[self.patch] = self.floor  # one in a body
        self.patch_floor = floor

    @property
    def coupled(self) -> PatchedTetrahedra:
        return PatchedTetrahedra(self.elements, self._patches)

    @property
    def element_nodes(self) -> list[Int32]:
        return [self.elements[:, 0], self._patches.first_nodes, self._patches.nodes]

    def packed(self, law: Law) -> Float64:
        """Returns the constants of W_s (k, m), which follow the scene."""

        def compute(scene: Scene) -> Float64:
            parts = []
            for values in self.values_in(scene, law):
                constants = np.stack(law.pack(values))
                constants[law.volumetric] -= bulk_of_patches(law, values)
                parts.append(constants)
            return np.concatenate(parts, axis=1)[:, self.order]

        constants: Float64 = self.world.follow(law.name, compute=compute)
        return constants

    def _bulk_of_patches(self, scene: Scene) -> Float64:
        bulk = np.concatenate([bulk_of_patches(self.law, values) for values in self.values_in(scene, self.law)])
        return np.bincount(self.patch, bulk[self.order] * self.volume) / self.patch_volume

    def launches(self, system: System, stencil: Stencil | None, accumulate: bool) -> list[Launch]:
        assert stencil is not None and stencil.patches is not None
        w = self.world
        elements = w.backend.module(self.path).bind(
            "elements", len(self.elements), projection=PROJECTIONS[w.projection], tets=self.elements, x=w.x,
            gradients=self.gradients, volume=self.volume, constants=self.constants, patch=self.patch,
            pressure=self.pressure, clock=system.clock, refused=self.refused, corners=self.corners, edges=self.edges,
            areas=self.areas, floor=self.floor, **self._of_a_step(),
        )  # fmt: skip
        gradients = w.backend.module(self.path_of_patches).bind(
            "gradients", len(self.patch_gradients), start=self._slot_start, slots=self._slots,
            patch=self._patch_of_corner, areas=self.areas, volume=self.patch_volume, weight=self.weight,
            patch_gradients=self.patch_gradients,
        )  # fmt: skip
        own, blocks = patch_blocks(w, system, stencil.patches, self.patch_gradients)
        forces, sums = self.gathers(system, stencil, accumulate)
        return [*self._measured(), elements, gradients, forces, own, sums, blocks]

    def force_launches(self, system: System, stencil: Stencil | None, frames: bool) -> list[Launch] | None:
        w, m = self.world, len(self.elements)
        if w.beta[self.owner].any():  # damping of the stiffness is a product with the tangent
            return None
        assert stencil is not None
        impulses = np.zeros((4, m, 3))
        w.backend.keep(impulses)
        forces = w.backend.module(self.path).bind(
            "forces", m, tets=self.elements, x=w.x, gradients=self.gradients, volume=self.volume, patch=self.patch,
            constants=self.constants, floor=self.floor, pressure=self.pressure, clock=system.clock,
            refused=self.refused, h=w.force_coefficient, impulses=impulses,
        )  # fmt: skip
        gather = w.backend.module("kernels/gather_forces.cu").bind(
            "gather_impulses", w.nodes, elements=m, start=stencil.corner_start, slots=stencil.corners,
            impulses=impulses, b=system.b,
        )  # fmt: skip
        return [*self._measured(), forces, gather]

    @property
    def path(self) -> str:
        return f"kernels/hyperelastic_cells.cu+effects/{self.law.name}.cuh"

    @property
    def path_of_patches(self) -> str:
        return f"kernels/hyperelastic_patches.cu+effects/{self.law.name}.cuh"

    def _measured(self) -> list[Launch]:
        """Returns the launches up to the pressures of patches."""
        w = self.world
        measure = w.backend.module(self.path).bind(
            "measure", len(self.elements), tets=self.elements, x=w.x, v=w.damping_velocity, gradients=self.gradients,
            volume=self.volume, dilatation=self.dilatation,
        )  # fmt: skip
        pressures = w.backend.module(self.path_of_patches).bind(
            "pressures", len(self.patch_volume), projection=PROJECTIONS[w.projection], **self._of_patches(),
            dilatation=self.dilatation, stiffness_coefficient=w.stiffness_coefficient(self._patch_owner),
            pressure=self.pressure, weight=self.weight,
        )  # fmt: skip
        return [measure, pressures]

    def _of_patches(self) -> dict[str, Any]:
        return {
            "start": self._member_start, "cells": self._members, "volume": self.patch_volume, "bulk": self.bulk,
            "floor": self.patch_floor,
        }  # fmt: skip

    def energies(self) -> ElementEnergies:
        """V W_s [J]; NaN where an element has a deformation that the law does not define."""
        launch = self.world.backend.module(self.path).bind(
            "energy", len(self.elements), tets=self.elements, x=self.world.x, gradients=self.gradients,
            volume=self.volume, constants=self.constants, floor=self.floor, dilatation=self._energy_dilatation,
            energy=self._energy,
        )  # fmt: skip
        return ElementEnergies(launch, self._energy, self.owner)

    def all_energies(self) -> list[ElementEnergies]:
        """These, and V_p U of the patches [J]."""
        launch = self.world.backend.module(self.path_of_patches).bind(
            "energy", len(self.patch_volume), dilatation=self._energy_dilatation, energy=self._patch_energy,
            **self._of_patches(),
        )  # fmt: skip
        return [self.energies(), ElementEnergies(launch, self._patch_energy, self._patch_owner)]


def bulk_of_patches(law: Law, values: Values) -> Float64:
    """Returns what patches have of the law's bulk constant, by its elements (m,) [Pa]: lambda, where it is above 0."""
    assert law.elastic is not None
    young, poisson = law.elastic(values)
    lam, _ = lame({"young": young, "poisson": poisson})
    return np.maximum(lam, 0)


def _patches_of(law: Law, body: Body, params: Any) -> Int32:
    """Returns the patch of each tetrahedron of a body; none has elements of two regions."""
    region = region_numbers(getattr(params, law.constants[0].name), body.centroids, body.mesh.elements_of)
    return patches(body.mesh.rest, body.mesh.tets, region)
