# SPDX-License-Identifier: MIT
"""Which precisions the devices have, and what goes over the wire for each precision of the factor."""

import pytest

from sim_server.errors import InputError
from sim_server.scene.solver_options import SolverOptions
from tests.scenes import bar, simulation

WRONG = {
    ("precision", "mixed", "cpu"): "solver.precision = 'mixed': must be one of 'float64' on a CPU",
    ("precision", "float32", "cpu"): "solver.precision = 'float32': must be one of 'float64' on a CPU",
    ("preconditioner", "ssor", "gpu"): "must be one of 'auto', 'none', 'jacobi', 'block_jacobi', 'cholesky' on a GPU",
    ("preconditioner", "ssor_factor", "gpu"): "solver.preconditioner = 'ssor_factor': must be one of",
    ("preconditioner", "incomplete_cholesky", "gpu"): "solver.preconditioner = 'incomplete_cholesky': must be one of",
    ("factor_precision", "float16", "cpu"): "must be one of 'auto', 'float32', 'float64' on a CPU",
    ("factor_precision", "float64", "gpu"): "must be one of 'auto', 'float16', 'float32' on a GPU",
}


@pytest.mark.parametrize(("given", "message"), WRONG.items(), ids=" ".join)
def test_what_a_device_does_not_have_is_named(given, message):
    field, value, device = given
    solver = SolverOptions.model_validate({field: value})
    with pytest.raises(InputError, match=message):
        solver.check_device(device)
    solver.check_device("gpu" if device == "cpu" else "cpu")


def test_a_simulation_asks():
    with pytest.raises(InputError, match=r"solver\.precision = 'mixed'"):
        simulation(bar(), precision="mixed")


@pytest.mark.parametrize(
    ("precision", "wire"), [("auto", "float32"), ("float16", "float32"), ("float32", "float32"), ("float64", "float64")]
)
def test_values_of_l_travel_as(precision, wire):
    assert SolverOptions(factor_precision=precision).factor_dtype == wire
