# SPDX-License-Identifier: MIT
"""A part of a body that is 10,000 times as stiff as the rest: a bone in tissue, by a region of young."""

import numpy as np

from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import bar, scene

BONE = "abs(X - 0.5) < 0.3 and abs(Y - 0.15) < 0.06 and abs(Z - 0.15) < 0.06"


def falling(ratio: float) -> Simulation:
    """A bar that is clamped at one end and let go."""
    given = bar((10, 5, 5), (1, 0.3, 0.3), density=1000, young=None)
    regions = [{"where": BONE, "young": 1e6 * ratio, "poisson": 0.3}, {"young": 1e6}]
    given["effects"] = {"corotational": {"young": regions, "poisson": 0.45}, "fixed": {"where": "X < 0.001"}}
    return Simulation(scene(given, gravity=(0, -9.81, 0), preconditioner="cholesky", update="every-10"))


def largest_strain(sim: Simulation) -> tuple[float, float]:
    """In the bone, and in what is around it."""
    w, mesh = sim.fetch(), sim.world.bodies[0].mesh
    before, now = (np.swapaxes(x[mesh.tets][:, 1:] - x[mesh.tets][:, :1], 1, 2) for x in (w.rest, w.x))
    strain = np.abs(np.linalg.svd(now @ np.linalg.inv(before), compute_uv=False) - 1).max(axis=1)
    inside = (np.abs(mesh.centroids - [0.5, 0.15, 0.15]) < [0.3, 0.06, 0.06]).all(axis=1)
    return strain[inside].max(), strain[~inside].max()


def test_a_bone_in_tissue_keeps_its_shape_and_solves_stay_short():
    iterations = []
    for ratio in (1, 1e4):
        sim = falling(ratio)
        records = Driver(sim).advance(30)
        assert (records["status"] == 0).all()
        iterations.append(records["iterations"].mean())
        bone, tissue = largest_strain(sim)
        assert tissue > 0.03 and (bone < 1e-4) == (ratio > 1)
    assert iterations[1] < 2.5 * iterations[0]
