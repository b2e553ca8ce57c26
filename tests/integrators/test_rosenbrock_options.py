# SPDX-License-Identifier: MIT
"""Scene options of the Rosenbrock-W scheme: defaults, and what is refused with the reason."""

import numpy as np
import pytest

from sim_server.backends.declarations import Declarations
from sim_server.errors import InputError
from sim_server.scene import load
from sim_server.scene.integrator_options import GAMMA
from sim_server.simulation import Simulation
from tests.scenes import bar, scene, simulation

SCENE = """dt = 0.01
[[object]]
name = "beam"
mesh = { bar = [2, 1, 1], size = [2, 1, 1] }
[integrator]
"""

BAD = {
    'solve = "factor"': "solve belong to scheme ros2, not to backward_euler",
    'scheme = "newmark"\nerror_bound = 0.1': "error_bound belong to scheme ros2, not to newmark",
    'scheme = "bdf2"\nsolve = "iterate"\nerror_bound = 0.1': "solve and error_bound belong to scheme ros2, not to bdf2",
    'scheme = "ros2"\nsolve = "both"': "integrator.solve = 'both': must be 'auto', 'factor' or 'iterate'",
    'scheme = "ros2"\nerror_bound = 0.0': "integrator.error_bound = 0.0: must be greater than 0",
    'scheme = "ros2"\nlinearizations = 2': "ros2 with linearizations = 2: its order does not depend on the matrix",
    'scheme = "ros2"\nbeta = 0.3': "beta belong to scheme newmark, not to ros2",
    'scheme = "ros2"\n[solver]\nbudget = 0.01': 'solver.budget = 0.01 with integrator.scheme = "ros2"',
    'scheme = "ros2"\nsolve = "factor"\n[solver]\npreconditioner = "block_jacobi"': 'integrator.solve = "factor" with '
    'solver.preconditioner = "block_jacobi": the step is solved by an exact factor alone; allowed: "auto", "cholesky"',
    'scheme = "ros2"\nsolve = "factor"\n[solver]\npreconditioner = "incomplete_cholesky"': "by an exact factor alone",
}


@pytest.mark.parametrize("table", BAD)
def test_mistakes_are_told(tmp_path, table):
    path = tmp_path / "bad.toml"
    path.write_text(SCENE + table)
    with pytest.raises(InputError) as error:
        load(path)
    assert str(error.value).startswith("scene bad.toml") and BAD[table] in str(error.value)


ALONE = {
    ("auto", "auto"): True, ("auto", "cholesky"): True, ("factor", "auto"): True, ("factor", "cholesky"): True,
    ("iterate", "cholesky"): False, ("auto", "block_jacobi"): False, ("auto", "incomplete_cholesky"): False,
    ("auto", "ssor_factor"): False, ("iterate", "none"): False,
}  # fmt: skip


@pytest.mark.parametrize("solve, preconditioner", ALONE)
def test_where_factors_are_used_alone(solve, preconditioner):
    given = scene(bar(), integrator={"scheme": "ros2", "solve": solve}, preconditioner=preconditioner)
    assert given.uses_factor_alone == ALONE[solve, preconditioner]
    assert not scene(bar(), preconditioner=preconditioner).uses_factor_alone


def test_defaults():
    """The bound is a tenth of the shortest edge, of each body."""
    fine = bar((4, 2, 2), (1, 1, 1), name="fine")
    sim = simulation(bar((2, 1, 1), (2, 1, 1)), fine, integrator={"scheme": "ros2"})
    assert sim.scene.integrator.solve == "auto" and sim.scene.integrator.error_bound is None
    assert sim.integrator.bound.tolist() == [0.1, 0.025]
    bounded = simulation(bar(), fine, integrator={"scheme": "ros2", "error_bound": 3e-3})
    assert bounded.integrator.bound.tolist() == [3e-3, 3e-3]


def test_a_resolved_scene_is_one_again():
    given = scene(bar(), integrator={"scheme": "ros2", "solve": "iterate", "error_bound": 0.25})
    again = type(given).model_validate(given.resolved(), context={"folder": "."})
    assert again.integrator == given.integrator and again.resolved() == given.resolved()


def test_other_schemes_have_no_stages():
    for scheme in ("backward_euler", "newmark", "bdf2", "quasi_static"):
        sim = Simulation(scene(bar(fixed="X < 0.01"), integrator={"scheme": scheme}))
        sim.engine.run(2)
        records = sim.engine.records()
        assert not sim.integrator.has_stages and not records["form"].any() and np.isnan(records["estimate"]).all()


def test_the_coefficient_of_the_method_is_that_of_the_kernels():
    assert Declarations("kernels/step_form.h").constant("ROS2_GAMMA") == GAMMA
