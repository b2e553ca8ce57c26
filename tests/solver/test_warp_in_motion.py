# SPDX-License-Identifier: MIT
"""Benefit of the warp in scenes: mean iterations of PCG with a factor that is 10 to 20 steps old.

Numbers found (12 x 3 x 3 cells, tolerance 1e-6, lockstep-10; block Jacobi alone: 20): falling beam 3.2 with warp, 7.3
without; load turning about the axis by 0.05 rad a step 4.0 and 11.8; beam of 1000:50:10 in stiffness 10 and 26.
"""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.effects.gravity import Gravity
from sim_server.mesh import pose_matrix
from sim_server.updates.driver import Driver
from tests.scenes import bar, simulation

POSE = (40.0, 0.0, 70.0)  # degrees about x, y, z
DOWN = np.array([0.0, -9.81, 0.0])
STIFF_TO_SOFT = [{"where": "Z < 1.4", "young": 5e6}, {"where": "Z < 2.8", "young": 2.5e5}, {"young": 5e4}]
HOMOGENEOUS = {"cells": (12, 3, 3), "size": (10, 2, 2), "young": 5e5, "fixed": "X < 0.01"}
BANDS = {"cells": (5, 5, 21), "size": (1, 1, 4.2), "young": STIFF_TO_SOFT, "fixed": "Z < 0.01"}


def turning_about(axis: str, angle: float) -> NDArray:
    """Gravity turned about a coordinate axis."""
    rotate = {"x": (angle, 0, 0), "z": (0, 0, angle)}[axis]
    return pose_matrix(np.degrees(rotate)) @ DOWN


def iterations(
    beam: dict,
    warp: bool,
    steps: int,
    spin: float = 0.0,
    axis: str = "x",
    posed: bool = False,
    update: str = "lockstep-10",
) -> NDArray:
    """Iterations of each step, (steps,). spin: angle of the load's rotation about the beam's axis in a step [rad]."""
    pose: dict[str, Any] = {"pose": {"rotate": list(POSE)}} if posed else {}
    sim = simulation(
        bar(poisson=0.4, damping=(0.1, 0.01), **beam, **pose), gravity=(0, -9.81, 0), preconditioner="cholesky",
        warp=warp, update=update, max_iterations=3000,
    )  # fmt: skip
    gravity = sim.effects["gravity"]
    assert isinstance(gravity, Gravity)
    frame = pose_matrix(POSE) if posed else np.eye(3)
    driver, out = Driver(sim), []
    for n in range(steps):
        gravity.g[:] = frame @ turning_about(axis, n * spin)  # the kernel reads it in each step
        record = driver.advance(1)[0]
        assert record["status"] == 0
        out.append(int(record["iterations"]))
    return np.array(out)


def test_a_posed_beam_takes_as_many_iterations_as_an_unposed_one():
    """Gravity turned with it, the motion is the same; within 5 % in the mean, and each step within one."""
    unposed = iterations(HOMOGENEOUS, True, 60)
    posed = iterations(HOMOGENEOUS, True, 60, posed=True)
    without = iterations(HOMOGENEOUS, False, 60, posed=True)
    assert posed[10:].mean() == pytest.approx(unposed[10:].mean(), rel=0.05)
    assert np.abs(posed[10:] - unposed[10:]).max() <= 1
    assert posed[10:].mean() < 0.55 * without[10:].mean()
    assert posed[10:].mean() < 0.25 * posed[:10].mean()  # the first ten steps have no factor: block Jacobi


@pytest.mark.parametrize("posed", [False, True])
def test_a_load_that_turns_about_the_axis(posed):
    with_warp, without = (iterations(HOMOGENEOUS, w, 100, spin=0.05, posed=posed)[20:].mean() for w in (True, False))
    assert with_warp < 0.5 * without


def test_bands_of_stiffness():
    """1000:50:10, the load turning: the soft end turns far. Less than half of the iterations, too."""
    with_warp, without = (iterations(BANDS, w, 80, spin=0.05, axis="z")[20:].mean() for w in (True, False))
    assert with_warp < 0.5 * without


def test_bands_of_stiffness_without_a_turning_load():
    with_warp, without = (iterations(BANDS, w, 60)[20:].mean() for w in (True, False))
    assert with_warp < 0.75 * without
