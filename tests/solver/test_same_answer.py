# SPDX-License-Identifier: MIT
"""No answer depends on the preconditioner, the warp, the age of a factor or where a solve starts."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.recording import messages
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from sim_server.updates.factor_source import Inline, Job
from sim_server.updates.worker_assembly import Assembly
from tests.scenes import bar, simulation

STEPS, TOLERANCE = 40, 1e-10
GRABBED = 10, 25  # from this step to that
WAYS = {
    "none": {"preconditioner": "none"},
    "jacobi": {"preconditioner": "jacobi"},
    "block_jacobi, cold": {"preconditioner": "block_jacobi", "warm_start": False},
    "ssor": {"preconditioner": "ssor", "omega": 1.3},
    "ssor_factor every-7": {"preconditioner": "ssor_factor", "update": "every-7"},
    "incomplete_cholesky lockstep-3": {"preconditioner": "incomplete_cholesky", "update": "lockstep-3"},
    "incomplete_cholesky async, little kept": {"preconditioner": "incomplete_cholesky", "drop_tolerance": 0.3},
    "cholesky never": {"preconditioner": "cholesky", "update": "never"},
    "cholesky never, unwarped": {"preconditioner": "cholesky", "update": "never", "warp": False},
    "cholesky every-1": {"preconditioner": "cholesky", "update": "every-1", "factor_precision": "float64"},
    "cholesky every-7": {"preconditioner": "cholesky", "update": "every-7"},
    "cholesky lockstep-3": {"preconditioner": "cholesky", "update": "lockstep-3"},
    "cholesky async": {"preconditioner": "cholesky", "update": "async"},
    "cholesky adaptive": {"preconditioner": "cholesky", "update": "adaptive"},
    "cholesky lockstep-7": {"preconditioner": "cholesky", "update": "lockstep-7"},
    "cholesky every-7, uncorrected": {"preconditioner": "cholesky", "update": "every-7", "woodbury": 0},
    "cholesky async, built": {"preconditioner": "cholesky", "update": "async", "build": "worker"},
    "ssor_factor lockstep-3, built": {"preconditioner": "ssor_factor", "update": "lockstep-3", "build": "worker"},
    "auto lockstep-3": {"preconditioner": "auto", "update": "lockstep-3"},
    "auto async": {"preconditioner": "auto", "update": "async"},
    "auto every-7": {"preconditioner": "auto", "update": "every-7"},
}


class Building(Inline):
    """Assembles what it is sent as positions by itself, as a worker does."""

    def __init__(self, sim: Simulation):
        super().__init__({b.name: sim.system.body_pattern(b.first, b.last) for b in sim.world.bodies})
        told = messages.scene(sim)
        self.assemblies = {b.name: Assembly(told, messages.topology(sim, b)) for b in sim.world.bodies}
        self.built = 0

    def assembles_matrices(self) -> bool:
        """Positions will do."""
        return True

    def submit(self, job: Job) -> bool:
        """Assembles and factorizes now."""
        if job.positions:
            self.built += 1
            job = replace(job, values=self.assemblies[job.object].matrix(job.values))
        return super().submit(job)


def bodies() -> list[dict]:
    """A soft posed beam that falls far and can be grabbed, a free one, and one of a hyperelastic law."""
    beam = bar(
        (6, 2, 2), (3, 1, 1), young=2e5, fixed="X < 0.01", damping=(0.1, 0.0), pose={"rotate": [40, 0, 70]},
        touch={"max_force": 1e9},
    )  # fmt: skip
    law = bar((3, 2, 2), name="law", young=None, fixed="X < 0.01", pose={"rotate": [0, -50, 20]})
    law["effects"]["stable_neo_hookean"] = {"young": 1e5, "poisson": 0.4}
    return [beam, bar(name="free", young=1e5), law]


def trajectory(tolerance: float = TOLERANCE, **solver) -> tuple[NDArray, NDArray]:
    """(steps, nodes, 3) of these bodies, the first grabbed for a while, and the records."""
    sim = simulation(*bodies(), gravity=(0, -9.81, 0), tolerance=tolerance, max_iterations=5000, **solver)
    sim.world.v[sim.world.bodies[1].nodes] += np.random.default_rng(0).normal(size=(45, 3))
    touch = sim.touch
    assert touch is not None
    source = Building(sim)
    driver, frames, records = Driver(sim, source), [], []
    for step in range(STEPS):
        if step == GRABBED[0]:
            tip = sim.world.x[sim.world.bodies[0].nodes][-1]
            touch.grab("anna", "bar", tuple(tip), 0.6, tuple(np.add(tip, (0, 0.5, 0.2))), 1e6, 0, 1e9)
        if step == GRABBED[1]:
            touch.release("anna", 1)
        records.append(driver.advance(1))
        frames.append(sim.world.x.copy())
    assert (source.built > 0) == (solver.get("build") == "worker")
    return np.array(frames), np.concatenate(records)


@pytest.fixture(scope="module")
def reference() -> NDArray:
    return trajectory(1e-13, preconditioner="block_jacobi")[0]


@pytest.mark.parametrize("solver", WAYS.values(), ids=WAYS.keys())
def test_the_trajectory_is_the_same(solver, reference):
    """To 1e-7 of a fall of metres over 40 steps, each solved to 1e-10."""
    frames, records = trajectory(**solver)
    assert (records["status"] == 0).all()
    assert (records["residual"] <= TOLERANCE).all()
    assert np.abs(reference[-1] - reference[0]).max() > 1
    assert np.abs(frames - reference).max() < 1e-7


def test_the_deviation_is_the_tolerance(reference):
    """A looser solve deviates in proportion, about: what is bought with a tolerance is accuracy, nothing else."""
    deviation = {
        t: np.abs(trajectory(t, preconditioner="block_jacobi")[0] - reference).max() for t in (1e-3, 1e-6, 1e-9)
    }
    assert deviation[1e-3] < 0.1
    assert deviation[1e-6] < 1e-2 * deviation[1e-3]
    assert deviation[1e-9] < 1e-2 * deviation[1e-6]


@pytest.mark.parametrize("solver", [WAYS["auto lockstep-3"], WAYS["cholesky every-7"]], ids=["auto", "every-7"])
def test_a_run_repeats_bit_for_bit(solver):
    """auto counts bytes, not seconds, where runs must repeat."""
    (first, a), (second, b) = trajectory(**solver), trajectory(**solver)
    assert np.array_equal(first, second)
    for field in ("iterations", "factor_step", "kind", "residual"):
        assert np.array_equal(a[field], b[field])


def test_what_corrects_a_factor_is_at_work():
    """For the grab (woodbury): fewer iterations than without."""

    def iterations(**solver) -> int:
        return int(trajectory(**solver)[1]["iterations"].sum())

    assert iterations(**WAYS["cholesky every-7"]) < 0.97 * iterations(**WAYS["cholesky every-7, uncorrected"])
