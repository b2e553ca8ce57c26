# SPDX-License-Identifier: MIT
"""Hyperelastic elements in patches: energy, forces and stiffness, and what they have in common with other elements."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.effects._hyperelastic_patches import HyperelasticPatches
from sim_server.mesh.cell_builders import tetrahedron_cells
from sim_server.simulation import Simulation
from tests.physics.laws import (
    ELASTIC,
    LAWS,
    SIZE,
    Law,
    deform,
    determinants,
    elements,
    error_of_forces,
    error_of_stiffness,
    forces,
    odd_bar,
    stiffness,
)  # fmt: skip
from tests.reference import hyperelastic as reference
from tests.reference.strain_cells import CellSolid
from tests.scenes import interior, random_rotations

PATCHED = {
    name: law
    for name, law in LAWS.items()
    if law.name in ("neo_hookean", "stable_neo_hookean", "mooney_rivlin", "arruda_boyce", "veronda_westmann")
}
STATES = {
    f"{name} {size}": (law, size) for name, law in PATCHED.items() for size in ((0.1, 0.6) if law.inverts else (0.18,))
}
every_law = pytest.mark.parametrize("law", PATCHED.values(), ids=PATCHED.keys())
every_state = pytest.mark.parametrize(("law", "size"), STATES.values(), ids=STATES.keys())


def patched(folder: Path, law: Law, cells: tuple[int, int, int] = (2, 2, 1), **scene: Any) -> Simulation:
    """A bar of unequal elements in patches, all nodes free."""
    return odd_bar(folder, law, cells, elements="patch", **scene)


def effect_of(sim: Simulation) -> HyperelasticPatches:
    found = elements(sim)
    assert isinstance(found, HyperelasticPatches)
    return found


def stirred(folder: Path, law: Law, size: float, **scene: Any) -> Simulation:
    """Random positions and velocities; at size 0.6 some elements are inside out."""
    sim = patched(folder, law, **scene)
    deform(sim, size, seed=2)
    J = determinants(sim)
    assert (J.min() < -0.2 and (J < 0).sum() > 1) if size > 0.5 else J.min() > 0.25
    return sim


def bulk_and_shear(law: Law) -> tuple[float, float]:
    """Bulk modulus and shear modulus of a law at small strains [Pa], by the formulas of their files."""
    t = law.table
    if law.name == "mooney_rivlin":
        return t["bulk"], 2 * (t["c1"] + t["c2"])
    if law.name == "veronda_westmann":
        return t["bulk"], t["c1"] * t["c2"]
    if law.name == "arruda_boyce":
        terms = (i * a * (3 / t["segments"]) ** (i - 1) for i, a in enumerate(reference.CHAIN, 1))
        return t["bulk"], 2 * t["shear"] * sum(terms)
    lam, mu = reference.lame(t["young"], t["poisson"])
    return lam + 2 / 3 * mu, mu


def energy(sim: Simulation, law: Law) -> float:
    """By the reference: V W_s of elements, whose Poisson's ratio at small strains is 0, and V_p U of patches."""
    bulk, shear = bulk_and_shear(law)
    own = {"bulk": 2 / 3 * shear} if "bulk" in law.table else {"young": 2 * shear, "poisson": 0.0}
    lam, total = bulk - 2 / 3 * shear, 0.0
    effect, x, rest = effect_of(sim), sim.world.x, sim.world.rest
    now, volume = np.zeros(effect.patch.max() + 1), np.zeros(effect.patch.max() + 1)
    for p, tet in zip(effect.patch, effect.elements, strict=True):
        X = (rest[tet[1:]] - rest[tet[0]]).T
        F = (x[tet[1:]] - x[tet[0]]).T @ np.linalg.inv(X)
        V = np.linalg.det(X) / 6
        total += V * law.W(F, **own)
        now[p] += V * np.linalg.det(F)
        volume[p] += V
    floor = law.table.get("floor", 0.0)
    for J, V in zip(now / volume, volume, strict=True):
        logarithm = reference.regularized_logarithm(floor, J) if floor else np.log(J)
        total += V * lam / 2 * (J - 1 if law.name == "stable_neo_hookean" else logarithm) ** 2
    return total


@every_state
def test_the_energy_is_that_of_the_reference(tmp_path, law, size):
    sim = stirred(tmp_path, law, size)
    assert 1 < len(effect_of(sim).patch_volume) < len(effect_of(sim).elements) / 4
    assert sim.potential_energy() == pytest.approx(energy(sim, law), rel=1e-11)


@every_state
def test_forces_are_minus_the_slope_of_the_energy(tmp_path, law, size):
    assert error_of_forces(stirred(tmp_path, law, size)) < 1e-8


