# SPDX-License-Identifier: MIT
"""The generalized-alpha method against its amplification matrix, a plain reference, and what it should keep."""

import numpy as np
import pytest
from numpy.typing import NDArray

from protocol.messages_pb2 import SolveStatus
from sim_server.scene.integrator_options import IntegratorOptions
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.holders.holder_scenes import held_bar, left
from tests.physics.test_cantilever import lowest_mode
from tests.reference.generalized_alpha import Motion, amplification, parameters
from tests.scenes import bar, simulation, solid

TIGHT = {"tolerance": 1e-13, "preconditioner": "block_jacobi", "max_iterations": 5000}
RADII = (0.0, 0.5, 0.8, 1.0)


def alpha(rho: float | None = None, linearizations: int = 1, tolerance: float = 1e-11) -> dict:
    given = {} if rho is None else {"spectral_radius": rho}
    return {"scheme": "generalized_alpha", "linearizations": linearizations, "tolerance": tolerance, **given}


# --- one mode ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("wh", [0.05, 1.0, 30.0, 1e3])
@pytest.mark.parametrize("rho", RADII)
def test_a_mode_is_amplified_as_the_closed_form_says(rho, wh):
    """Small oscillations in one mode: step by step the powers of the amplification matrix."""
    held = bar((3, 1, 1), (1.5, 0.5, 0.5), young=1e5, fixed="X < 0.01")
    w, shape = lowest_mode(simulation(held, dt=0.01))
    sim = simulation(held, dt=wh / w, integrator=alpha(rho), on_runaway="go_on", **TIGHT)
    m = sim.world.mass[:, None]
    sim.world.x += 1e-7 * shape
    sim.world.v[:] = 5e-8 * w * shape
    state, largest = np.array([1.0, 0.5 * wh, -(wh**2)]), np.array([1.0, 0.5])
    for _ in range(6):
        sim.engine.run(1)
        state = amplification(rho, wh) @ state
        found = [(m * shape * change).sum() / 1e-7 for change in (sim.world.x - sim.world.rest, sim.world.v / w)]
        expected = np.array([state[0], state[1] / wh])
        largest = np.maximum(largest, abs(expected))
        np.testing.assert_allclose(found / largest, expected / largest, atol=2e-5)


@pytest.mark.parametrize("rho", RADII)
def test_the_spectral_radius_is_the_one_asked_for(rho):
    """At infinite frequency; never above 1; hardly below at low ones, where all but rho = 1 lose at order 3."""
    given, expected = IntegratorOptions(**alpha(rho)), parameters(rho)
    assert given.alpha == pytest.approx(expected)
    radius = {wh: np.abs(np.linalg.eigvals(amplification(rho, wh))).max() for wh in (0.05, 0.1, 1, 10, 1e3, 1e7)}
    assert radius[1e7] == pytest.approx(rho, abs=2e-3)  # roots that coincide are found to a root of rounding
    assert max(radius.values()) <= 1 + 1e-7
    lost = 1 - radius[0.05], 1 - radius[0.1]
    assert lost[1] < 1e-4
    if rho < 1:
        assert np.log2(lost[1] / lost[0]) == pytest.approx(4, abs=0.2)
    else:
        assert given.force_coefficient(0.1) == given.dx_dv(0.1) == pytest.approx(0.05)  # the mid-point rule
        assert lost == pytest.approx((0, 0), abs=1e-12)


# --- large motion -----------------------------------------------------------------------------------------------------


def swinging(rho: float, linearizations: int, tolerance: float = 1e-11) -> Simulation:
    """A jolted, damped, heavy bar with the usual tangent."""
    held = bar((3, 1, 1), (1.5, 0.5, 0.5), young=3e4, fixed="X < 0.01", damping=(0.5, 0.02), tangent="usual")
    integrator = alpha(rho, linearizations, tolerance)
    sim = simulation(held, dt=0.05, gravity=(0, -9.81, 1), integrator=integrator, projection="none", **TIGHT)
    sim.world.v[:] = sim.world.free[:, None] * np.random.default_rng(0).normal(size=sim.world.v.shape)
    return sim


@pytest.mark.parametrize("linearizations", [1, 16])
@pytest.mark.parametrize("rho", [0.0, 0.8])
def test_steps_are_those_of_the_plain_reference(rho, linearizations):
    sim = swinging(rho, max(2, linearizations), 0.999 if linearizations == 1 else 1e-12)
    plain = Motion.begun(solid(sim))
    for _ in range(4):
        sim.engine.run(1)
        plain = plain.step(rho, linearizations)
    assert (sim.engine.records()["linearizations"] == 1).all() or linearizations > 1
    np.testing.assert_allclose(sim.world.x, plain.solid.x, atol=1e-9)
    np.testing.assert_allclose(sim.world.v, plain.solid.v, atol=1e-7)
    assert np.abs(sim.world.x - sim.world.rest).max() > 0.2


