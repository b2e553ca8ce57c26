# SPDX-License-Identifier: MIT
"""Simulations in a program of one's own on a GPU: views without a copy, and forces."""

import numpy as np
import pytest

import warpfactor as wf
from tests.embedded.test_embedded import DT, GRID, falling
from tests.embedded.test_external_forces import SOLVER

pytestmark = pytest.mark.gpu


def test_views_are_the_memory_of_the_device() -> None:
    """Of CuPy, with DLPack; what steps write is seen in a view that was taken before."""
    import cupy

    with wf.Simulation(falling(wf.Mesh(GRID.rest, GRID.tets)), "gpu") as simulation:
        x, theirs = simulation.positions("cube"), cupy.from_dlpack(simulation.v)
        assert isinstance(x, cupy.ndarray) and isinstance(theirs, cupy.ndarray)
        simulation.step(10)
        np.testing.assert_allclose(theirs.get(), np.tile([0, -0.981, 0], (12, 1)), atol=1e-6)
        np.testing.assert_allclose(x.get()[:, 1], GRID.rest[:, 1] - DT**2 * 9.81 * 55, atol=1e-6)
        np.testing.assert_array_equal(x.get(), simulation.x.get())
        moved = simulation.displacements("cube")
        np.testing.assert_array_equal(moved, x.get() - GRID.rest)
        simulation.reset("cube")
        assert (x.get() == GRID.rest).all() and (theirs.get() == 0).all()


def test_forces_act_as_on_a_cpu() -> None:
    """Written in place by kernels of others, and as a whole from the host."""
    found = []
    for device in ("cpu", "gpu"):
        scene = {**falling(wf.Mesh(GRID.rest, GRID.tets), fixed={"where": "Z < 0.01"}), "effects": {}, **SOLVER}
        with wf.Simulation(scene, device, forces=True) as simulation:
            simulation.forces = np.linspace(0, 1, 36).reshape(12, 3)
            simulation.step(5)
            simulation.forces[...] *= -2
            simulation.step(5)
            simulation.forces = (0.0, 0.5, 0.0)
            records = simulation.step(5)
            assert (records["status"] == 0).all()
            found.append(np.asarray(simulation.displacements("cube")))
    assert np.abs(found[0]).max() > 1e-4
    np.testing.assert_allclose(*found, atol=1e-8)


def test_threads_make_factors_beside_its_steps() -> None:
    with wf.Simulation("gallery/beam", "gpu") as simulation:
        records = simulation.step(40)
        assert (records["status"] == 0).all() and records["factor_step"].max() >= 0
