# SPDX-License-Identifier: MIT
"""A real worker that is sent positions: the factor is that of the server's own matrix."""

import numpy as np
import pytest
from link_helpers import Driver, process

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver as Loop
from sim_server.updates.factor_source import Job
from tests.ports import free_endpoint
from tests.scenes import bar, simulation
from tests.support.link import link_of

pytestmark = pytest.mark.system


def served(update: str, **solver: object) -> Simulation:
    beam = bar((6, 3, 3), (4, 1, 1), fixed="X < 0.01", pose={"rotate": [40, 0, 70]}, touch={"max_force": 1e4})
    return simulation(
        beam, gravity=(0, -2, 0), preconditioner="cholesky", update=update, build="worker", warp=True, **solver
    )


def test_the_same_factor_as_of_the_matrix_sent() -> None:
    sim, endpoint = served("async"), free_endpoint()
    sim.engine.run(5)
    sim.engine.assemble()
    with link_of(sim, endpoint) as link, process("-m", "precond_worker", "--connect", endpoint):
        driver = Driver(link)
        driver.until(link.dispatch.assembles_matrices, "a worker that builds")
        factors = []
        for step, values in ((1, sim.system.values), (2, sim.world.x), (3, sim.system.values), (4, sim.world.x)):
            job = Job("bar", 1, step, True, values.copy(), "float64")
            driver.until(lambda job=job: link.dispatch.ready() and link.dispatch.submit(job), "a worker that is ready")
            factors.append(driver.until(lambda: driver.factors.pop() if driver.factors else None, "a factor"))
        assert not driver.failures
    assert [f.step for f in factors] == [1, 2, 3, 4]
    assert len({f.values.tobytes() for f in factors}) == 1, "bit for bit"


def test_a_run_with_positions_alone_repeats_the_run_with_matrices() -> None:
    """Lockstep: step by step the same iterations and the same state."""
    ends, sent = [], []
    for build in ("worker", "server"):
        sim, endpoint = served("lockstep-2"), free_endpoint()
        object.__setattr__(sim.scene.solver, "build", build)
        with link_of(sim, endpoint) as link, process("-m", "precond_worker", "--connect", endpoint):
            Driver(link).until(link.dispatch.workers, "a worker")
            records = Loop(sim, link.dispatch).advance(15)
            sent.append(link.counters.bytes_out / link.counters.jobs)
            ends.append((records["iterations"].tolist(), sim.world.x.tobytes()))
    assert ends[0] == ends[1]
    assert sent == [24 * sim.world.nodes, 72 * len(sim.system.columns)]


def test_while_something_is_grabbed_the_matrix_is_sent() -> None:
    sim, endpoint = served("lockstep-2"), free_endpoint()
    touch = sim.effects["touch"]
    with link_of(sim, endpoint) as link, process("-m", "precond_worker", "--connect", endpoint):
        Driver(link).until(link.dispatch.workers, "a worker")
        loop = Loop(sim, link.dispatch)
        held = touch.grab("me", "bar", (4, 1, 1), 0.0, (2, 3, 0), 1e4, 0.0, 1e9)  # type: ignore[attr-defined]
        loop.advance(5)
        blocks, jobs = 72 * len(sim.system.columns), link.counters.jobs
        assert link.counters.bytes_out == jobs * blocks > 0
        touch.release("me", held.id)  # type: ignore[attr-defined]
        loop.advance(5)
        assert link.counters.bytes_out < link.counters.jobs * blocks
        assert np.isfinite(sim.world.x).all()