def spin(sim: Simulation) -> NDArray:
    w = sim.world
    return np.asarray(np.einsum("n,ni->i", w.mass, np.cross(w.x - w.mass @ w.x / w.mass.sum(), w.v)))


@pytest.mark.parametrize("rho", [0.8, 1.0])
def test_a_body_that_turns_goes_on_turning(rho):
    """With rho = 1 a soft one that tumbles keeps its angular momentum to the residual, with less a stiff one nearly."""
    young = 2e4 if rho == 1 else 1e8
    free = bar((4, 2, 2), (2, 1, 1), young=young)
    lost = []
    for dt in (0.04, 0.02):
        sim = simulation(free, dt=dt, integrator=alpha(rho, 30, 1e-12), **TIGHT)
        w = sim.world
        w.v[:] = np.cross([0.5, 0, 2.0], w.x - w.mass @ w.x / w.mass.sum())
        before = spin(sim)
        sim.engine.run(round(1 / dt))
        lost.append(np.linalg.norm(spin(sim) - before) / np.linalg.norm(before))
    if rho == 1:
        assert max(lost) < 1e-9, lost
    else:
        assert lost[1] < 2e-3 and lost[1] < 0.3 * lost[0], lost


VIOLENT = {
    "stretched": lambda x, random: x * [3, 1, 1],
    "pressed": lambda x, random: x * [0.2, 1, 1],
    "inside out": lambda x, random: x * [-1, 1, 1],
    "random": lambda x, random: random.uniform(x.min(axis=0), x.max(axis=0), x.shape),
}


@pytest.mark.parametrize("dt", [0.01, 0.02])
@pytest.mark.parametrize("start", VIOLENT)
def test_it_dies_down_after_a_violent_start(start, dt):
    """Without damping, and with one linearization; newmark runs away from each of these."""
    lasting = {}
    for scheme in ("newmark", "generalized_alpha"):
        held = bar((9, 2, 2), (4, 1, 1), young=1e6, poisson=0.45, fixed="X < 0.01")
        sim = simulation(held, dt=dt, integrator={"scheme": scheme}, preconditioner="block_jacobi", max_iterations=2000)
        w = sim.world
        w.x[:] = np.where(w.free[:, None] > 0, VIOLENT[start](w.rest, np.random.default_rng(0)), w.x)
        before = sim.potential_energy()
        sim.engine.run(round(4 / dt))
        lasting[scheme] = sim.kinetic_energy() + sim.potential_energy()
        away = sim.engine.records()["status"] == SolveStatus.RUNAWAY
        assert away.any() == (scheme == "newmark"), scheme
    assert lasting["generalized_alpha"] < 0.05 * before


# --- what moves it ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("linearizations", [1, 10])
def test_a_bar_that_its_holder_moves_is_of_second_order(linearizations):
    """Held nodes are where the forces balance, not at the end of the step. Small strains, and the exact tangent, by
    which one linearization and several are damped alike."""
    keys = [{"time": t, "translate": [0, 0.2 * t, 0.1 * t]} for t in (0.0, 1.0)]
    ends = {}
    for scheme, dt in (("newmark", 0.00125), ("generalized_alpha", 0.02), ("generalized_alpha", 0.01)):
        integrator = {"scheme": scheme, "linearizations": 10 if scheme == "newmark" else linearizations}
        sim = held_bar(
            left(keyframes=keys),
            integrator=integrator | {"tolerance": 1e-10},
            dt=dt,
            damping=(0, 0.05),
            tangent="exact",
        )
        sim.world.v[:] = [0, 0.2, 0.1]
        sim.world.v[:, 1] += 1e-3 * sim.world.x[:, 0] ** 2
        sim.engine.run(round(0.4 / dt))
        ends[scheme, dt] = sim.world.x.copy()
    error = [np.linalg.norm(ends["generalized_alpha", dt] - ends["newmark", 0.00125]) for dt in (0.02, 0.01)]
    assert np.log2(error[0] / error[1]) > 1.7, error


def test_factors_of_old_matrices_do_as_well_as_in_newmarks_scheme():
    """Warped, 5 to 9 steps old."""
    iterations = []
    for scheme in ("newmark", "generalized_alpha"):
        beam = bar((8, 2, 2), (4, 1, 1), young=2e5, fixed="X < 0.01", damping=(0.1, 0))
        solver = {"preconditioner": "cholesky", "update": "lockstep-5", "tolerance": 1e-6}
        sim = simulation(beam, dt=0.02, gravity=(0, -9.81, 0), integrator={"scheme": scheme}, **solver)
        records = Driver(sim).advance(60)
        assert not records["status"].any() and not records["fallbacks"].any()
        iterations.append(records["iterations"][10:].mean())
    assert iterations[1] < 1.2 * iterations[0], iterations
