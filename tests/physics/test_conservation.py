# SPDX-License-Identifier: MIT
"""Conservation of mass and momentum in a step, and its loss of energy."""

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.errors import InputError
from sim_server.simulation import Simulation
from tests.scenes import bar, elastic, jittered_bar, mesh_file, rotation, simulation

GRAVITY = (0.0, -9.81, 0.0)


def stirred(seed: int = 0, **solver) -> Simulation:
    """A free, undamped bar in its rest shape with random velocities of about 1 m/s."""
    sim = simulation(bar((4, 2, 2), (2, 1, 1), young=2e5, poisson=0.35), dt=0.01, **solver)
    sim.world.v[:] = np.random.default_rng(seed).normal(size=sim.world.v.shape)
    return sim


def momentum(sim: Simulation) -> NDArray:
    return sim.world.mass @ sim.world.v


def energy(sim: Simulation) -> float:
    return sim.kinetic_energy() + sim.potential_energy()


@pytest.mark.parametrize("tolerance", [1e-6, 1e-12])
def test_momentum_of_a_free_body_over_100_steps(tolerance):
    """Internal forces sum to zero, so all that may be lost is the residual of each solve: |sum r| <= sqrt(n) |r|."""
    sim = stirred(tolerance=tolerance, preconditioner="block_jacobi", max_iterations=1000)
    before, drift = momentum(sim), 0.0
    for _ in range(100):
        sim.engine.run(1)
        drift += tolerance * np.linalg.norm(sim.system.b) * np.sqrt(sim.world.nodes)
    assert (sim.engine.records()["status"] == 0).all()
    lost = np.linalg.norm(momentum(sim) - before)
    assert lost <= drift + 1e-13 * np.linalg.norm(sim.world.mass[:, None] * sim.world.v, axis=1).sum()
    assert lost < (1e-9 if tolerance == 1e-12 else 1e-2) * np.linalg.norm(before)


def test_momentum_grows_by_weight_times_time():
    sim = simulation(bar(fixed=None, young=1e5), gravity=GRAVITY, tolerance=1e-10, preconditioner="block_jacobi")
    sim.engine.run(50)
    expected = sim.world.mass.sum() * np.array(GRAVITY) * 50 * 0.02
    np.testing.assert_allclose(momentum(sim), expected, rtol=1e-9, atol=1e-9 * abs(expected[1]))
    fallen = sim.world.x - sim.world.rest
    exact = 9.81 * 0.02**2 * 50 * 51 / 2  # backward Euler: h^2 g n (n + 1) / 2
    assert np.abs(fallen - [0, -exact, 0]).max() < 1e-8 * exact


@pytest.mark.parametrize("poisson", [0.0, 0.3, 0.45])
@pytest.mark.parametrize("seed", [1, 2, 3])
def test_energy_never_rises_without_load(seed, poisson):
    """Backward Euler with one linearization, free undamped body, nodes displaced and moving at random."""
    sim = simulation(bar((4, 2, 2), (2, 1, 1), young=2e5, poisson=poisson), tolerance=1e-10, max_iterations=2000)
    random = np.random.default_rng(seed)
    sim.world.x += 0.02 * random.normal(size=sim.world.x.shape)
    sim.world.v[:] = random.normal(size=sim.world.v.shape)
    history = [energy(sim)]
    for _ in range(100):
        sim.engine.run(1)
        history.append(energy(sim))
    assert np.diff(history).max() < 1e-9 * history[0]
    assert history[-1] < 0.5 * history[0]


@pytest.mark.parametrize("damping", [(0.0, 0.0), (0.5, 0.0), (0.0, 0.05), (0.5, 0.05)])
def test_damping_takes_energy_and_more_of_it_the_stronger(damping):
    sim = simulation(bar(young=2e5, fixed="X < 0.01", damping=damping), dt=0.005, tolerance=1e-9)
    sim.world.x += 0.05 * (sim.world.rest[:, :1] / 2) ** 2 * [0.0, 1.0, 0.0]
    start = energy(sim)
    sim.engine.run(40)
    undamped = simulation(bar(young=2e5, fixed="X < 0.01"), dt=0.005, tolerance=1e-9)
    undamped.world.x += 0.05 * (undamped.world.rest[:, :1] / 2) ** 2 * [0.0, 1.0, 0.0]
    undamped.engine.run(40)
    assert energy(sim) < start
    assert (energy(sim) < 0.95 * energy(undamped)) == any(damping)


def test_mass_damping_alone_slows_free_motion_as_the_formula_says():
    """v (1 + h alpha) = v before, each step: no stiffness is at work in a body that only moves as a whole."""
    sim = simulation(bar(young=1e5, damping=(2.0, 0.0)), dt=0.01, tolerance=1e-12)
    sim.world.v[:] = [1.0, 2.0, 3.0]
    sim.engine.run(100)
    np.testing.assert_allclose(sim.world.v, np.tile(np.array([1, 2, 3]) / 1.02**100, (len(sim.world.v), 1)), rtol=1e-9)


