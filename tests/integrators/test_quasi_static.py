# SPDX-License-Identifier: MIT
"""Equilibrium without inertia."""

import numpy as np
import pytest

from sim_server.errors import InputError
from tests.scenes import bar, mesh_file, simulation, solid

GRAVITY = (0.0, -1.0, 0.0)
HELD = {"young": 1e5, "poisson": 0.3, "fixed": "X < 0.01"}
SOLVER = {"tolerance": 1e-10, "preconditioner": "block_jacobi", "max_iterations": 5000, "gravity": GRAVITY}
NEWTON = {"linearizations": 60, "tolerance": 1e-10}


def settled(dt: float, steps: int = 1, **table) -> np.ndarray:
    sim = simulation(
        bar((6, 2, 2), (3, 1, 1), **HELD), dt=dt, integrator={"scheme": "quasi_static", **NEWTON}, **SOLVER, **table
    )
    sim.engine.run(steps)
    assert (sim.engine.records()["status"] == 0).all()
    return sim.world.x.copy()


def test_equilibrium_does_not_depend_on_the_step():
    reference = settled(1.0)
    assert np.abs(settled(1e-3) - reference).max() < 1e-9
    assert np.abs(settled(1e3) - reference).max() < 1e-9
    assert np.abs(settled(1.0, steps=5) - reference).max() < 1e-9
    assert np.abs(reference - bar_rest()).max() > 0.1


def bar_rest() -> np.ndarray:
    return simulation(bar((6, 2, 2), (3, 1, 1), **HELD)).world.rest


def test_forces_are_in_balance():
    sim = simulation(bar((6, 2, 2), (3, 1, 1), **HELD), integrator={"scheme": "quasi_static", **NEWTON}, **SOLVER)
    sim.engine.run(1)
    weight = sim.world.mass[:, None] * np.array(GRAVITY)
    rest = (solid(sim).forces() + weight)[sim.world.free > 0]
    assert np.linalg.norm(rest) < 1e-8 * np.linalg.norm(weight)


def test_it_is_where_the_damped_motion_settles():
    sim = simulation(bar((6, 2, 2), (3, 1, 1), **HELD, damping=(2.0, 0.2)), dt=0.5, **SOLVER)
    sim.engine.run(200)
    assert np.abs(sim.world.v).max() < 1e-10
    assert np.abs(sim.world.x - settled(1.0)).max() < 1e-8


def test_one_linearization_a_step_gets_there_step_by_step():
    sim = simulation(bar((6, 2, 2), (3, 1, 1), **HELD), integrator={"scheme": "quasi_static"}, **SOLVER)
    sim.engine.run(60)
    assert np.abs(sim.world.x - settled(1.0)).max() < 1e-8


def test_damping_has_no_part_in_it():
    sim = simulation(
        bar((6, 2, 2), (3, 1, 1), **HELD, damping=(2.0, 0.2)), integrator={"scheme": "quasi_static", **NEWTON}, **SOLVER
    )
    sim.engine.run(1)
    assert np.array_equal(sim.world.x, settled(0.02))


@pytest.mark.parametrize("fixed", [None, "X < 0.01 and Y < 0.01", "X < 0.01 and Y < 0.01 and Z < 0.01"])
def test_a_body_that_nothing_holds_is_refused(fixed):
    """No fixed nodes, those of an edge (it turns about it), one node."""
    with pytest.raises(InputError, match=r"object 'bar': integrator.scheme = 'quasi_static' needs every part held"):
        simulation(bar(fixed=fixed), integrator={"scheme": "quasi_static"})


def test_a_part_on_a_hinge_is_refused(tmp_path):
    """Two tetrahedra that share an edge; a third one that shares a face is held."""
    rest = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [-1, -1, 1], [-1, 1, -0.5], [1.0, 1, 1]])
    shared = {"young": 1e5, "fixed": "X + Y > 0.5 or Z > 0.9 or (abs(X) < 0.1 and abs(Y) < 0.1)"}
    held = bar(
        mesh=mesh_file(tmp_path, rest[[0, 1, 2, 3, 6]], [[0, 1, 2, 3], [1, 4, 2, 3]], "held"),
        **HELD | {"fixed": "X < 0.5"},
    )
    simulation(held, integrator={"scheme": "quasi_static"})
    assert shared["fixed"]
    hinged = mesh_file(tmp_path, rest[:6], [[0, 1, 2, 3], [0, 3, 4, 5]], "hinged")
    with pytest.raises(InputError, match="leave 2 of 6 nodes loose, first 4"):
        simulation(bar(mesh=hinged, young=1e5, fixed="X > -0.5 and Y < 0.9"), integrator={"scheme": "quasi_static"})
