# SPDX-License-Identifier: MIT
"""Damage against the closed forms of a bar in tension, and the energy that a crack takes."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from sim_server.errors import InputError
from sim_server.simulation import Simulation
from tests.reference import history as reference
from tests.scenes import bar, elastic, simulation
from tests.support.tearing import AREA, ENERGY, OPENING, STRENGTH, YOUNG, expected, torn

POISSON = 0.3
LAW = {"young": YOUNG, "poisson": POISSON}
FIRST = STRENGTH / YOUNG


def cube(law: dict[str, Any] | None = None, **damage: Any) -> Simulation:
    """A cube of 1 m."""
    table = {"strength": STRENGTH, "fracture_energy": ENERGY} | damage
    effects = {"corotational": law or LAW, "damage": table}
    return simulation(bar((2, 2, 2), (1, 1, 1), young=None, effects=effects), preconditioner="block_jacobi", warp=False)


def forces(sim: Simulation) -> NDArray:
    for launch in sim.launches()[0]:
        launch()
    return sim.system.b / sim.world.dt


def softening(size: float, energy: float = ENERGY) -> float:
    """kf of elements of this size [m]."""
    return energy / (size * STRENGTH) - FIRST / 2


def stress_at(sim: Simulation, strain: float, measure: str = "tension") -> float:
    """Stress of the cube [Pa] once it has this axial strain, free to contract; its memory then has it."""
    w = sim.world
    w.x[...] = w.rest * (1 + np.array([strain, -POISSON * strain, -POISSON * strain]))
    found = forces(sim)
    for launch in sim.effects["damage" if measure == "tension" else "damage_energy"].history():
        launch()
    return -float(found[w.rest[:, 0] > 0.99, 0].sum())


@pytest.mark.parametrize("measure", ["tension", "energy"])
def test_a_bar_softens_and_is_unloaded_to_the_origin(measure: str):
    sim = cube(measure=measure)
    kf = softening(float(np.cbrt(6 * np.sqrt(2) / 48)))  # of 48 equal elements
    for strain in (0.5 * FIRST, 0.99 * FIRST):
        np.testing.assert_allclose(stress_at(sim, strain, measure), YOUNG * strain, rtol=1e-9)
    reached = FIRST
    for strain in (1.5 * FIRST, 3 * FIRST, 2 * FIRST, 0.1 * FIRST, 0.0, 3 * FIRST, 4 * FIRST, -FIRST, 6 * FIRST):
        reached = max(reached, strain)
        envelope = STRENGTH * np.exp(-(reached - FIRST) / kf)
        found = stress_at(sim, strain, measure)
        np.testing.assert_allclose(found, envelope * strain / reached, rtol=1e-9, atol=1e-9)


def test_compression_damages_by_energy_alone():
    """But for what it stretches sideways, here a tenth of the compression."""
    law = LAW | {"poisson": 0.1}
    for measure, damaged in (("tension", False), ("energy", True)):
        sim = cube(law, measure=measure)
        w = sim.world
        w.x[...] = w.rest * (1 + FIRST * np.array([-3.0, 0.3, 0.3]))
        found = -forces(sim)[w.rest[:, 0] > 0.99, 0].sum()
        assert (found > -2.9 * STRENGTH) == damaged


@pytest.mark.parametrize(
    "changed", [{"damage.strength": "1.2e3"}, {"damage.fracture_energy": "1e3"}, {"corotational.young": "5e4"}], ids=str
)
def test_damage_does_not_heal_by_live_parameters(changed: dict[str, str]):
    """Of a strain of the last step or of one long ago."""
    for steps in (0, 2):
        sim = cube()
        sim.engine.run(1)
        sim.world.x[...] = sim.world.rest * [1 + 3 * FIRST, 1, 1]  # as if the step had ended there
        known = 1 - np.exp(-2 * FIRST / softening(float(np.cbrt(6 * np.sqrt(2) / 48)))) / 3
        for _ in range(steps):
            sim.engine.run(1)
            sim.world.x[...] = sim.world.rest
            sim.world.v[...] = 0
        sim.parameters.set({f"bar.{key}": value for key, value in changed.items()})
        sim.engine.run(1)
        np.testing.assert_allclose(sim.effects["damage"].damage, known, rtol=1e-12)


def test_damage_is_bounded():
    sim = cube(most=0.8)
    stress_at(sim, 100 * FIRST)
    np.testing.assert_array_equal(sim.effects["damage"].damage, 0.8)
    np.testing.assert_allclose(stress_at(sim, 0.01), 0.2 * YOUNG * 0.01, rtol=1e-9)


def random_state(measure: str) -> tuple[Simulation, Any]:
    """A cube with strains and a memory at random."""
    sim, random = cube(measure=measure), np.random.default_rng(5)
    effect = sim.effects["damage" if measure == "tension" else "damage_energy"]
    sim.world.x += random.normal(scale=0.002, size=sim.world.x.shape)
    effect.memory["largest"][...] = random.uniform(0, 0.05, size=effect.memory["largest"].shape)
    return sim, effect


@pytest.mark.parametrize("measure", ["tension", "energy"])
def test_forces_matrix_and_energy_are_those_of_elements_that_are_softer(measure: str):
    """Each by its own damage, as the plain reference has it."""
    sim, effect = random_state(measure)
    w, c = sim.world, (YOUNG * POISSON / (1.3 * 0.4), YOUNG / 2.6)
    strain = reference.turned(w.x, w.rest, effect.elements)[1] - np.eye(3)
    trace = np.trace(strain, axis1=1, axis2=2)
    elastic_energy = c[1] * (strain**2).sum(axis=(1, 2)) + c[0] / 2 * trace**2
    now = reference.tension(strain) if measure == "tension" else np.sqrt(2 * elastic_energy / YOUNG)
    largest = np.maximum(effect.memory["largest"][0], now)
    volume = reference.gradients(w.rest, effect.elements)[0]
    kf = np.array([softening(size) for size in np.cbrt(6 * np.sqrt(2) * volume)])
    d = np.where(largest > FIRST, 1 - FIRST / largest * np.exp(-(largest - FIRST) / kf), 0)
    assert d.min() < 0.3 < 0.9 < d.max()
    d = np.minimum(d, 0.99)
    stress = (1 - d)[:, None, None] * (2 * c[1] * strain + c[0] * trace[:, None, None] * np.eye(3))
    expected = reference.forces(w.x, w.rest, effect.elements, stress)
    np.testing.assert_allclose(forces(sim), expected, atol=1e-9 * np.abs(expected).max())
    np.testing.assert_allclose(effect.energy() + elastic(sim).energy(), volume @ ((1 - d) * elastic_energy), rtol=1e-9)
    K = sim.matrix().toarray() - np.diag(np.repeat(w.mass, 3))
    assert np.linalg.eigvalsh(K).min() > -1e-12 * np.abs(K).max()
    softer = cube(LAW | {"young": [{"young": YOUNG}]}, strength=1e9, fracture_energy=1e30)
    softer.world.x[...] = w.x
    order = elastic(softer)
    match = {tuple(t): k for k, t in enumerate(effect.elements.tolist())}
    order.lame[...] *= (1 - d)[[match[tuple(t)] for t in order.elements.tolist()]]
    forces(softer)
    other = softer.matrix().toarray() - np.diag(np.repeat(w.mass, 3))
    np.testing.assert_allclose(K, other, atol=1e-10 * np.abs(K).max())


@pytest.mark.parametrize("cells", [4, 8])
def test_a_crack_takes_the_fracture_energy_by_the_size_of_its_elements(cells: int):
    """All in the weak layer; its energy is that of a crack times its width over the size of its elements."""
    found = torn(cells)
    assert found.damage[found.weak].min() > 0.99
    assert found.damage[~found.weak].max() == 0
    work, crack = expected(cells)
    np.testing.assert_allclose(found.work, work, rtol=0.02)
    strain = OPENING * cells
    assert crack < work < crack + AREA / cells * 0.5 * 1e-3 * YOUNG * strain**2  # what is left bears a little


@pytest.mark.parametrize("scheme", ["backward_euler", "newmark", "bdf2", "generalized_alpha"])
@pytest.mark.parametrize("linearizations", [1, 20])
def test_energy_never_grows(scheme: str, linearizations: int):
    """A free body that was thrown, bent and spun until it tears."""
    table = bar((4, 2, 2), (0.4, 0.1, 0.1), young=YOUNG)
    table["effects"] |= {"damage": {"strength": 2e3, "fracture_energy": 8.0}}
    sim = simulation(
        table, dt=2e-3, preconditioner="block_jacobi", tolerance=1e-11, max_iterations=2000,
        integrator={"scheme": scheme, "linearizations": linearizations},
    )  # fmt: skip
    w = sim.world
    r = w.x - w.x.mean(axis=0)
    w.v[...] = np.cross([3.0, 5.0, 9.0], r) + np.stack([2 * r[:, 1], 40 * r[:, 0] ** 2, -9 * r[:, 0]], axis=1)
    energies = []
    for _ in range(150):
        sim.engine.run(1)
        sim.fetch()
        energies.append(sim.potential_energy() + sim.kinetic_energy())
    assert sim.effects["damage"].damage.max() > 0.3, "it tears"
    assert np.diff(energies).max() < 1e-4 * energies[0]  # of the scheme: a body without damage has as much
    assert energies[-1] < 0.97 * energies[0]


def test_large_elements_are_refused_and_so_is_plasticity_beside():
    with pytest.raises(
        InputError, match=r"object 'bar', effect damage: an element of .* allowed here: elements below 0\.2 m"
    ):
        cube(fracture_energy=1.0)
    flow = {"damage": {"strength": 1e3, "fracture_energy": 1e3}, "plasticity": {"yield_stress": 1e3}}
    with pytest.raises(InputError, match="damage and plasticity are not defined together"):
        simulation(bar(young=None, effects={"corotational": LAW} | flow))
    with pytest.raises(InputError, match="list corotational beside it"):
        simulation(bar(young=None, effects={"neo_hookean": LAW, "damage": flow["damage"]}))
    with pytest.raises(InputError, match=r"effect damage: .* alone; mass_spring cannot stand beside them"):
        simulation(
            bar(young=None, effects={"corotational": LAW, "mass_spring": {"young": 1e6}, "damage": flow["damage"]})
        )
