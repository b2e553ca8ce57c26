# SPDX-License-Identifier: MIT
"""Plastic flow against the closed forms of a bar in tension, and against the plain reference."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.errors import InputError
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from tests.reference import history as reference
from tests.scenes import bar, elastic, simulation

YOUNG, POISSON = 1e5, 0.3
MU, BULK = YOUNG / 2.6, YOUNG / 1.2
SYMMETRY = [{"where": f"{axis} < 1e-4", "along": axis.lower()} for axis in "XYZ"]


def specimen(linearizations: int = 20, **flow: Any) -> Simulation:
    """A bar of 2 x 1 x 1 m without inertia, under a stress that is set."""
    effects = {
        "corotational": {"young": YOUNG, "poisson": POISSON}, "plasticity": flow,
        "fixed": {"tables": SYMMETRY}, "traction": {"where": "X > 1.99", "stress": [0, 0, 0]},
    }  # fmt: skip
    body = {"name": "bar", "mesh": {"bar": [2, 1, 1], "size": [2, 1, 1]}, "effects": effects}
    integrator = {"scheme": "quasi_static", "linearizations": linearizations, "tolerance": 1e-10}
    solver = {"preconditioner": "block_jacobi", "tolerance": 1e-12, "max_iterations": 2000}
    return Simulation(Scene.model_validate(
        {"name": "test", "dt": 0.1, "object": [body], "integrator": integrator, "solver": solver}
    ))  # fmt: skip


def pulled(sim: Simulation, stress: float, steps: int = 1) -> NDArray:
    """Strains along the axes once the load has this stress [Pa]."""
    sim.parameters.set({"bar.traction.stress": f"[{stress!r}, 0, 0]"})
    sim.engine.run(steps)
    assert (sim.engine.records()["status"] == 0).all()
    return (sim.fetch().x.max(axis=0) - [2, 1, 1]) / [2, 1, 1]


@pytest.mark.parametrize(("hardening", "kinematic"), [(2e4, 0.0), (0.0, 2e4), (5e3, 1.5e4)])
def test_a_bar_yields_hardens_and_keeps_what_has_flowed(hardening: float, kinematic: float):
    sim = specimen(yield_stress=100.0, hardening=hardening, kinematic=kinematic)
    total = hardening + kinematic
    for stress in (60.0, 99.9):
        np.testing.assert_allclose(pulled(sim, stress)[0], stress / YOUNG, rtol=1e-8)
    for stress in (120.0, 150.0, 200.0):
        strain = pulled(sim, stress)
        np.testing.assert_allclose(strain[0], stress / YOUNG + (stress - 100) / total, rtol=1e-7)
        np.testing.assert_allclose(strain.sum(), stress / (3 * BULK), rtol=1e-4)  # what flows keeps the volume
    for stress in (150.0, 50.0, 0.0):
        np.testing.assert_allclose(pulled(sim, stress)[0], stress / YOUNG + 100 / total, rtol=1e-7)
    reversed_ = -(200 - kinematic / total * 100 * 2)  # where it yields again
    np.testing.assert_allclose(pulled(sim, reversed_ + 0.1)[0], (reversed_ + 0.1) / YOUNG + 100 / total, rtol=1e-7)
    beyond = pulled(sim, reversed_ - 40.0)[0]
    np.testing.assert_allclose(beyond, (reversed_ - 40) / YOUNG + 60 / total, rtol=1e-7)
    hardened = sim.effects["plasticity"].memory["hardened"]  # as the last step began
    np.testing.assert_allclose(hardened, 100 / total, rtol=1e-6)


def test_one_linearization_comes_to_the_same_under_a_load_that_stays():
    """Its matrix is the elastic one, so each step takes what is left of the way."""
    sim = specimen(linearizations=1, yield_stress=100.0, hardening=2e5)
    np.testing.assert_allclose(pulled(sim, 200.0, steps=60)[0], 200 / YOUNG + 100 / 2e5, rtol=1e-8)


def test_perfect_plasticity_bears_no_more_shear():
    """A bar that cannot contract sideways: the stress is K strain + 2/3 yield_stress, whatever the strain."""
    grip = {"name": "grip", "object": "bar", "where": "X > 1.99",
            "keyframes": [{"time": 0.0}, {"time": 1.0, "translate": [0.08, 0, 0]}]}  # fmt: skip
    effects = {
        "corotational": {"young": YOUNG, "poisson": POISSON}, "plasticity": {"yield_stress": 100.0},
        "fixed": {"tables": [{"where": "X < 1e-4"}, {"where": "true", "along": ["y", "z"]}]},
    }  # fmt: skip
    body = {"name": "bar", "mesh": {"bar": [2, 1, 1], "size": [2, 1, 1]}, "effects": effects}
    sim = Simulation(Scene.model_validate({
        "name": "test", "dt": 0.1, "object": [body], "holder": [grip],
        "integrator": {"scheme": "quasi_static", "linearizations": 20, "tolerance": 1e-10},
        "solver": {"preconditioner": "block_jacobi", "tolerance": 1e-12},
    }))  # fmt: skip
    for k in range(1, 11):
        sim.engine.run(1)
        strain = 0.004 * k
        assert sim.engine.records()["status"][0] == 0
        expected = min(BULK + 4 / 3 * MU, BULK + 2 / 3 * 100 / strain) * strain
        np.testing.assert_allclose(-sim.world.reaction[0, 0, 0], expected, rtol=1e-7)


FLOW = {"yield_stress": 2e3, "hardening": 3e3, "kinematic": 2e3}


def deformed(scale: float, seed: int = 3) -> Simulation:
    """A body whose elements flow, with a memory at random."""
    sim = simulation(bar((2, 1, 1), (2, 1, 1), young=YOUNG, effects=None) | {
        "effects": {"corotational": {"young": YOUNG, "poisson": POISSON}, "plasticity": FLOW}
    }, preconditioner="block_jacobi", dt=1.0, warp=False)  # fmt: skip
    effect, random = sim.effects["plasticity"], np.random.default_rng(seed)
    sim.world.x += random.normal(scale=scale, size=sim.world.x.shape)
    p = reference.deviator(
        scale / 2 * (a := random.normal(size=(len(effect.elements), 3, 3))) + scale / 2 * a.transpose(0, 2, 1)
    )
    effect.memory["plastic"][...] = reference.rows(p)
    effect.memory["hardened"][...] = scale
    return sim


def assembled(sim: Simulation) -> NDArray:
    for launch in sim.launches()[0]:
        launch()
    return sim.system.b / sim.world.dt


def test_forces_and_energy_are_those_of_the_textbook():
    sim = deformed(0.08)
    effect, w = sim.effects["plasticity"], sim.world
    plastic = np.zeros((len(effect.elements), 3, 3))
    plastic[:, reference.ENTRIES[0], reference.ENTRIES[1]] = effect.memory["plastic"].T
    plastic[:, reference.ENTRIES[1], reference.ENTRIES[0]] = effect.memory["plastic"].T
    strain = reference.turned(w.x, w.rest, effect.elements)[1] - np.eye(3)
    after, _ = reference.plastic_return(strain, plastic, effect.memory["hardened"][0], MU, tuple(FLOW.values()))
    assert (np.abs(after - plastic).max(axis=(1, 2)) > 1e-4).mean() > 0.5, "most of them flow"
    stress = 2 * MU * (reference.deviator(strain) - after)
    stress += BULK * np.trace(strain, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    expected = reference.forces(w.x, w.rest, effect.elements, stress)
    np.testing.assert_allclose(assembled(sim), expected, atol=1e-9 * np.abs(expected).max())
    e = reference.deviator(strain) - after
    density = MU * (e**2).sum(axis=(1, 2)) + BULK / 2 * np.trace(strain, axis1=1, axis2=2) ** 2
    density += FLOW["kinematic"] / 3 * (after**2).sum(axis=(1, 2))
    volume = reference.gradients(w.rest, effect.elements)[0]
    np.testing.assert_allclose(effect.energy() + elastic(sim).energy(), volume @ density, rtol=1e-9)


def test_the_tangent_is_the_slope_of_the_forces():
    """At small strains, where little turns: with elements that flow, beside others."""
    sim = deformed(1e-4)
    effect = sim.effects["plasticity"]
    effect.constants[0] = 4.0
    w, u = sim.world, np.random.default_rng(0).normal(size=sim.world.x.shape)
    assembled(sim)
    K = sim.matrix().toarray() - np.diag(np.repeat(w.mass, 3))
    assert np.linalg.eigvalsh(K).min() > -1e-9 * np.abs(K).max()
    x, forces = w.x.copy(), []
    for sign in (1, -1):
        w.x[...] = x + sign * 1e-8 * u
        forces.append(assembled(sim).ravel())
    expected = -K @ u.ravel()
    np.testing.assert_allclose((forces[0] - forces[1]) / 2e-8, expected, atol=2e-3 * np.abs(expected).max())
    elastic_alone = deformed(1e-4)
    elastic_alone.effects["plasticity"].constants[0] = 1e9
    assembled(elastic_alone)
    K0 = elastic_alone.matrix().toarray() - np.diag(np.repeat(w.mass, 3))
    assert np.linalg.norm(K - K0) > 0.1 * np.linalg.norm(K0)


@pytest.mark.parametrize("tangent", ["usual", "exact"])
@pytest.mark.parametrize("hardening", [0.0, 1e4])
def test_the_matrix_is_positive_definite_at_large_strains(hardening: float, tangent: str):
    sim = deformed(0.3)
    sim.effects["plasticity"].constants[1:] = hardening
    assembled(sim)
    K = sim.matrix().toarray() - np.diag(np.repeat(sim.world.mass, 3))
    assert np.linalg.eigvalsh(K).min() > -1e-12 * np.abs(K).max()


@pytest.mark.parametrize("scheme", ["backward_euler", "newmark", "bdf2", "generalized_alpha"])
@pytest.mark.parametrize("linearizations", [1, 20])
def test_energy_never_grows(scheme: str, linearizations: int):
    """A free body that was thrown, bent and spun until it flows."""
    table = bar((4, 2, 2), (0.4, 0.1, 0.1), young=YOUNG)
    table["effects"] |= {"plasticity": {"yield_stress": 1e3, "hardening": 2e3, "kinematic": 1e3}}
    sim = simulation(
        table, dt=2e-3, preconditioner="block_jacobi", tolerance=1e-11, max_iterations=2000,
        integrator={"scheme": scheme, "linearizations": linearizations},
    )  # fmt: skip
    w = sim.world
    r = w.x - w.x.mean(axis=0)
    w.v[...] = np.cross([3.0, 5.0, 9.0], r) + np.stack([2 * r[:, 1], 60 * r[:, 0] ** 2, -9 * r[:, 0]], axis=1)
    energies = []
    for _ in range(150):
        sim.engine.run(1)
        sim.fetch()
        energies.append(sim.potential_energy() + sim.kinetic_energy())
    assert sim.effects["plasticity"].memory["hardened"].max() > 0.01, "it flows"
    assert (np.diff(energies) < 0).all()
    assert energies[-1] < 0.9 * energies[0]


def test_what_has_flowed_stays_when_parameters_change():
    """Before the memory has taken the last step up: it flowed under the constants of that step."""
    flowed = []
    for changed in ({}, {"plasticity.yield_stress": "1e9"}, {"corotational.young": "1e-3"}):
        law = {"young": YOUNG, "poisson": POISSON}
        sim = simulation(
            bar((1, 1, 1), young=None, effects={"corotational": law, "plasticity": {"yield_stress": 1e-3 * YOUNG}})
        )
        sim.engine.run(1)
        sim.world.x[...] = sim.world.rest * [1.01, 1, 1]  # as if the step had ended there
        sim.parameters.set({f"bar.{key}": value for key, value in changed.items()})
        sim.engine.run(1)
        flowed.append(sim.effects["plasticity"].memory["plastic"].copy())
    assert flowed[0].max() > 1e-3
    for other in flowed[1:]:
        np.testing.assert_array_equal(other, flowed[0])


def test_corotational_elements_are_needed_beside():
    flow = {"plasticity": {"yield_stress": 1e3}}
    law = {"young": YOUNG, "poisson": POISSON}
    with pytest.raises(InputError, match=r"object 'bar', effect plasticity: .* list corotational beside it"):
        simulation(bar(young=None, effects={"neo_hookean": law} | flow))
    with pytest.raises(InputError, match=r"effect plasticity: .* alone; neo_hookean cannot stand beside them"):
        simulation(bar(young=None, effects={"neo_hookean": law, "corotational": law} | flow))
    with pytest.raises(InputError, match=r"effect plasticity: .* 'qr'"):
        simulation(bar(young=None, effects={"corotational": law | {"rotation": "qr"}} | flow))


def test_the_yield_stress_may_differ_by_region():
    regions = [{"where": "X < 1", "yield_stress": 1e3}, {"yield_stress": 2e3, "hardening": 5.0}]
    effects = {
        "corotational": {"young": YOUNG, "poisson": 0.3},
        "plasticity": {"yield_stress": regions, "hardening": 1},
    }
    effect = simulation(bar(young=None, effects=effects)).effects["plasticity"]
    left = effect.world.rest[effect.elements].mean(axis=1)[:, 0] < 1
    np.testing.assert_array_equal(effect.constants, [np.where(left, 1e3, 2e3), np.where(left, 1.0, 5.0), 0 * left])
