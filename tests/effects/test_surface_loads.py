# SPDX-License-Identifier: MIT
"""Loads on surfaces: sums and torques, known answers, work, and what is refused."""

from typing import Any

import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, rotation, scene

PLANES = [{"where": f"{axis.upper()} < 0.01", "along": axis} for axis in "xyz"]
STATIC = {"scheme": "quasi_static", "linearizations": 10}
END = "X > 1.99"


def loaded(traction: Any, integrator: dict | None = None, fixed: Any = None, **table: Any) -> Simulation:
    """A bar of 2 m along x. solver: its table, else of `bar`."""
    solver, dt = table.pop("solver", {}), table.pop("dt", 0.02)
    given = bar(density=1000, **table)
    given["effects"] |= {"traction": traction} | ({"fixed": fixed} if fixed else {})
    return Simulation(scene(given, integrator=integrator, dt=dt, **solver))


def forces(sim: Simulation) -> np.ndarray:
    """On the nodes in the present state [N]."""
    sim.engine.assemble()
    return np.asarray(sim.effects["traction"].load.copy())  # type: ignore[attr-defined]


def torque(sim: Simulation, about: Any = (0, 0, 0)) -> np.ndarray:
    return np.asarray(np.cross(sim.world.x - about, forces(sim)).sum(axis=0))


def test_sums_and_torques():
    """Of a force, of a traction on an end of 1 m2, and of both on parts of a list."""
    force, stress = [3.0, -1.0, 2.0], [10.0, 20.0, -5.0]
    center = np.array([2, 0.5, 0.5])
    sim = loaded({"where": END, "force": force})
    np.testing.assert_allclose(forces(sim).sum(axis=0), force, rtol=1e-12)
    np.testing.assert_allclose(torque(sim, center), 0, atol=1e-12)
    sim = loaded({"where": END, "stress": stress})
    np.testing.assert_allclose(forces(sim).sum(axis=0), stress, rtol=1e-12)
    sim = loaded([{"where": END, "force": force}, {"where": "X < 0.01", "stress": stress, "pressure": 4.0}])
    np.testing.assert_allclose(forces(sim).sum(axis=0), [17, 19, -3], rtol=1e-12)


