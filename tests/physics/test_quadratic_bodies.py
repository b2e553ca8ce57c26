# SPDX-License-Identifier: MIT
"""Corotational bodies of quadratic tetrahedra."""

from pathlib import Path

import meshio
import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.mesh.quadratic_cells import quadratic_cells
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.mesh.test_quadratic_mesh import jittered
from tests.physics.test_forces import REGIONS, stir
from tests.physics.test_strain_cells import forces, reference, tangent
from tests.reference.quadratic import displacement, frequencies, stiffness
from tests.scenes import bar, random_rotations, simulation

ROUNDING = 1e-11
SIZE = (2.0, 1.0, 1.0)
DIRECT = {"preconditioner": "cholesky", "update": "every-1", "factor_precision": "float64"}


def quadratic_bar(folder: Path, curved: float = 0.05, **table) -> Simulation:
    """A bar of 4 x 2 x 2 cells with nodes inside moved at random and curved edges."""
    solver = {k: table.pop(k) for k in ("dt", "warp", "gravity", "integrator", "preconditioner") if k in table}
    mesh = jittered((4, 2, 2), curved=curved)
    meshio.write(folder / "q.vtu", meshio.Mesh(mesh.rest, [("tetra10", mesh.quadratic)]))
    given = {
        "elements": "auto",
        "young": REGIONS,
        "poisson": 0.45,
        "mesh": {"file": str(folder / "q.vtu"), "scale": 0.5},
    } | table
    return simulation(bar(**given), **solver)


@pytest.mark.parametrize("poisson", [-0.3, 0.1, 0.45])
@pytest.mark.parametrize("size", [0.02, 0.2])
def test_forces_and_energy_are_the_reference_and_its_slope(tmp_path, poisson, size):
    """Where all of lambda is of the points, and where most of it is of the mean."""
    sim = quadratic_bar(tmp_path, poisson=poisson, young=1e5)
    stir(sim, size)
    solid, x = reference(sim), sim.world.x
    expected = solid.forces(x)
    assert np.abs(forces(sim) - expected).max() < ROUNDING * np.abs(expected).max()
    assert abs(sim.potential_energy() - solid.energy(x)) < ROUNDING * solid.energy(x)
    direction = np.random.default_rng(4).normal(size=x.shape)
    slope = (solid.energy(x + 1e-7 * direction) - solid.energy(x - 1e-7 * direction)) / 2e-7
    assert abs(slope + (expected * direction).sum()) < 1e-5 * abs(slope)


@pytest.mark.parametrize("kind_of_tangent", ["usual", "exact"])
def test_the_matrix_is_the_reference_and_semi_definite(tmp_path, kind_of_tangent):
    sim = quadratic_bar(tmp_path, tangent=kind_of_tangent)
    stir(sim, 0.05)
    found, expected = tangent(sim), reference(sim).tangent(sim.world.x, kind_of_tangent == "exact")
    assert np.abs(found - expected).max() < ROUNDING * np.abs(expected).max()
    assert np.linalg.eigvalsh(found)[0] > -1e-10 * np.abs(found).max()


def test_rigid_motion_makes_no_force(tmp_path):
    sim = quadratic_bar(tmp_path)
    sim.world.x[:] = 1.01 * sim.world.rest
    scale = np.abs(forces(sim)).max()
    sim.world.x[:] = sim.world.rest @ random_rotations(1, seed=8)[0].T + [3, -2, 1]
    assert np.abs(forces(sim)).max() < 1e-10 * scale


def test_a_linear_displacement_is_in_equilibrium_inside(tmp_path):
    """The patch test, of elements with straight edges: the rule of integration is exact for those alone."""
    sim = quadratic_bar(tmp_path, curved=0.0, young=1e5)
    sim.world.x[:] = sim.world.rest @ (np.eye(3) + 0.1 * np.random.default_rng(2).normal(size=(3, 3))).T
    rest = sim.world.rest
    inside = ((rest > 1e-9) & (rest < np.array(SIZE) - 1e-9)).all(axis=1)
    found = forces(sim)
    assert inside.sum() > 20 and np.abs(found[inside]).max() < 1e-10 * np.abs(found).max()


def test_no_motion_but_the_rigid_ones_is_free(tmp_path):
    """The mean dilatation alone would leave some more to a single element."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])
    meshio.write(tmp_path / "one.vtu", meshio.Mesh(points, [("tetra", np.arange(4)[None])]))
    one = {"mesh": {"file": str(tmp_path / "one.vtu")}, "elements": "quadratic", "young": 1e5}
    for poisson in (0.0, 0.3, 0.499):
        values = np.linalg.eigvalsh(tangent(simulation(bar(**one, poisson=poisson))))
        assert np.abs(values[:6]).max() < 1e-9 * values[-1] and values[6] > 1e3


def cantilever(cells: tuple[int, int, int], poisson: float) -> tuple[Simulation, NDArray, NDArray]:
    """A bar of 1 x 1 x 4 m held at one end; its stiffness by the reference, and which nodes are free."""
    mesh = {"bar": list(cells), "size": [1, 1, 4], "split": "mirrored"}
    static = {"scheme": "quasi_static", "linearizations": 1}
    held = {"fixed": "Z < 1e-9", "mesh": mesh, "elements": "quadratic", "young": 1e6, "poisson": poisson}
    sim = simulation(bar(**held), gravity=(9.81e-6, 0, 0), integrator=static, **DIRECT)
    body = sim.world.bodies[0].mesh
    matrix = stiffness(quadratic_cells(body.rest, body.quadratic), len(body.rest), 1e6, poisson)
    return sim, matrix, sim.world.free > 0


# The tip of the same bar with 6 x 6 x 24 cells, by the reference [m under gravity of 9.81 m/s2, displacement if small]
TIP = {0.3: 3.92522, 0.4999: 3.79823}


@pytest.mark.parametrize("poisson", list(TIP))
@pytest.mark.parametrize(("cells", "error"), [((1, 1, 4), 0.04), ((2, 2, 8), 0.005)])
def test_a_cantilever_of_few_elements_bends_as_a_fine_one(cells, error, poisson):
    sim, matrix, free = cantilever(cells, poisson)
    assert Driver(sim).advance(1)["status"][0] == 0
    w = sim.world
    moved = 1e6 * (w.x - w.rest)
    tip = np.flatnonzero((w.rest == [0.5, 0.5, 4]).all(axis=1))[0]
    assert abs(moved[tip, 0] / TIP[poisson] - 1) < error
    expected = displacement(matrix, w.mass[:, None] * [9.81, 0, 0], free)
    assert np.abs(moved - expected).max() < 1e-4 * np.abs(expected).max()


def test_the_lowest_frequencies_are_those_of_a_finer_mesh():
    """None of another motion is among them, at either of two Poisson's ratios."""
    for poisson in (0.3, 0.499):
        found = []
        for cells in ((1, 1, 4), (3, 3, 12)):
            sim, matrix, free = cantilever(cells, poisson)
            found.append(frequencies(matrix, sim.world.mass, free, 5))
        assert np.abs(found[0] / found[1] - 1).max() < 0.12 and np.abs(found[0][:2] / found[1][:2] - 1).max() < 0.07
