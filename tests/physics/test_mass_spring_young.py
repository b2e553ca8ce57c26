# SPDX-License-Identifier: MIT
"""Young's modulus and Poisson's ratio of a mesh of springs under tension: the calibration of their stiffness."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay

from sim_server.simulation import Simulation
from tests.physics.test_mass_spring import springs_bar
from tests.scenes import bar, mesh_file, simulation

YOUNG, SIZE = 2e5, (3.0, 1.0, 1.0)


def unstructured(folder: Path, n: int, seed: int) -> dict[str, str]:
    """A bar without preferred directions: points at random in the cells of a grid, n over its height, by Delaunay."""
    grid = np.stack(np.meshgrid(*(np.linspace(0, s, round(s * n) + 1) for s in SIZE), indexing="ij"), -1).reshape(-1, 3)
    inside = (grid > 1e-9) & (grid < np.array(SIZE) - 1e-9)
    rest = grid + inside * np.random.default_rng(seed).uniform(-0.45, 0.45, grid.shape) / n
    tets = Delaunay(rest).simplices.astype(np.int32)
    edges = rest[tets[:, 1:]] - rest[tets[:, :1]]
    flat = np.abs(np.linalg.det(edges)) < 1e-3 / n**3  # on faces of the bar
    return mesh_file(folder, rest, tets[~flat])


def stretched(sim: Simulation) -> tuple[float, NDArray[np.float64]]:
    """Young's modulus [Pa] and Poisson's ratio along y and z, from a pull along x with faces free to slide; small
    strains, so by the matrix at rest."""
    rest, w = sim.world.rest, sim.world
    sim.engine.assemble()
    K = csc_array((sim.matrix() - diags_array(np.repeat(w.mass, 3))) / w.dt**2)
    ends = [np.flatnonzero(np.abs(rest[:, 0] - x) < 1e-9) for x in (0.0, SIZE[0])]
    u, held = np.zeros_like(rest), np.zeros(rest.shape, bool)
    held[np.concatenate(ends), 0] = True
    u[ends[1], 0] = SIZE[0]  # a strain of 1
    first, second = (ends[0][np.abs(rest[ends[0]] - p).sum(axis=1).argmin()] for p in ([0, 0, 0], [0, 1, 0]))
    held[first] = held[second, 2] = True  # neither slides away nor turns about the x axis
    f, free = held.ravel(), ~held.ravel()
    u[~held] = spsolve(K[free][:, free], -(K[free][:, f] @ u[held]))
    force = (K @ u.ravel()).reshape(-1, 3)[ends[1], 0].sum()
    middle = np.abs(rest[:, 0] - SIZE[0] / 2) < 0.35 * SIZE[0]
    gradient = np.linalg.lstsq(np.c_[np.ones(middle.sum()), rest[middle]], u[middle], rcond=None)[0]
    return force / (SIZE[1] * SIZE[2]), -np.diag(gradient[2:, 1:]) / gradient[1, 0]


@pytest.mark.parametrize(("n", "seed", "bound"), [(5, 0, 0.04), (5, 1, 0.04), (7, 2, 0.025), (8, 3, 0.02)])
def test_an_unstructured_bar_has_the_young_it_was_given_and_poisson_one_quarter(tmp_path, n, seed, bound):
    sim = simulation(springs_bar({"young": YOUNG}, mesh=unstructured(tmp_path, n, seed)))
    young, poisson = stretched(sim)
    assert young == pytest.approx(YOUNG, rel=bound)
    assert poisson == pytest.approx(0.25, abs=0.015)


@pytest.mark.parametrize(("split", "young", "poisson"), [("kuhn", 1.16, 0.035), ("mirrored", 1.49, 0.16)])
def test_regular_bars_have_preferred_directions(split, young, poisson):
    """Edges of regular meshes have preferred directions, as the docstring of mass_spring says."""
    found, ratio = stretched(
        simulation(springs_bar({"young": YOUNG}, mesh={"bar": [18, 6, 6], "size": list(SIZE), "split": split}))
    )
    assert found / YOUNG == pytest.approx(young, abs=0.02)
    assert ratio == pytest.approx(poisson, abs=0.01)


def test_the_measurement_itself(tmp_path):
    """Corotational elements, whose constants are known."""
    sim = simulation(bar(young=YOUNG, poisson=0.31, mesh=unstructured(tmp_path, 5, 0)), warp=False)
    young, poisson = stretched(sim)
    assert young == pytest.approx(YOUNG, rel=1e-7)
    assert poisson == pytest.approx(0.31, rel=1e-6)