def test_a_pressure_on_the_whole_surface_has_neither_force_nor_torque():
    """In any shape; on an end it is p A along its normal, which turns with the body."""
    sim = loaded({"where": "true", "pressure": 7.0})
    sim.world.x[:] += 0.1 * np.random.default_rng(0).normal(size=sim.world.x.shape)
    assert np.abs(forces(sim)).max() > 0.1
    np.testing.assert_allclose(forces(sim).sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(torque(sim), 0, atol=1e-12)
    sim, turn = loaded({"where": END, "pressure": 7.0}), rotation([1, 2, 3], 0.8)
    sim.world.x[:] = 1.1 * sim.world.x @ turn.T
    np.testing.assert_allclose(forces(sim).sum(axis=0), turn @ [-7 * 1.21, 0, 0], rtol=1e-12)


@pytest.mark.parametrize("moment", [[0, 5, 0], [0, 0, -3], [0, 2, 7]])
def test_a_moment_is_exact_and_turns_with_the_part(moment):
    sim, turn = loaded({"where": END, "moment": moment}), rotation([1, 2, 3], 0.8)
    np.testing.assert_allclose(torque(sim, [5, 6, 7]), moment, atol=1e-12)
    sim.world.x[:] = sim.world.x @ turn.T
    np.testing.assert_allclose(torque(sim), turn @ moment, atol=1e-12)
    np.testing.assert_allclose(forces(sim).sum(axis=0), 0, atol=1e-12)


def test_a_pose_turns_parts_and_not_vectors():
    sim = loaded({"where": END, "force": [1, 2, 3], "moment": [4, 0, 0]}, pose={"rotate": [0, 0, 90]})
    np.testing.assert_allclose(forces(sim).sum(axis=0), [1, 2, 3], rtol=1e-12)
    center = np.array([-0.5, 2, 0.5])
    np.testing.assert_allclose(torque(sim, center), [4, 0, 0], atol=1e-12)


def test_hydrostatic_compression():
    """p = -3 K eps to first order, and the same everywhere."""
    pressure, bulk = 1.0, 1e5 / 3 / (1 - 2 * 0.3)
    sim = loaded({"where": "true", "pressure": pressure}, STATIC, PLANES, solver={"tolerance": 1e-10})
    Driver(sim).advance(5)
    strain = -pressure / 3 / bulk
    np.testing.assert_allclose(sim.fetch().x, sim.world.rest * (1 + strain), atol=abs(strain) * 1e-4)


@pytest.mark.parametrize(
    "integrator", [{}, {"scheme": "newmark"}, {"scheme": "ros2", "solve": "iterate"}, {"scheme": "central_difference"}]
)
def test_momentum_and_work_of_a_force_on_a_free_body(integrator):
    """Momentum is F t; what the force does is in kinetic and elastic energy, but for the damping of the scheme."""
    solver = {} if integrator.get("scheme") == "central_difference" else {"tolerance": 1e-10}
    sim = loaded({"where": END, "force": [300.0, 100.0, 0.0]}, integrator, solver=solver)
    records = Driver(sim).advance(50)
    momentum = sim.world.mass @ sim.fetch().v
    np.testing.assert_allclose(momentum, [300, 100, 0], rtol=1e-6, atol=1e-6)
    total = sim.kinetic_energy() + sim.potential_energy()
    assert total <= records["work"][-1] * (1 + 1e-2) and (records["status"] == 0).all()
    if integrator:
        assert total == pytest.approx(records["work"][-1], rel=0.02)


def test_the_work_of_a_pressure_is_that_of_the_volume():
    """Explicit substeps keep energy: what a pressure does is -p dV."""
    sim = loaded({"where": "true", "pressure": 2e4}, {"scheme": "central_difference"}, PLANES, dt=0.002)
    records = Driver(sim).advance(40)
    assert sim.kinetic_energy() + sim.potential_energy() == pytest.approx(records["work"][-1], rel=0.02)
    corners = sim.fetch().x[sim.world.bodies[0].tets]
    volume = np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 6
    assert records["work"][-1] == pytest.approx(2e4 * (2 - volume), rel=0.02)


def stiffness_of_an_arc(layers: int, angle: float) -> float:
    """M L / (E I) over the angle by which an end moment turns the end of a slender bar; nodes keep y (nu = 0)."""
    size = (1.0, 0.1 / layers, 0.1)
    bending = 1e5 * size[1] * size[2] ** 3 / 12
    fixed = [{"where": "X < 0.001", "along": "x"}, {"where": "true", "along": "y"},
             {"where": "X < 0.001 and abs(Z - 0.05) < 0.001", "along": "z"}]  # fmt: skip
    steps, moment = 8, bending * angle
    sim = loaded(
        {"where": "X > 0.999", "moment": [0, moment / steps, 0]}, {"scheme": "quasi_static"}, fixed,
        cells=(10 * layers, 1, layers), size=size, poisson=0.0, tangent="exact",
        solver={"preconditioner": "cholesky", "update": "lockstep-1"},
    )  # fmt: skip
    driver = Driver(sim)
    for k in range(1, steps + 1):
        sim.parameters.set({"bar.traction.moment": str([0, moment * k / steps, 0])})
        driver.advance(40)
    rest, x = sim.world.rest, sim.fetch().x
    low, high = (x[(rest[:, 0] > 0.999) & (abs(rest[:, 2] - z) < 1e-6)].mean(axis=0) for z in (0, 0.1))
    across = high - low
    middle = np.array([x[(abs(rest[:, 0] - s) < 1e-6)].mean(axis=0) for s in (0.25, 0.5, 0.75)])
    center = middle[1] - middle[[0, 2]].mean(axis=0)
    radius = (0.5 * np.linalg.norm(middle[2] - middle[0])) ** 2 / (2 * np.linalg.norm(center)) + np.linalg.norm(
        center
    ) / 2
    turned = np.arctan2(across[0], across[2])
    assert 1 / radius == pytest.approx(turned, rel=0.02), "an arc: curvature times length is the angle"
    return float(angle / turned)


def test_a_bar_bends_to_an_arc_of_curvature_moment_over_stiffness():
    """Linear tetrahedra are too stiff by the square of their size; without that error the answer is within 1 %."""
    coarse, fine = stiffness_of_an_arc(4, np.pi / 2), stiffness_of_an_arc(8, np.pi / 2)
    assert 1 < fine < coarse < 1.3
    assert (4 * fine - coarse) / 3 == pytest.approx(1, rel=0.01)


@pytest.mark.parametrize(
    ("traction", "said"),
    [
        ({"where": "X > 3", "force": [1, 0, 0]}, "holds all nodes of 0 of 80 triangles"),
        ({"where": "X > 1.99"}, "one or more of force, stress, pressure and moment"),
        ({"force": [1, 0, 0]}, "needs where = ..., or a list of tables"),
        ([], "needs where = ..., or a list of tables"),
        ({"where": "true", "moment": [0, 1, 0]}, "must lie in one plane"),
        ({"where": "X > 1.99", "moment": [1, 1, 0]}, "no torsion"),
        ({"where": "X > 1.99", "pressure": [1, 1, 0]}, "number"),
        ([{"where": "X > 1.99", "torque": [1, 1, 0]}], "unknown key"),
    ],
)
def test_what_is_refused(traction, said):
    with pytest.raises((InputError, ValueError), match=said):
        loaded(traction)
