# SPDX-License-Identifier: MIT
"""Corotational elements whose patches share one dilatation: `elements` patch and smoothed."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.effects._cells import StrainCellElements
from sim_server.mesh.cell_builders import edge_cells, tetrahedron_cells
from sim_server.mesh.patches import patches
from sim_server.mesh.shape_functions import shape_gradients
from sim_server.mesh.strain_cells import DEVIATOR, DILATATION, StrainCells
from sim_server.simulation import Simulation
from tests.physics.test_forces import REGIONS, SIZE, stir
from tests.reference.strain_cells import CellSolid
from tests.scenes import bar, interior, jittered_bar, mesh_file, random_rotations, simulation

both = pytest.mark.parametrize("kind", ["patch", "smoothed"])  # built of linear tetrahedra
every_kind = pytest.mark.parametrize("kind", ["patch", "smoothed", "quadratic"])
BUILDERS = {"patch": tetrahedron_cells, "smoothed": edge_cells}
ROUNDING = 1e-11


def cells_of(kind: str, seed: int = 2) -> tuple[NDArray, NDArray, NDArray, StrainCells]:
    """Nodes, tetrahedra and regions of a bar of unequal elements, and its cells."""
    rest, tets = jittered_bar((3, 2, 2), SIZE, seed=seed)
    region = (rest[tets].mean(axis=1)[:, 0] > 0.9).astype(np.int32)
    return rest, tets, region, BUILDERS[kind](rest, tets, region)


def cell_bar(folder: Path, kind: str, **table) -> Simulation:
    solver = {k: table.pop(k) for k in ("dt", "warp", "gravity", "integrator", "preconditioner") if k in table}
    mesh = mesh_file(folder, *jittered_bar((3, 2, 2), SIZE, seed=2))
    given = {"young": REGIONS, "poisson": 0.3} | table
    return simulation(bar(mesh=mesh, elements=kind, **given), **solver)


def effect_of(sim: Simulation) -> StrainCellElements:
    return next(e for e in sim.effects.values() if isinstance(e, StrainCellElements))


def reference(sim: Simulation) -> CellSolid:
    effect = effect_of(sim)
    points = sim.world.bodies[0].elements == "quadratic"
    return CellSolid(effect.cells, *effect.elastic[0], points)


def forces(sim: Simulation) -> NDArray:
    """Elastic forces of the kernels at rest, (n, 3) [N]."""
    sim.world.v[:] = 0
    sim.engine.assemble()
    return sim.system.b / sim.world.force_coefficient


def tangent(sim: Simulation) -> NDArray:
    """-df/dx of the kernels in the world's frame, (3 n, 3 n)."""
    sim.engine.assemble()
    w, R = sim.world, np.kron(np.eye(sim.world.nodes), np.ones((3, 3)))
    R[R > 0] = sim.system.rotation.ravel()
    A = R @ sim.matrix().toarray() @ R.T
    return (A - np.diag(np.repeat(w.mass, 3))) / (w.force_coefficient * w.dx_dv)


@both
def test_cells_have_the_volume_and_the_gradients_of_the_mesh(kind):
    rest, tets, region, cells = cells_of(kind)
    volume, _ = shape_gradients(rest, tets)
    for role in (DEVIATOR, DILATATION):
        of_regions = np.bincount(region[cells.element], cells.volume * cells.has(role))
        np.testing.assert_allclose(of_regions, np.bincount(region, volume), rtol=1e-13)
    F = np.random.default_rng(1).normal(size=(3, 3))
    for c in range(len(cells.volume)):
        here = slice(cells.start[c], cells.start[c + 1])
        nodes, g = cells.nodes[here], cells.gradients[here]
        assert len(set(nodes)) == len(nodes)
        assert np.abs(g.sum(axis=0)).max() < 1e-13 * np.abs(g).max()
        np.testing.assert_allclose((rest[nodes] @ F.T + 3).T @ g, F, atol=1e-12)


@both
def test_patches_have_one_region_and_connected_cells(kind):
    _, _, region, cells = cells_of(kind)
    assert set(cells.patch) == set(range(cells.patches))
    for p in range(cells.patches):
        assert len(set(region[cells.element[cells.patch == p]])) == 1


