# SPDX-License-Identifier: MIT
"""Forces that a program sets between steps."""

import numpy as np
import pytest

import warpfactor as wf
from sim_server.errors import InputError
from tests.embedded.test_embedded import DT, GRID, falling

MASS = 1000 * 0.1 * 0.1 * 0.2
SOLVER = {"solver": {"tolerance": 1e-10, "preconditioner": "block_jacobi"}}


def free(**tables: object) -> wf.Simulation:
    """The body of test_embedded without gravity, with room for forces."""
    return wf.Simulation({**falling(wf.Mesh(GRID.rest, GRID.tets)), "effects": {}, **SOLVER, **tables}, forces=True)


def test_a_program_adds_momentum_until_it_writes_others():
    """Force times time; each node has its own."""
    with free() as simulation:
        mass = simulation.inside.world.mass
        simulation.forces[:, 0] = mass * 2.0
        simulation.forces[3] += (0, 0, 5.0)
        simulation.step(4)
        np.testing.assert_allclose(mass @ simulation.v, [MASS * 2 * 4 * DT, 0, 5 * 4 * DT], atol=1e-9)
        simulation.forces = np.zeros(3)
        before = mass @ simulation.v
        simulation.step(3)
        np.testing.assert_allclose(mass @ simulation.v, before, atol=1e-9)


SCHEMES = ("backward_euler", "newmark", "bdf2", "generalized_alpha", "ros2", "central_difference")


@pytest.mark.parametrize("scheme", SCHEMES)
def test_forces_of_the_weight_are_gravity(scheme):
    """In every scheme, of a body that bends. Both come after the state before the first step was made."""
    found = []
    for gravity in (True, False):
        scene = falling(wf.Mesh(GRID.rest, GRID.tets), fixed={"where": "Z < 0.01"})
        solver = {} if scheme == "central_difference" else SOLVER
        scene |= {"integrator": {"scheme": scheme}, "effects": {"gravity": {"g": [0.0, 0.0, 0.0]}}, **solver}
        with wf.Simulation(scene, forces=True) as simulation:
            if gravity:
                simulation.set("gravity.g", [0, -9.81, 0])
            else:
                world = simulation.inside.world
                simulation.forces = world.mass[:, None] * [0, -9.81, 0]
            records = simulation.step(8)
            found.append(simulation.x.copy())
    assert np.abs(found[0] - GRID.rest).max() > 1e-4
    np.testing.assert_allclose(*found, atol=1e-9)
    assert (records["work"][1:] > 0).all()


def test_their_work_is_known_to_the_energy_balance():
    """Of a body that forces throw by many times its size in a step it is not said that it runs away."""
    with free() as simulation:
        world = simulation.inside.world
        simulation.forces = world.mass[:, None] * [0, 0, 1e5]
        records = simulation.step(20)
    assert (records["status"] == 0).all() and (records["kinetic"] <= records["budget"] * 1.2).all()
    assert records["work"][-1] == pytest.approx(records["kinetic"][-1], rel=0.2)


def test_without_room_nothing_is_launched():
    """Steps of a simulation without forces are those of a server."""
    with wf.Simulation(falling(wf.Mesh(GRID.rest, GRID.tets))) as simulation:
        names = [launch.name for launch in simulation.inside.engine.launches]
        assert "traction.load" not in names
        with pytest.raises(InputError, match="make the simulation with forces=True"):
            simulation.forces = (0, 0, 1)
    with free() as simulation:
        names = [launch.name for launch in simulation.inside.engine.launches]
        assert names.count("traction.load") == 1


@pytest.mark.parametrize("bad", [np.zeros((2, 3)), [0, 0, np.nan], [[0, 0, "x"]] * 12, 1.0])
def test_forces_that_do_not_fit_are_refused(bad):
    with free() as simulation:
        with pytest.raises(InputError, match=r"must be finite numbers \(12, 3\) or \(3,\)"):
            simulation.forces = bad
        assert (simulation.forces == 0).all()


def test_a_reset_leaves_them():
    with free() as simulation:
        simulation.forces = (1, 0, 0)
        simulation.step(2)
        after = simulation.v.copy()
        simulation.reset("cube")
        assert (simulation.v == 0).all() and (simulation.forces == (1, 0, 0)).all()
        simulation.step(2)
        np.testing.assert_allclose(simulation.v, after, atol=1e-9)
