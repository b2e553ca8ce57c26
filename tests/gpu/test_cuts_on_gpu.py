# SPDX-License-Identifier: MIT
"""Bodies that lose elements, beside the CPU's. Runs where there is a GPU: -m gpu."""

import numpy as np
import pytest

from protocol import messages_pb2 as pb
from sim_server.effects.cutting import Cutting
from sim_server.scene.model import Scene
from sim_server.service.blades import Blades
from sim_server.simulation import Simulation
from sim_server.state.start import Start
from sim_server.updates.driver import Driver
from tests.cutting.cut_scenes import HALVED, LAWS, cut, table
from tests.scenes import factor_of
from tests.service.test_blades import advance, removed
from tests.service.test_blades import made as blade

pytestmark = pytest.mark.gpu
NOTCH = "abs(X - 1) < 0.13 and Y > 0.25"


def made(law: str, device: str, **keys) -> Simulation:
    return Simulation(Scene.model_validate(table(law, **keys), context={"folder": "."}), device)


@pytest.mark.parametrize("law", LAWS)
@pytest.mark.parametrize("where", [NOTCH, HALVED])
def test_what_is_left_moves_as_on_a_cpu(law, where):
    ends = []
    for device in ("gpu", "cpu"):
        sim = made(law, device)
        sim.engine.run(3)
        cut(sim, where)
        sim.engine.run(12)
        ends.append(sim.fetch().x.copy())
        assert (sim.engine.records()["status"] == pb.CONVERGED).all()
    np.testing.assert_allclose(ends[0], ends[1], atol=1e-6)


@pytest.mark.parametrize("scheme", ["newmark", "bdf2", "generalized_alpha", "central_difference"])
def test_other_schemes_go_on_as_on_a_cpu(scheme):
    solver = {"preconditioner": "none"} if scheme == "central_difference" else {"tolerance": 1e-10}
    ends = []
    for device in ("gpu", "cpu"):
        sim = made("corotational", device, integrator={"scheme": scheme}, solver=solver)
        cut(sim, NOTCH)
        sim.engine.run(12)
        ends.append(sim.fetch().x.copy())
    bound = 2e-4 if scheme == "central_difference" else 1e-5  # substeps come in fours on a GPU
    np.testing.assert_allclose(ends[0], ends[1], atol=bound)


@pytest.mark.parametrize("precision", ["float64", "mixed", "float32"])
def test_solves_go_on_with_a_factor_from_before(precision):
    """It takes more iterations; what it comes to is the same."""
    solver = {"update": "lockstep-6", "tolerance": 1e-5 if precision == "float32" else 1e-8, "precision": precision,
              "preconditioner": "cholesky", "max_iterations": 3000}  # fmt: skip
    sim = made("corotational", "gpu", solver=solver)
    driver = Driver(sim)
    driver.advance(14)
    cut(sim, HALVED)
    assert (driver.advance(20)["status"] == pb.CONVERGED).all()
    gone = np.flatnonzero(sim.world.backend.fetch(sim.cutting.at_rest) > 0)
    x = sim.fetch().x[gone].copy()
    driver.advance(5)
    np.testing.assert_allclose(sim.fetch().x[gone], x, atol=1e-5)


def test_nodes_without_elements_are_set_apart_from_a_factor_from_before(monkeypatch):
    found = {}
    solver = {"update": "never", "tolerance": 1e-8, "preconditioner": "cholesky", "max_iterations": 3000}
    for apart in (True, False):
        if not apart:
            monkeypatch.setattr(Cutting, "cut_input", lambda *_: None)
        sim = made("corotational", "gpu", solver=solver)
        sim.engine.run(2)
        sim.engine.assemble()
        factor = factor_of(sim, dtype=np.float32)
        sim.engine.solve()
        sim.engine.post_factor(0, *factor, 2)
        sim.engine.settle_factors()
        cut(sim, HALVED)
        sim.engine.run(3)
        records = sim.engine.records()[-3:]
        assert (records["factor_step"] >= 0).all()
        found[apart] = records["iterations"].max()
    assert 2 * found[True] < found[False]


def test_an_edge_that_a_client_moves_removes_what_it_removes_on_a_cpu():
    found = []
    for device in ("gpu", "cpu"):
        sim = blade(device)
        looks = Blades(sim)
        sim.contact.move("scalpel", (1.05, 0.45, 0.25), (1, 0, 0, 0))
        advance(sim, looks, 30)
        found.append(removed(sim))
    assert found[0] == found[1] and len(found[0]) >= 6


def test_a_reset_makes_whole():
    sim = made("corotational", "gpu")
    start = Start(sim)
    sim.engine.run(10)
    first = sim.fetch().x.copy()
    cut(sim, HALVED)
    sim.engine.run(10)
    start.reset()
    sim.engine.run(10)
    np.testing.assert_array_equal(sim.fetch().x, first)


@pytest.mark.parametrize("where", [NOTCH, HALVED])
def test_steps_by_the_factor_alone_iterate_until_it_knows_of_the_cut(where):
    """They come to what steps by iterations do on a CPU, as near as those by factors of another age do there."""
    keys = {"integrator": {"scheme": "ros2"}, "solver": {"update": "lockstep-4", "preconditioner": "cholesky",
            "tolerance": 1e-10, "max_iterations": 3000}}  # fmt: skip
    sim = made("corotational", "gpu", **keys)
    driver = Driver(sim)
    before = driver.advance(20)
    assert (before["form"][-4:] == pb.FACTOR).all()
    cut(sim, where)
    records = driver.advance(24)
    forms, knows = records["form"], records["factor_step"] > 20
    assert (forms[~knows] != pb.FACTOR).all() and (~knows).any()
    assert (forms[knows] == pb.FACTOR).any(), "then steps need no iterations again"
    assert (records["status"] == pb.CONVERGED).all()
    by_iterations = keys | {"integrator": {"scheme": "ros2", "solve": "iterate"}}
    twin = made("corotational", "cpu", **by_iterations)
    twin.engine.run(20)
    cut(twin, where)
    twin.engine.run(24)
    np.testing.assert_allclose(sim.fetch().x, twin.fetch().x, atol=6e-3)  # lockstep-4 and -5 on a CPU: 4e-3
