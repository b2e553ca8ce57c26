# SPDX-License-Identifier: MIT
"""The tangent of corotational bodies in Rosenbrock-W steps: the default, its damping without blocks, spun bodies."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.backends.rosenbrock import FORMS
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.physics.test_exact_tangent import clamped
from tests.physics.test_forces import stir
from tests.scenes import bar, elastic, scene, simulation

STAGES = {"scheme": "ros2"}


def test_by_default_it_is_exact_where_rotations_are_polar():
    """Other choices hold."""
    given: list[dict[str, Any]] = [{}, {"tangent": "usual"}, {"rotation": "qr"}, {"tangent": "exact"}]
    made = scene(*(bar(name=f"b{k}", **table) for k, table in enumerate(given)), integrator=STAGES)
    tangents = [o.effects["corotational"].tangent for o in made.objects]
    assert tangents == ["exact", "usual", "usual", "exact"]
    assert Scene.model_validate(made.resolved()).resolved() == made.resolved()


def stirred(size: float, damping: tuple[float, float]) -> Simulation:
    """A free bar, partly stretched and partly pressed, and moving; A in the world frame."""
    sim = simulation(bar((4, 2, 2), (2, 1, 1), damping=damping), dt=0.02, warp=False, integrator=STAGES)
    X = sim.world.rest
    sim.world.x[:] = X * [1.2, 0.95, 0.95] + 0.1 * X[:, :1] ** 2 * [0, 1, 0.5]
    stir(sim, size)
    return sim


def impulses(sim: Simulation, frames: bool, v: NDArray) -> NDArray:
    """b of the forces alone, with a given velocity of the damping by the stiffness."""
    sim.world.damping_velocity[:] = v
    for launch in sim.force_launches(frames):
        launch()
    return sim.system.b.copy()


@pytest.mark.parametrize("frames", [True, False])
@pytest.mark.parametrize("size", [0.01, 0.2])
def test_damping_without_blocks_is_the_product_with_the_assembled_matrix(size, frames):
    """Elements with clamped and with positive twists; the tangent of the usual kind would not do."""
    sim = stirred(size, (0.0, 0.03))
    assert 0 < clamped(sim) < len(elastic(sim).elements)
    names = {launch.name for launch in sim.force_launches(frames)}
    assert "corotational_exact.forces" in names and not any("blocks" in n or "exact_nodes" in n for n in names)
    sim.engine.assemble()
    w = sim.world
    stiffness = sim.matrix().toarray() - np.diag(np.repeat(w.mass, 3))  # g h (g h + beta) K
    random = np.random.default_rng(3).normal(size=w.v.shape)
    found = impulses(sim, frames, random) - impulses(sim, frames, np.zeros_like(random))
    expected = -(stiffness @ random.ravel()).reshape(-1, 3)
    assert np.abs(found - expected).max() < 1e-12 * np.abs(expected).max()
    usual = simulation(
        bar((4, 2, 2), (2, 1, 1), damping=(0.0, 0.03), tangent="usual"), dt=0.02, warp=False, integrator=STAGES
    )
    usual.world.x[:] = w.x
    usual.engine.assemble()
    other = usual.matrix().toarray() - np.diag(np.repeat(w.mass, 3))
    assert np.abs((other - stiffness) @ random.ravel()).max() > 0.01 * np.abs(expected).max()


def test_without_damping_of_the_stiffness_forces_need_no_tangent():
    """Both tangents have the same forces then, bit for bit."""
    found = []
    for tangent in ("usual", "exact"):
        sim = simulation(bar((4, 2, 2), (2, 1, 1), damping=(0.3, 0.0), tangent=tangent), integrator=STAGES)
        stir(sim, 0.1)
        found.append(impulses(sim, True, np.zeros_like(sim.world.v)))
        assert "corotational.forces" in {launch.name for launch in sim.force_launches(True)}
    assert np.array_equal(*found) and np.abs(found[0]).max() > 0


def spun(tangent: str, poisson: float, solve: str) -> tuple[float, NDArray]:
    """Energy that a held bar of 4 m which began at 20 rad/s has left after 6 s, over that at the start; the forms."""
    mesh = {"bar": [2, 2, 6], "size": [1, 1, 4], "split": "mirrored"}
    held = bar(mesh=mesh, young=1e6, poisson=poisson, damping=(1.0, 0.0), fixed="Z < 0.01", tangent=tangent)
    integrator = {**STAGES, "solve": solve}
    sim = simulation(held, dt=0.02, integrator=integrator, preconditioner="cholesky", update="lockstep-10")
    w = sim.world
    w.v[:] = w.free[:, None] * np.cross([0, 0, 20.0], w.rest - [0.5, 0.5, 0])
    start = sim.kinetic_energy()
    forms = Driver(sim).advance(300)["form"]
    return (sim.kinetic_energy() + sim.potential_energy()) / start, np.bincount(forms, minlength=4)


@pytest.mark.parametrize("solve", ["iterate", "factor"])
@pytest.mark.parametrize(("poisson", "fed"), [(0.49, 1e-4), (0.499, 0.1)])
def test_a_nearly_incompressible_body_that_was_spun_comes_to_rest(poisson, fed, solve):
    """With the usual tangent steps go back to backward Euler again and again, and a vibration is fed."""
    left, forms = spun("auto", poisson, solve)
    assert left < 2e-5 and forms[FORMS["EULER"]] < 0.05 * forms.sum()
    left, forms = spun("usual", poisson, solve)
    assert left > fed and forms[FORMS["EULER"]] > 0.1 * forms.sum()
