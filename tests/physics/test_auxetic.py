# SPDX-License-Identifier: MIT
"""Poisson's ratio below 0: the laws that take it, and those that say why they do not."""

from functools import partial

import numpy as np
import pytest
from scipy.optimize import brentq

from tests.physics.laws import (
    Law,
    deform,
    error_of_forces,
    error_of_stiffness,
    forces,
    law_bar,
    odd_bar,
    reference_system,
    stiffness,
)  # fmt: skip
from tests.physics.test_forces import elastic_forces, stir
from tests.physics.test_system_matrix import frame
from tests.reference import hyperelastic as reference
from tests.scenes import bar, interior, jittered_bar, mesh_file, random_rotations, simulation, solid

SIZE = (1.2, 1.0, 0.8)
AFFINE = np.array([[1.1, 0.05, 0.0], [0.0, 0.95, 0.08], [0.02, 0.0, 1.04]])
INVERTED = random_rotations(1, seed=5)[0] @ np.diag([1.0, 0.9, -0.5])


def table(poisson):
    return {"young": 3e4, "poisson": poisson}


def laws(poisson):
    names = ("st_venant_kirchhoff", "stable_neo_hookean")
    return [Law(n, table(poisson), partial(getattr(reference, n), **table(poisson)), True) for n in names]


every_law = pytest.mark.parametrize("law", [*laws(-0.3), *laws(-0.7)], ids=lambda x: f"{x.name} {x.table['poisson']}")
ratios = pytest.mark.parametrize("poisson", [-0.3, -0.95])


@ratios
def test_patch_of_corotational_elements(tmp_path, poisson):
    mesh = mesh_file(tmp_path, *jittered_bar((4, 4, 4), SIZE, seed=1))
    sim = simulation(bar(mesh=mesh, young=2e5, poisson=poisson))
    inside = interior(sim.world.rest, SIZE)
    for F in (AFFINE, INVERTED):
        sim.world.x[:] = sim.world.rest @ F.T + [1.0, 2.0, 3.0]
        f = elastic_forces(sim)
        assert np.abs(f[inside]).max() < 1e-12 * 2e5 < 1e-3 * np.abs(f[~inside]).max()


@ratios
@pytest.mark.parametrize("size", [0.1, 0.25])
def test_corotational_elements_are_the_reference_and_their_matrix_is_definite(tmp_path, poisson, size):
    """At size 0.25 some elements are inverted."""
    mesh = mesh_file(tmp_path, *jittered_bar((3, 2, 2), SIZE, seed=2))
    for tangent in ("usual", "exact"):
        sim = simulation(bar(mesh=mesh, young=2e5, poisson=poisson, tangent=tangent), dt=0.1)
        stir(sim, size)
        sim.engine.assemble()
        expected, R, found = solid(sim), frame(sim), sim.matrix().toarray()
        assert np.linalg.eigvalsh(found)[0] > 0.999 * sim.world.mass.min()
        if tangent == "usual":
            A = expected.matrix()
            assert np.abs(found - R.T @ A @ R).max() < 1e-10 * np.abs(A).max()
        f = expected.forces()
        assert np.abs(elastic_forces(sim) - f).max() < 1e-12 * np.abs(f).max()


@every_law
@pytest.mark.parametrize("size", [0.1, 0.6])
def test_a_law_and_its_derivatives(tmp_path, law, size):
    """Energy, forces, stiffness: the reference's, each the slope of the one before. At 0.6 elements are inverted."""
    sim = odd_bar(tmp_path, law, projection="none")
    deform(sim, size, seed=2)
    energy, f, K = reference_system(sim, law)
    assert sim.potential_energy() == pytest.approx(energy, rel=1e-11) and energy > 0
    assert np.abs(forces(sim) - f).max() < 1e-11 * np.abs(f).max()
    assert np.abs(stiffness(sim) - K).max() < 1e-8 * np.abs(K).max()
    assert error_of_forces(sim) < 1e-6 and error_of_stiffness(sim) < 1e-5


@every_law
@pytest.mark.parametrize("projection", ["clamp", "absolute"])
def test_the_projected_stiffness_is_semidefinite(tmp_path, law, projection):
    sim = odd_bar(tmp_path, law, projection=projection)
    deform(sim, 0.6, seed=2)
    K, expected = stiffness(sim), reference_system(sim, law, projection)[2]
    assert np.abs(K - expected).max() < 1e-7 * np.abs(K).max()
    values = np.linalg.eigvalsh(K)
    assert values[0] > -1e-11 * values[-1]


@every_law
def test_patch_of_a_law(tmp_path, law):
    sim = law_bar(law, mesh_file(tmp_path, *jittered_bar((3, 3, 3), SIZE, seed=1)))
    inside = interior(sim.world.rest, SIZE)
    for F in (AFFINE, INVERTED):
        sim.world.x[:] = sim.world.rest @ F.T
        f = forces(sim)
        assert np.abs(f[inside]).max() < 1e-12 * np.abs(f).max() + 1e-12 * 3e4


@pytest.mark.parametrize("law", ["corotational", "st_venant_kirchhoff", "stable_neo_hookean"])
def test_a_pulled_bar_grows_thicker(law):
    """The strain across is 0.3 of that along the bar."""
    sim = law_bar(law, cells=(1, 1, 1), size=(1, 1, 1), table=table(-0.3))
    rest, strain = sim.world.rest, 1e-4

    def across(s):
        sim.world.x[:] = rest * [1 + strain, 1 + s, 1 + s]
        return forces(sim)[rest[:, 1] > 0.5, 1].sum()

    assert brentq(across, -strain, strain) == pytest.approx(0.3 * strain, rel=1e-3)


@pytest.mark.parametrize(("law", "poisson", "words"), [
    ("corotational", -1.0, r"must be greater than -1"),
    ("st_venant_kirchhoff", -1.0, r"must be greater than -1"),
    ("stable_neo_hookean", -0.81, r"must be greater than or equal to -0\.8"),
    ("neo_hookean", -0.1, r"must be 0 or more: below, lambda is negative.*stable_neo_hookean take"),
])  # fmt: skip
def test_what_is_refused(law, poisson, words):
    with pytest.raises(ValueError, match=words.replace("must be greater", "should be greater")):
        law_bar(law, table=table(poisson))
