# SPDX-License-Identifier: MIT
"""A slender cantilever against beam theory: static deflection, natural frequency, and the damping of backward Euler."""

import numpy as np
import pytest
from scipy.sparse import csc_array, diags_array
from scipy.sparse.linalg import eigsh

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, simulation

LENGTH, SIDE, YOUNG, DENSITY = 8.0, 0.5, 1e7, 1000.0
AREA, INERTIA = SIDE**2, SIDE**4 / 12
LIGHT = 1e-4  # m/s2: a load that bends the beam by 1e-6 of its length


def cantilever(refinement: int, **table) -> Simulation:
    """Square section of refinement x refinement cubic cells, along x, nu = 0 (no locking by incompressibility)."""
    cells = (16 * refinement, refinement, refinement)
    material = {"young": YOUNG, "poisson": 0.0, "density": DENSITY, "fixed": "X < 1e-6"}
    return simulation(bar(cells, (LENGTH, SIDE, SIDE), **material), **table)


def sag(refinement: int) -> float:
    """Deflection of the end face under its own light weight: one step so long that inertia plays no part."""
    sim = cantilever(
        refinement, gravity=(0, -LIGHT, 0), dt=1e4, preconditioner="cholesky", update="never", tolerance=1e-6,
        factor_precision="float64",
    )  # fmt: skip
    assert Driver(sim).advance(1)["status"][0] == 0
    end = sim.world.rest[:, 0] > LENGTH - 1e-6
    return float((sim.world.rest - sim.world.x)[end, 1].mean())


def test_deflection_converges_to_beam_theory():
    """Constant strain tetrahedra are too stiff in bending, by 3.5 / n^2 with n cubic cells over the height (second
    order): 4 times too stiff with one, 10 % with six."""
    load = DENSITY * AREA * LIGHT  # N/m
    bending, shear = load * LENGTH**4 / (8 * YOUNG * INERTIA), load * LENGTH**2 / (2 * 5 / 6 * YOUNG / 2 * AREA)
    assert shear < 0.01 * bending
    excess = {n: (bending + shear) / sag(n) - 1 for n in (1, 2, 4, 6)}
    assert all(3.0 < excess[n] * n**2 < 3.7 for n in excess)
    limit = np.polyfit([1 / 4**2, 1 / 6**2], [excess[4], excess[6]], 1)[1]  # n to infinity
    assert abs(limit) < 0.01


def lowest_mode(sim: Simulation) -> tuple[float, np.ndarray]:
    """Angular frequency [rad/s] and shape (n, 3), M-orthonormal, from the matrix of a step at rest."""
    sim.engine.assemble()
    free = np.flatnonzero(np.repeat(sim.world.free, 3))
    mass = np.repeat(sim.world.mass, 3)[free]
    A = csc_array(sim.matrix())[free][:, free]
    K = (A - diags_array(mass)) / sim.world.dt**2
    values, shapes = eigsh(K, k=1, M=diags_array(mass).tocsc(), sigma=0)
    mode = np.zeros(3 * sim.world.nodes)
    mode[free] = shapes[:, 0]
    return float(np.sqrt(values[0])), mode.reshape(-1, 3)


def test_natural_frequency():
    """f = 1.8751^2 / 2 pi sqrt(E I / rho A L^4); too stiff an element makes it too high."""
    exact = 1.875104**2 * np.sqrt(YOUNG * INERTIA / (DENSITY * AREA * LENGTH**4))
    error = {n: lowest_mode(cantilever(n))[0] / exact - 1 for n in (2, 4, 6)}
    assert error[2] > error[4] > error[6] > 0
    assert error[6] < 0.05


@pytest.mark.parametrize("phase", [0.05, 0.3, 1.0, 3.0])
def test_one_mode_swings_and_decays_as_backward_euler_says(phase):
    """z = q - i q' / w is divided by (1 - i w h) in each step: amplitude 1 / sqrt(1 + (w h)^2), phase atan(w h)."""
    frequency, _ = lowest_mode(cantilever(2))
    sim = cantilever(2, dt=phase / frequency, tolerance=1e-12, preconditioner="block_jacobi", max_iterations=3000)
    w, mode = lowest_mode(sim)
    assert w * sim.world.dt == pytest.approx(phase, rel=1e-6)
    amplitude = 1e-7 / np.abs(mode).max()
    sim.world.x[:] = sim.world.rest + amplitude * mode

    def modal() -> complex:
        q, rate = (np.einsum("n,ni,ni->", sim.world.mass, mode, a) for a in (sim.world.x - sim.world.rest, sim.world.v))
        return complex(q, -rate / w) / amplitude

    expected = 1.0 + 0j
    for _ in range(12):
        sim.engine.run(1)
        expected /= 1 - 1j * phase
        assert abs(modal() - expected) < 1e-4 * abs(expected) + 1e-8
    assert abs(modal()) == pytest.approx((1 + phase**2) ** -6, rel=1e-4, abs=1e-8)
