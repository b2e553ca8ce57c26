# SPDX-License-Identifier: MIT
"""Wind: force on a plate and a sphere, terminal velocity, the tangent, and what is refused."""

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from sim_server.errors import InputError
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.effects.hollow import sphere
from tests.scenes import bar, mesh_file, rotation, scene


def blown(wind: Any, integrator: dict | None = None, dt: float = 0.02, gravity: Any = None, **table: Any) -> Simulation:
    """A bar of 2 x 1 x 1 m."""
    solver = table.pop("solver", {})
    given = bar(**({"density": 1000} | table))
    given["effects"]["wind"] = wind
    return Simulation(scene(given, integrator=integrator, dt=dt, gravity=gravity, **solver))


def forces(sim: Simulation) -> np.ndarray:
    """On the nodes in the present state [N]."""
    sim.engine.assemble()
    return np.asarray(sim.effects["wind"].load.copy())  # type: ignore[attr-defined]


def test_force_on_a_plate_across_the_wind():
    """1/2 rho c A u^2, of the velocity past it; along the faces friction."""
    wind = {"velocity": [10, 0, 0], "density": 1.3, "drag": 1.1}
    sim = blown(wind)
    np.testing.assert_allclose(forces(sim).sum(axis=0), [0.5 * 1.3 * 1.1 * 100, 0, 0], atol=1e-9)
    sim.world.v[:] = [4, 0, 0]
    np.testing.assert_allclose(forces(sim).sum(axis=0), [0.5 * 1.3 * 1.1 * 36, 0, 0], atol=1e-9)
    sim.world.v[:] = [14, 0, 0]
    np.testing.assert_allclose(forces(sim).sum(axis=0), [-0.5 * 1.3 * 1.1 * 16, 0, 0], atol=1e-9)
    sim = blown(wind | {"drag": 0.0, "friction": 0.01})
    np.testing.assert_allclose(forces(sim).sum(axis=0), [0.5 * 1.3 * 0.01 * 100 * 8, 0, 0], atol=1e-9)


def test_an_inclined_plate_is_pushed_along_its_normal():
    sim, turn = blown({"velocity": [10, 0, 0], "drag": 1.0, "density": 2.0}), rotation([0, 0, 1], 0.5)
    sim.world.x[:] = sim.world.x @ turn.T
    end, side = np.cos(0.5) ** 2 * turn[:, 0], -2 * np.sin(0.5) ** 2 * turn[:, 1]
    np.testing.assert_allclose(forces(sim).sum(axis=0), 100 * (end + side), atol=1e-9)


def test_a_sphere_has_half_the_drag_of_its_section(tmp_path):
    given = bar(density=1000, mesh=mesh_file(tmp_path, *sphere(12, 0.6, 1.0)))
    given["effects"]["wind"] = {"velocity": [0, 0, 7], "drag": 0.9}
    force = forces(Simulation(scene(given))).sum(axis=0)
    np.testing.assert_allclose(force, [0, 0, 0.5 * 1.2 * 0.45 * np.pi * 49], rtol=0.03, atol=0.5)


@pytest.mark.parametrize(
    "integrator", [{}, {"scheme": "ros2", "solve": "iterate"}, {"scheme": "newmark"}, {"scheme": "central_difference"}]
)
def test_terminal_velocity(integrator):
    """m g = 1/2 rho c A v^2 of a bar that falls across, however it is integrated; it is light, and in water."""
    solver = {} if integrator.get("scheme") == "central_difference" else {"tolerance": 1e-10}
    dt = 0.005 if "solve" in integrator else 0.02  # ros2 has no drag in its matrix
    sim = blown({"density": 1000.0, "drag": 1.5}, integrator, dt, (0, -9.81, 0), density=50, solver=solver)
    records = Driver(sim).advance(round(1.2 / dt))
    expected = np.sqrt(2 * 50 * 2 * 9.81 / (1000 * 1.5 * 2))
    velocity = sim.world.mass @ sim.fetch().v / sim.world.mass.sum()
    np.testing.assert_allclose(velocity, [0, -expected, 0], atol=5e-3 * expected)
    assert (records["status"] == 0).all()


def test_wind_bends_a_mast_in_a_static_scene():
    sim = blown({"velocity": [0, 0, 0.5]}, {"scheme": "quasi_static", "linearizations": 20}, fixed="X < 0.01",
                cells=(8, 1, 1), size=(4, 0.2, 0.2))  # fmt: skip
    assert Driver(sim).advance(1)["status"][-1] == 0
    tip = sim.fetch().x[sim.world.rest[:, 0] > 3.99, 2].mean() - 0.1
    still = forces(sim).copy()
    sim.world.v[:] = 1.0
    assert tip > 0.005 and np.array_equal(forces(sim), still)


def test_the_matrix_has_the_slope_by_velocities():
    wind = {"velocity": [3, 1, 2], "density": 900.0, "drag": 1.0, "friction": 0.1}
    sim, still = (blown(w, cells=(2, 1, 1), solver={"warp": False}) for w in (wind, wind | {"density": 0.0}))
    random = np.random.default_rng(0)
    shake, v = 0.1 * random.normal(size=sim.world.x.shape), random.normal(size=sim.world.x.shape)
    found = []
    for each in (sim, still):
        each.world.x[:] += shake
        each.world.v[:] = v
        each.engine.assemble()
        found.append(each.matrix().toarray())
    slopes = []
    for k in range(v.size):
        pair = []
        for sign in (1, -1):
            sim.world.v[:] = v
            sim.world.v.ravel()[k] += sign * 1e-5
            pair.append(forces(sim).ravel())
        slopes.append((pair[1] - pair[0]) / 2e-5)
    drag = (found[0] - found[1]) / sim.world.dt
    np.testing.assert_allclose(drag, np.array(slopes), atol=1e-6 * np.abs(drag).max())
    assert np.linalg.eigvalsh(drag).min() > -1e-9 * np.abs(drag).max()


def test_where_chooses_triangles():
    sim = blown({"where": "Y < 0.6", "velocity": [10, 0, 0], "drag": 1.0, "density": 2.0})
    np.testing.assert_allclose(forces(sim).sum(axis=0), [50, 0, 0], atol=1e-9)
    with pytest.raises(InputError, match="holds all nodes of 0 of"):
        blown({"where": "Y > 3"})


@pytest.mark.parametrize("wind", [{"density": -1.0}, {"drag": -1.0}, {"velocity": 3.0}, {"speed": 1.0}])
def test_what_is_refused(wind):
    with pytest.raises(ValidationError):
        blown(wind)
