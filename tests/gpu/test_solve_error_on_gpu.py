# SPDX-License-Identifier: MIT
"""Solves that end by the estimated error of positions, on a GPU beside a CPU. Runs where there is a GPU:
pytest -m gpu."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.scene import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import D, block, over
from tests.scenes import bar, scene

pytestmark = pytest.mark.gpu
POSITION = 1e-5  # m
SOLVER = {"update": "lockstep-4", "tolerance": 1e-12, "max_iterations": 5000}
CELLS = {"of one thread block": (2, 1, 1), "small": (6, 2, 2), "larger": (24, 10, 10)}


def bounded(made: Scene, position: float = POSITION) -> Scene:
    return Scene.model_validate(made.resolved() | {"accuracy": {"position": position}}, context={"folder": "."})


def run(made: Scene, device: str, steps: int = 12) -> tuple[NDArray[Any], NDArray[Any]]:
    """Records of all steps, and positions at the end. A CPU calculates in double precision whatever the scene says."""
    if device == "cpu":
        made = made.model_copy(
            update={"solver": made.solver.model_copy(update={"precision": "float64", "factor_precision": "auto"})}
        )
    sim = Simulation(made, device)
    driver = Driver(sim)
    if made.solver.wants_factors:
        driver.step_with_fresh_factors()
    records = driver.advance(steps)
    sim.fetch()
    return records, sim.world.x.copy()


def falling(cells: tuple[int, int, int], bars: int = 1, **table: Any) -> Scene:
    """Bars that are let go from horizontal, held at their left ends."""
    objects = [bar(cells, young=1e6, name=f"bar{k}", fixed="X < 0.01") for k in range(bars)]
    return bounded(scene(*objects, gravity=(0, -9.81, 0), **SOLVER | table))


def compared(made: Scene, within: float, steps: int = 12) -> NDArray[Any]:
    """Runs the scene on both; returns the records of the GPU. within: part by which estimates may differ."""
    (gpu, x), (cpu, expected) = (run(made, device, steps) for device in ("gpu", "cpu"))
    assert np.abs(x - expected).max() <= 2 * steps * POSITION
    assert (gpu["status"] == cpu["status"]).all() and np.abs(gpu["iterations"] - cpu["iterations"]).max() <= 2
    same = (gpu["iterations"] == cpu["iterations"]) & (cpu["solve_error"] > 0)
    assert same.mean() > 0.7
    ratio = gpu["solve_error"][same] / cpu["solve_error"][same]
    assert np.median(np.abs(ratio - 1)) <= within
    return gpu


@pytest.mark.parametrize("precision", ["float64", "mixed", "float32"])
@pytest.mark.parametrize("cells", CELLS)
def test_block_jacobi_ends_where_it_does_on_a_cpu(cells, precision):
    made = falling(CELLS[cells], preconditioner="block_jacobi", precision=precision)
    found = compared(made, 1e-6 if precision == "float64" else 1e-2)
    assert found["iterations"].min() > 0 and found["residual"].max() > 1e-9


@pytest.mark.parametrize("factor", ["float16", "float32"])
@pytest.mark.parametrize("cells", CELLS)
def test_factors_end_where_they_do_on_a_cpu(cells, factor):
    found = compared(falling(CELLS[cells], preconditioner="cholesky", factor_precision=factor), 0.3)
    assert np.nanmax(found["solve_error"]) <= POSITION


def test_bodies_of_the_pool_have_estimates_of_their_own():
    """More bodies than multiprocessors: thread blocks take one after another."""
    compared(falling((2, 1, 1), bars=400, preconditioner="block_jacobi"), 1e-6, steps=4)


def test_a_step_of_stages_and_one_of_several_linearizations_tell_errors():
    for integrator in ({"scheme": "ros2", "solve": "iterate"}, {"linearizations": 3, "tolerance": 1e-6}):
        made = falling((6, 2, 2), preconditioner="cholesky", integrator=integrator)
        records, _ = run(made, "gpu")
        moving = records["iterations"] > 0
        assert moving.any() and (records["solve_error"][moving] > 0).all()


def test_contact_ends_where_it_does_on_a_cpu():
    made = bounded(over(at=(0, 0.006, 0), solver=SOLVER | {"preconditioner": "block_jacobi"}).scene)
    found = compared(made, 1e-2)
    assert (found["contacts"] > 0).any()


@pytest.mark.parametrize("kind", ["block_jacobi", "cholesky"])
def test_bodies_that_touch_each_other_end_near_where_they_do_on_a_cpu(kind):
    blocks = [block(cells=(2, 1, 2), size=(0.08, 0.04, 0.08), name=f"b{k}", at=(0, D + 0.042 * k, 0)) for k in (0, 1)]
    made = over(objects=blocks, solver=SOLVER | {"preconditioner": kind}).scene
    (gpu, x), (cpu, expected) = (run(bounded(made), device) for device in ("gpu", "cpu"))
    assert np.abs(x - expected).max() <= 24 * POSITION and (gpu["status"] == cpu["status"]).all()
    moving = gpu["iterations"] > 0
    assert moving.any() and (gpu["solve_error"][moving] > 0).all() and np.nanmax(gpu["solve_error"]) <= POSITION
    exact, _ = run(bounded(made, 1e-13), "gpu")
    assert gpu["iterations"].sum() < 0.8 * exact["iterations"].sum()


def test_a_run_repeats_to_the_bit():
    made = falling((6, 2, 2), preconditioner="cholesky")
    (first, x), (again, same) = (run(made, "gpu") for _ in range(2))
    assert (x == same).all()
    for name in ("iterations", "solve_error", "residual"):
        np.testing.assert_array_equal(first[name], again[name])
