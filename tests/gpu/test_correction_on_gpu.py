# SPDX-License-Identifier: MIT
"""Factors corrected on a GPU for grabs and contacts that they do not know, beside the CPU's. Runs where there is a GPU:
pytest -m gpu."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.contact.scenes import over
from tests.contact.test_contact_preconditioner import each, pressed, run
from tests.scenes import bar, scene

pytestmark = pytest.mark.gpu
END = (2.0, 1.0, 0.5)
CELLS = {"of one thread block": (2, 1, 1), "small": (4, 2, 2), "larger": (16, 8, 8)}


def held(
    cells: tuple[int, int, int], device: str, stiffness: float = 1e6, steps: int = 6, **solver: Any
) -> tuple[list[NDArray[Any]], NDArray[Any]]:
    """Records of steps before, after a hand has taken hold of the end and after it has let go, and x.

    stiffness: of the spring of a node [N/m]
    """
    beam = bar(cells, young=1e6, fixed="X < 0.01", touch={"max_force": 1e30})
    given = {"preconditioner": "cholesky", "update": "lockstep-40", "tolerance": 1e-8} | solver
    sim = Simulation(scene(beam, gravity=(0, -9.81, 0), **given), device)
    driver = Driver(sim)
    driver.step_with_fresh_factors()
    found = [driver.advance(2)]
    sim.fetch()
    at = tuple(float(c) for c in sim.world.x[np.linalg.norm(sim.world.rest - END, axis=1).argmin()])
    nodes = int((np.linalg.norm(sim.world.x - at, axis=1) <= 0.3).sum())
    to = (at[0], at[1] + 0.1, at[2])
    grab = sim.touch.grab("anna", "bar", at, 0.3, to, nodes * stiffness, 0.0, np.inf)  # type: ignore[union-attr,arg-type]
    found.append(driver.advance(steps))
    sim.touch.release("anna", grab.id)  # type: ignore[union-attr]
    found.append(driver.advance(2))
    sim.fetch()
    return found, sim.world.x


@pytest.mark.parametrize("precision", ["float16", "float32"])
@pytest.mark.parametrize("cells", CELLS)
def test_a_grab_costs_as_many_iterations_as_on_a_cpu(cells, precision):
    (g, x), (c, on_cpu) = held(CELLS[cells], "gpu", factor_precision=precision), held(CELLS[cells], "cpu")
    without, _ = held(CELLS[cells], "gpu", factor_precision=precision, woodbury=0)
    for records in g:
        assert (records["status"] == 0).all() and not records["fallbacks"].any()
    assert np.abs(x - on_cpu).max() < 1e-5
    assert (g[1]["iterations"] <= c[1]["iterations"] + 4).all(), (g[1]["iterations"], c[1]["iterations"])
    assert g[1]["iterations"].sum() < without[1]["iterations"].sum()


def test_what_is_let_go_leaves_the_factor_again():
    """The factor is of a step with the springs."""
    options = {"update": "lockstep-3", "steps": 9}
    (g, x), (c, on_cpu) = (held((4, 2, 2), device, **options) for device in ("gpu", "cpu"))
    without, _ = held((4, 2, 2), "gpu", woodbury=0, **options)
    assert np.abs(x - on_cpu).max() < 1e-5
    assert g[1]["iterations"][-1] <= c[1]["iterations"][-1] + 2 and not g[2]["fallbacks"].any()
    assert (g[2]["iterations"] <= c[2]["iterations"] + 6).all(), (g[2]["iterations"], c[2]["iterations"])
    assert g[2]["iterations"].sum() < without[2]["iterations"].sum()


def test_steps_are_the_same_to_the_bit_each_time():
    first, second = (held((8, 4, 4), "gpu", update="lockstep-3", steps=12) for _ in range(2))
    assert np.array_equal(first[1], second[1])
    assert [r["iterations"].tolist() for r in first[0]] == [r["iterations"].tolist() for r in second[0]]


@pytest.mark.parametrize("linearizations", [1, 3])
def test_several_linearizations(linearizations):
    integrator = {"linearizations": linearizations}
    runs = {}
    for woodbury in (32, 0):
        runs[woodbury], _ = held((4, 2, 2), "gpu", woodbury=woodbury, integrator=integrator)
    assert all((r["status"] == 0).all() for r in runs[32])
    assert runs[32][1]["iterations"].sum() < runs[0][1]["iterations"].sum()


@pytest.mark.parametrize("precision", ["float16", "float32"])
def test_contacts_of_a_tool_that_a_factor_does_not_know(precision):
    """A rod bends a slender beam and slides along it: its rows couple nodes, for which nothing is corrected."""
    made = {}
    for woodbury in (32, 0):
        sim = pressed("gpu", woodbury=woodbury, factor_precision=precision)
        records = run(sim, 36)
        assert (records["status"] == 0).all() and records["contacts"].max() > 0
        made[woodbury] = records, sim.fetch().x.copy()
    (corrected, x), (stale, other) = made[32], made[0]
    assert each(corrected) <= 1.05 * each(stale)
    assert np.abs(x - other).max() < 1e-6


@pytest.mark.parametrize("precision", ["float16", "float32"])
def test_contacts_with_a_floor_that_a_factor_does_not_know(precision):
    """A block with a factor without contacts falls onto a floor."""
    iterations = {}
    for woodbury in (32, 0):
        options = {"preconditioner": "cholesky", "update": "never", "tolerance": 1e-8, "max_iterations": 5000}
        options |= {"woodbury": woodbury, "factor_precision": precision}
        driver = Driver(over(cells=(3, 2, 3), at=(0, 0.006, 0), solver=options, device="gpu"))
        driver.step_with_fresh_factors()
        records = driver.advance(4)
        assert (records["status"] == 0).all() and records["contacts"].max() == 16
        iterations[woodbury] = records["iterations"].sum()
    assert iterations[32] < 0.5 * iterations[0]