def test_stiffness_damping_leaves_rigid_motion_alone():
    """It acts on the rate of strain, so a body moving as a whole keeps its velocity."""
    sim = simulation(bar(young=1e5, damping=(0.0, 0.1)), tolerance=1e-12)
    sim.world.x[:] = sim.world.rest @ rotation((1, 2, 3), 1.0).T
    sim.world.v[:] = [1.0, 2.0, 3.0]
    sim.engine.run(20)
    assert np.abs(sim.world.v - [1.0, 2.0, 3.0]).max() < 1e-9


def test_a_spinning_body_keeps_turning():
    """Angular momentum is lost, never gained: 2e-6 of it in this turn of 2 rad at h = 0.02 s."""
    sim = simulation(bar((4, 2, 2), (2, 1, 1), young=2e6, poisson=0.3), dt=0.02, tolerance=1e-9)
    centre = sim.world.mass @ sim.world.x / sim.world.mass.sum()
    sim.world.v[:] = np.cross([0.0, 0.0, 1.0], sim.world.x - centre)

    def spin() -> NDArray:
        c = sim.world.mass @ sim.world.x / sim.world.mass.sum()
        return np.einsum("n,ni->i", sim.world.mass, np.cross(sim.world.x - c, sim.world.v))

    start, sizes = spin(), [np.linalg.norm(spin())]
    for _ in range(100):
        sim.engine.run(1)
        sizes.append(np.linalg.norm(spin()))
    assert np.diff(sizes).max() < 1e-9 * sizes[0]
    assert 0.9999 < sizes[-1] / sizes[0] < 1
    assert np.linalg.norm(spin() - start) < 1e-4 * sizes[0]


def test_masses_by_volume(tmp_path):
    rest, tets = jittered_bar((3, 2, 2), (1.5, 1, 0.8), seed=1)
    sim = simulation(bar(mesh=mesh_file(tmp_path, rest, tets), density=1200))
    corners = rest[tets]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 6
    assert sim.world.mass.sum() == pytest.approx(1200 * 1.5 * 1 * 0.8, rel=1e-12)
    expected = np.zeros(len(rest))
    for tet, v in zip(tets, volume, strict=True):
        expected[tet] += 1200 * v / 4
    np.testing.assert_allclose(sim.world.mass, expected, rtol=1e-12)


def test_masses_given_as_a_total_and_equal():
    by_volume = simulation(bar(mass=40.0)).world.mass
    equal = simulation(bar(mass=40.0, masses="equal")).world.mass
    assert by_volume.sum() == pytest.approx(40, rel=1e-13)
    assert len(set(equal)) == 1
    assert equal[0] == 40.0 / len(equal)
    assert simulation(bar(density=500, masses="equal")).world.mass.sum() == pytest.approx(1000, rel=1e-12)
    assert simulation(bar()).world.mass.sum() == pytest.approx(2000, rel=1e-12)  # water


def test_regions_make_elements_differ_and_none_may_be_left_out():
    stiff = [{"where": "X < 1", "young": 4e6, "poisson": 0.1}, {"young": 1e4}]
    elements = elastic(simulation(bar(young=stiff, poisson=0.4)))
    centre = elements.world.rest[elements.elements].mean(axis=1)[:, 0]
    young, poisson = elements.elastic[0]
    assert np.array_equal(young, np.where(centre < 1, 4e6, 1e4))
    assert np.array_equal(poisson, np.where(centre < 1, 0.1, 0.4))
    volume = 2.0 / len(young)
    np.testing.assert_allclose(elements.lame[1], young / (2 * (1 + poisson)) * volume, rtol=1e-12)
    np.testing.assert_allclose(
        elements.lame[0], young * poisson / ((1 + poisson) * (1 - 2 * poisson)) * volume, rtol=1e-12
    )
    with pytest.raises(InputError, match=r"'bar', effect corotational: element .* is in no region of young"):
        simulation(bar(young=[{"where": "X < 1", "young": 1e4}]))


def test_fixed_nodes_never_move_and_must_be_some():
    sim = simulation(bar(fixed="X < 0.01", damping=(0.1, 0.01)), gravity=GRAVITY)
    held = sim.world.free == 0
    assert held.sum() == 9
    sim.engine.run(20)
    assert np.array_equal(sim.world.x[held], sim.world.rest[held])
    assert not sim.world.v[held].any()
    assert np.abs(sim.world.x - sim.world.rest).max() > 0.1
    for nothing in ("X > 5", "X > -1"):
        with pytest.raises(InputError, match="it must hold some and leave some free"):
            simulation(bar(fixed=nothing))