def test_patches_are_of_about_eight_tetrahedra_and_connected():
    rest, tets = jittered_bar((6, 5, 4), (6, 5, 4), seed=1)
    number = patches(rest, tets, np.zeros(len(tets), np.int32))
    sizes = np.bincount(number)
    assert sizes.min() >= 4 and sizes.max() <= 14 and abs(sizes.mean() - 8) < 1
    again = patches(rest, tets, np.zeros(len(tets), np.int32))
    assert (number == again).all()
    for p in range(len(sizes)):
        mine, reached = set(np.flatnonzero(number == p)), [int(np.flatnonzero(number == p)[0])]
        for t in reached:
            reached += [u for u in mine if u not in reached and len(set(tets[t]) & set(tets[u])) == 3]
        assert set(reached) == mine


def test_parts_that_touch_nowhere_share_no_patch():
    rest, tets = jittered_bar((1, 1, 1), (1, 1, 1))
    two = np.concatenate([tets[:2], tets[:2] + len(rest)])
    number = patches(np.concatenate([rest, rest + 5]), two, np.zeros(4, np.int32))
    assert not set(number[:2]) & set(number[2:])


@every_kind
@pytest.mark.parametrize("size", [0.02, 0.3])
def test_forces_and_energy_are_the_reference_and_its_slope(tmp_path, kind, size):
    """With two regions, and elements turned over by the larger one."""
    sim = cell_bar(tmp_path, kind)
    stir(sim, size)
    solid, x = reference(sim), sim.world.x
    found, scale = forces(sim), np.abs(solid.forces(x)).max()
    assert np.abs(found - solid.forces(x)).max() < ROUNDING * scale
    assert abs(sim.potential_energy() - solid.energy(x)) < ROUNDING * solid.energy(x)
    direction = np.random.default_rng(4).normal(size=x.shape)
    step = 1e-6
    slope = (solid.energy(x + step * direction) - solid.energy(x - step * direction)) / (2 * step)
    assert abs(slope + (solid.forces(x) * direction).sum()) < 1e-6 * abs(slope)


@every_kind
@pytest.mark.parametrize("size", [0.02, 0.3])
@pytest.mark.parametrize("kind_of_tangent", ["usual", "exact"])
def test_the_matrix_is_the_reference_and_semi_definite(tmp_path, kind, size, kind_of_tangent):
    sim = cell_bar(tmp_path, kind, tangent=kind_of_tangent)
    stir(sim, size)
    found, expected = tangent(sim), reference(sim).tangent(sim.world.x, kind_of_tangent == "exact")
    assert np.abs(found - expected).max() < ROUNDING * np.abs(expected).max()
    assert np.abs(found - found.T).max() < 1e-12 * np.abs(found).max()
    assert np.linalg.eigvalsh(found)[0] > -1e-10 * np.abs(found).max()


@every_kind
def test_the_exact_tangent_is_the_slope_of_the_forces_under_tension(tmp_path, kind):
    sim = cell_bar(tmp_path, kind, tangent="exact")
    R = random_rotations(1, seed=3)[0]
    sim.world.x[:] = 1.3 * sim.world.rest @ R.T
    stir(sim, 0.01)
    K, solid, x = tangent(sim), reference(sim), sim.world.x
    exact = solid.tangent(x, True, -np.inf)
    direction = np.random.default_rng(5).normal(size=x.shape)
    slope = (solid.forces(x + 1e-6 * direction) - solid.forces(x - 1e-6 * direction)) / 2e-6
    assert np.abs(exact @ direction.ravel() + slope.ravel()).max() < 1e-6 * np.abs(slope).max()
    if kind == "smoothed":  # deviators and pressures are kept definite each for itself
        assert np.linalg.eigvalsh(K - exact)[0] > -1e-10 * np.abs(K).max()
    assert np.abs(K - exact).max() < (1e-2 if kind == "smoothed" else 1e-10) * np.abs(exact).max()


@every_kind
def test_rigid_motion_makes_no_force(tmp_path, kind):
    sim = cell_bar(tmp_path, kind)
    stretched = 1.01 * sim.world.rest
    sim.world.x[:] = stretched
    scale = np.abs(forces(sim)).max()
    sim.world.x[:] = sim.world.rest @ random_rotations(1, seed=8)[0].T + [3, -2, 1]
    assert np.abs(forces(sim)).max() < 1e-10 * scale


@every_kind
def test_a_linear_displacement_is_in_equilibrium_inside(tmp_path, kind):
    """The patch test: one material, any cells."""
    sim = cell_bar(tmp_path, kind, young=1e5, poisson=0.45)
    F = np.eye(3) + 0.1 * np.random.default_rng(2).normal(size=(3, 3))
    sim.world.x[:] = sim.world.rest @ F.T
    found, inside = forces(sim), interior(sim.world.rest, SIZE)
    assert inside.sum() >= 2 and np.abs(found[inside]).max() < 1e-10 * np.abs(found).max()