@every_state
def test_the_stiffness_is_minus_the_slope_of_the_forces(tmp_path, law, size):
    assert error_of_stiffness(stirred(tmp_path, law, size, projection="none")) < 1e-7


@every_state
@pytest.mark.parametrize("projection", ["clamp", "absolute", "excess"])
def test_projected_stiffness_is_symmetric_and_semidefinite(tmp_path, law, size, projection):
    K = stiffness(stirred(tmp_path, law, size, projection=projection))
    assert np.abs(K - K.T).max() < 1e-14 * np.abs(K).max()
    values = np.linalg.eigvalsh(K)
    assert values[0] > -1e-11 * values[-1]
    moved = np.tile(np.eye(3), (len(K) // 3, 1))
    assert np.abs(K @ moved).max() < 1e-12 * np.abs(K).max()


@every_law
def test_rigid_motion_makes_no_force(tmp_path, law):
    sim = patched(tmp_path, law)
    sim.world.x[:] = 1.01 * sim.world.rest
    scale = np.abs(forces(sim)).max()
    sim.world.x[:] = sim.world.rest @ random_rotations(1, seed=8)[0].T + [3, -2, 1]
    assert np.abs(forces(sim)).max() < 1e-10 * scale


@every_law
@pytest.mark.parametrize("stretch", [1.0, 0.6])
def test_where_all_elements_deform_alike_they_are_linear_elements(tmp_path, law, stretch):
    """The patch test, at large strains, and below the floor of J."""
    found = []
    for kind in ("patch", "linear"):
        sim = odd_bar(tmp_path, law, (3, 2, 2), elements=kind)
        F = stretch * (np.eye(3) + 0.2 * np.random.default_rng(2).normal(size=(3, 3)))
        sim.world.x[:] = sim.world.rest @ F.T
        found.append((forces(sim).copy(), sim.potential_energy()))
    inside = interior(sim.world.rest, SIZE)
    scale = np.abs(found[1][0]).max()
    assert inside.sum() >= 2 and np.abs(found[0][0][inside]).max() < 1e-10 * scale
    assert np.abs(found[0][0] - found[1][0]).max() < 1e-10 * scale
    assert found[0][1] == pytest.approx(found[1][1], rel=1e-10)


class KeepsMu(CellSolid):
    """Corotational patches whose cells have mu alone: lambda is that of the patches."""

    @property
    def own(self) -> NDArray[np.float64]:
        return 0 * self.mu


@every_law
def test_at_rest_the_stiffness_is_that_of_the_linear_theory(tmp_path, law):
    sim = patched(tmp_path, law, projection="none")
    mesh, elastic = sim.world.bodies[0].mesh, effect_of(sim).elastic[0]
    solid = KeepsMu(tetrahedron_cells(mesh.rest, mesh.tets, np.zeros(len(mesh.tets), np.int32)), *elastic)
    K, expected = stiffness(sim), solid.tangent(sim.world.rest, False)
    assert np.abs(K - expected).max() < 1e-10 * np.abs(K).max()


def test_patches_stay_in_their_regions_of_constants(tmp_path):
    """Of two regions the energy is the sum."""
    law, given = PATCHED["neo_hookean"], [{"where": "X < 0.8", "young": 2e4, "poisson": 0.2}, ELASTIC]
    sim = stirred(tmp_path, replace(law, table={"young": given}), 0.18)
    effect, rest = effect_of(sim), sim.world.rest
    left = rest[effect.elements].mean(axis=1)[:, 0] < 0.8
    assert 0 < left.sum() < len(left)
    assert not set(effect.patch[left]) & set(effect.patch[~left])
    lam = np.array([reference.lame(2e4, 0.2)[0], reference.lame(**ELASTIC)[0]])
    np.testing.assert_allclose(effect.bulk[effect.patch], np.where(left, *lam), rtol=1e-13)


def test_an_auxetic_material_leaves_its_patches_nothing(tmp_path):
    """Below 0 lambda stays with the elements, and the energy is that of linear ones."""
    law = replace(PATCHED["stable_neo_hookean"], table={"young": 1e4, "poisson": -0.3})
    found = []
    for kind in ("patch", "linear"):
        sim = odd_bar(tmp_path, law, (2, 2, 1), elements=kind)
        deform(sim, 0.3, seed=2)
        found.append((forces(sim).copy(), sim.potential_energy()))
    assert np.abs(found[0][0] - found[1][0]).max() < 1e-12 * np.abs(found[1][0]).max()
    assert found[0][1] == pytest.approx(found[1][1], rel=1e-12)
