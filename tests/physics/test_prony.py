# SPDX-License-Identifier: MIT
"""Viscous branches against the closed forms of the standard linear solid."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.errors import InputError
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.reference import history as reference
from tests.scenes import bar, simulation

YOUNG, POISSON = 1e4, 0.3
MU = YOUNG / (2 * (1 + POISSON))
BULK = YOUNG / (3 * (1 - 2 * POISSON))
QUASI_STATIC = {"scheme": "quasi_static", "linearizations": 10}
SYMMETRY = [{"where": f"{axis} < 1e-4", "along": axis.lower()} for axis in "XYZ"]
SLIDING = [{"where": "true", "along": ["y", "z"]}]


def specimen(terms: list[dict], fixed: list[dict], dt: float, law: dict | None = None, **table: Any) -> Simulation:
    """A bar of 2 x 1 x 1 m without inertia."""
    effects = law or {"corotational": {"young": YOUNG, "poisson": POISSON}}
    effects |= {"prony": {"terms": terms}, "fixed": {"tables": fixed}} | table.pop("effects", {})
    solver = {"preconditioner": "block_jacobi", "tolerance": 1e-12}
    body = {"name": "bar", "mesh": {"bar": [2, 1, 1], "size": [2, 1, 1]}, "effects": effects}
    return Simulation(Scene.model_validate(
        {"name": "test", "dt": dt, "object": [body], "integrator": QUASI_STATIC, "solver": solver, **table}
    ))  # fmt: skip


def pulled(terms: list[dict], dt: float, strains: NDArray) -> NDArray:
    """Axial stress [Pa] of a bar that cannot contract sideways, after steps that end at these strains."""
    frames = [{"time": 0.0}] + [{"time": dt * (k + 1), "translate": [2 * e, 0, 0]} for k, e in enumerate(strains)]
    grip = {"name": "grip", "object": "bar", "where": "X > 1.99", "keyframes": frames}
    sim = specimen(terms, [{"where": "X < 1e-4"}, *SLIDING], dt, holder=[grip])
    found = []
    for _ in strains:
        sim.engine.run(1)
        found.append(-sim.world.reaction[0, 0, 0])  # on the grip, of 1 m2
    return np.array(found)


TERMS = [{"g": 0.5, "tau": 0.1}, {"g": 1.5, "tau": 0.7}]
ALMOST_ALONE = {"corotational": {"young": 1e-12 * YOUNG, "poisson": 0}, "prony": {"terms": TERMS, "shear": MU}}


def test_stress_relaxes_as_the_series_says():
    """A strain that grows over the first step and stays: the update is exact for it, and so is the stress."""
    dt, steps, strain = 0.05, 40, 1e-2
    time = dt * np.arange(1, steps + 1)
    expected = (BULK + 4 / 3 * MU) * strain + np.zeros(steps)
    for term in TERMS:
        g, tau = term["g"], term["tau"]
        q = strain * tau / dt * (np.exp(dt / tau) - 1) * np.exp(-time / tau)
        expected += 4 / 3 * MU * g * q
    np.testing.assert_allclose(pulled(TERMS, dt, np.full(steps, strain)), expected, rtol=1e-8)
    assert expected[0] > 1.5 * expected[-1]


@pytest.mark.parametrize(("cycle", "within"), [(50, 4e-3), (100, 1e-3)])
def test_a_sinusoid_has_the_storage_and_loss_modulus(cycle: int, within: float):
    """Of the shear modulus, by the stress of the last of some cycles; the error is of second order in dt."""
    g, tau, omega, strain = 0.8, 0.2, 5.0, 1e-3
    dt = 2 * np.pi / omega / cycle
    phase = 2 * np.pi / cycle * np.arange(1, 4 * cycle + 1)
    stress = pulled([{"g": g, "tau": tau}], dt, strain * np.sin(phase))[-cycle:]
    last = phase[-cycle:]
    amplitudes = np.linalg.lstsq(np.stack([np.sin(last), np.cos(last)], axis=1), stress, rcond=None)[0] / strain
    storage, loss = (amplitudes - [BULK, 0]) * 3 / 4
    product = omega * tau
    np.testing.assert_allclose(storage, MU * (1 + g * product**2 / (1 + product**2)), rtol=within)
    np.testing.assert_allclose(loss, MU * g * product / (1 + product**2), rtol=within)


def test_the_error_of_a_smooth_path_is_of_second_order():
    g, tau, strain, end = 0.8, 0.2, 1e-3, 1.6
    errors = []
    for steps in (20, 40, 80):
        dt = end / steps
        time = dt * np.arange(1, steps + 1)
        stress = pulled([{"g": g, "tau": tau}], dt, strain * time**2)
        q = strain * 2 * tau * (end - tau * (1 - np.exp(-end / tau)))  # of dq/dt = 2 t - q / tau
        errors.append(abs(stress[-1] - (BULK + 4 / 3 * MU) * strain * end**2 - 4 / 3 * MU * g * q))
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 2, atol=0.05)


LAWS = {
    "corotational": {"corotational": {"young": YOUNG, "poisson": POISSON}},
    "neo_hookean": {"neo_hookean": {"young": YOUNG, "poisson": POISSON}},
    "mooney_rivlin": {"mooney_rivlin": {"c1": 0.3 * MU, "c2": 0.2 * MU, "bulk": BULK}},
}


@pytest.mark.parametrize("law", LAWS)
def test_a_bar_creeps_as_a_standard_linear_solid(law: str):
    """Under a load that comes at once: 1 / E(t) = 1 / (9 K) + J(t) / 3."""
    g, tau, dt, stress = 0.8, 0.1, 1e-3, 1.0
    load = {"where": "X > 1.99", "stress": [stress, 0, 0]}
    sim = specimen([{"g": g, "tau": tau}], SYMMETRY, dt, dict(LAWS[law]), effects={"traction": load})
    times, found = [], []
    for steps in (20, 80, 100, 200, 400):
        sim.engine.run(steps)
        times.append(sim.engine.step * dt)
        found.append((sim.fetch().x[:, 0].max() - 2) / 2)
    compliance = (1 - g / (1 + g) * np.exp(-np.array(times) / (tau * (1 + g)))) / MU
    expected = stress * (1 / (9 * BULK) + compliance / 3)
    np.testing.assert_allclose(found, expected, rtol=5e-3)
    assert expected[-1] > 1.4 * expected[0]


def test_forces_and_energy_are_those_of_the_textbook():
    """In a deformation at random with a memory at random, beside the plain reference."""
    sim = simulation(bar((2, 1, 1), (2, 1, 1), effects=ALMOST_ALONE, young=None))
    effect, world = sim.effects["prony"], sim.world
    random, m = np.random.default_rng(3), len(effect.elements)
    world.x += random.normal(scale=0.1, size=world.x.shape)
    q = [reference.deviator(0.1 * (a + a.transpose(0, 2, 1))) for a in random.normal(size=(2, m, 3, 3))]
    reached = reference.deviator(0.1 * np.ones((m, 1, 1)) * np.diag([1.0, 2, 3]))
    effect.memory["reached"][...] = reference.rows(reached)
    effect.memory["overstrain"][...] = np.concatenate([reference.rows(each) for each in q])
    strain = reference.deviator(reference.turned(world.x, world.rest, effect.elements)[1] - np.eye(3))
    after = []
    for each, term in zip(q, TERMS, strict=True):
        left, tau = np.exp(-world.dt / term["tau"]), term["tau"]
        after.append(left * each + tau / world.dt * (1 - left) * (strain - reached))
    stress = sum(2 * MU * term["g"] * each for each, term in zip(after, TERMS, strict=True))
    for launch in sim.launches()[0]:
        launch()
    expected = reference.forces(world.x, world.rest, effect.elements, stress)
    np.testing.assert_allclose(sim.system.b / world.dt, expected, atol=1e-10 * np.abs(expected).max())
    squares = sum(term["g"] * (each**2).sum(axis=(1, 2)) for each, term in zip(after, TERMS, strict=True))
    np.testing.assert_allclose(effect.energy(), MU * reference.gradients(world.rest, effect.elements)[0] @ squares)


def test_the_tangent_is_that_of_the_forces_where_nothing_turns():
    """At rest, for any displacement: f = -K u to first order, and K has no negative eigenvalue."""
    sim = simulation(bar((1, 1, 1), (1, 1, 1), effects=ALMOST_ALONE, young=None), dt=1.0,
                     warp=False)  # fmt: skip
    world = sim.world

    def run() -> NDArray:
        for launch in sim.launches()[0]:
            launch()
        return sim.system.b.copy()

    run()
    K = sim.matrix().toarray() - np.diag(np.repeat(world.mass, 3))
    u = 1e-7 * np.random.default_rng(0).normal(size=world.x.shape)
    world.x += u
    np.testing.assert_allclose(run().ravel(), -K @ u.ravel(), atol=1e-5 * np.abs(K @ u.ravel()).max())
    assert np.linalg.eigvalsh(K).min() > -1e-9 * np.abs(K).max()


def test_a_body_that_turns_remembers_nothing():
    effects = {"prony": {"terms": TERMS}}
    table = bar((2, 2, 2), (0.2, 0.2, 0.2), young=YOUNG)
    table["effects"] |= effects
    sim = simulation(table, dt=1e-3, preconditioner="block_jacobi", tolerance=1e-12)
    x = sim.world.x - sim.world.x.mean(axis=0)
    for k in range(1, 40):
        angle = 0.1 * k
        turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
        sim.world.x[...], sim.world.v[...] = x @ turn.T, 0
        sim.engine.run(1)
        assert np.abs(sim.effects["prony"].memory["overstrain"]).max() < 1e-13


@pytest.mark.parametrize("scheme", ["backward_euler", "newmark", "bdf2", "generalized_alpha"])
def test_energy_never_grows_and_momenta_stay(scheme: str):
    """A free body that was bent, twisted and spun. The total energy has that of the branches."""
    table = bar((4, 2, 2), (0.4, 0.1, 0.1), young=YOUNG)
    table["effects"] |= {"prony": {"terms": [{"g": 1.0, "tau": 0.02}]}}
    sim = simulation(
        table, dt=2e-3, preconditioner="block_jacobi", tolerance=1e-11, max_iterations=2000,
        integrator={"scheme": scheme, "linearizations": 20, "tolerance": 1e-9},
    )  # fmt: skip
    w = sim.world
    r = w.x - w.x.mean(axis=0)
    w.v[...] = np.cross([3.0, 5.0, 9.0], r) + np.stack([2 * r[:, 1], 20 * r[:, 0] ** 2, -3 * r[:, 0]], axis=1)

    def state() -> tuple[float, NDArray, NDArray]:
        sim.fetch()
        momentum = w.mass @ w.v
        return sim.potential_energy() + sim.kinetic_energy(), momentum, w.mass @ np.cross(w.x, w.v)

    energies, momenta, spins = zip(*[(sim.engine.run(1), state())[1] for _ in range(150)], strict=True)
    assert (np.diff(energies) < 0).all()
    assert energies[-1] < 0.9 * energies[0]
    np.testing.assert_allclose(momenta[-1], momenta[0], atol=1e-6 * np.abs(spins[0]).max())
    if scheme != "backward_euler":  # which takes spin
        np.testing.assert_allclose(spins[-1], spins[0], atol=1e-3 * np.abs(spins[0]).max())


@pytest.mark.parametrize("scheme", ["newmark", "generalized_alpha"])
def test_steps_keep_the_order_of_their_scheme(scheme: str):
    """A bar that swings, in three step sizes: forces are those at the instant for which the scheme solves."""

    def after(steps: int) -> NDArray:
        table = bar((4, 1, 1), (0.4, 0.1, 0.1), young=1e5, fixed="X < 0.01")
        table["effects"] |= {"prony": {"terms": [{"g": 1.0, "tau": 0.02}, {"g": 0.5, "tau": 0.3}]}}
        sim = simulation(
            table, dt=0.2 / steps, preconditioner="block_jacobi", tolerance=1e-12, max_iterations=3000,
            integrator={"scheme": scheme, "linearizations": 20, "tolerance": 1e-10},
        )  # fmt: skip
        x = sim.world.rest[:, 0]
        sim.world.v[...] = np.stack([0 * x, 0.5 * x**2, 0.3 * x], axis=1) * sim.world.free[:, None]
        sim.engine.run(steps)
        return sim.fetch().x.copy()

    coarse, middle, fine = (after(steps) for steps in (400, 800, 1600))
    assert np.log2(np.abs(middle - coarse).max() / np.abs(fine - middle).max()) > 1.85


def test_a_modulus_is_needed_and_may_be_given():
    with pytest.raises(InputError, match=r"object 'bar', effect prony: nothing beside it has a shear modulus .* shear"):
        simulation(bar(young=None, effects={"prony": {"terms": TERMS}}))
    costa = {"a": 1e3, "bulk": 1e5, "fibre": [1, 0, 0], "sheet": [0, 1, 0]}
    sim = simulation(bar(young=None, effects={"costa": costa, "prony": {"terms": TERMS, "shear": 1e3}}))
    assert set(sim.effects["prony"].shear) == {1e3}


def test_regions_and_terms_are_those_of_each_body():
    regions = [{"where": "X < 1", "young": 1e5}, {"young": 2e5}]
    objects = [bar(name=name, young=regions, effects={}) for name in ("a", "b")]
    objects[0]["effects"] = {"corotational": {"young": regions, "poisson": 0.25}, "prony": {"terms": TERMS}}
    objects[1]["effects"] = {"corotational": {"young": 3e5, "poisson": 0.5 - 1e-3}, "prony": {"terms": TERMS[:1]}}
    effect = simulation(*objects).effects["prony"]
    assert effect.weight.shape[0] == 2
    second = effect.owner == 1
    assert not effect.weight[1, second].any() and (effect.weight[1, ~second] == TERMS[1]["g"]).all()
    assert (effect.tau[0] == TERMS[0]["tau"]).all()
    left = effect.world.rest[effect.elements].mean(axis=1)[:, 0] < 1
    np.testing.assert_allclose(effect.shear[left & ~second], 1e5 / 2.5)
    np.testing.assert_allclose(effect.shear[~left & ~second], 2e5 / 2.5)
    np.testing.assert_allclose(effect.shear[second], 3e5 / (2 * (1.5 - 1e-3)))
