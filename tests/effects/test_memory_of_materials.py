# SPDX-License-Identifier: MIT
"""What a material remembers is that of the positions at which its steps ended, whatever the steps did in between."""

from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from pydantic import ValidationError

from sim_server.effects._history import TetrahedraWithHistory
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.state.start import Start
from tests.reference import history as reference
from tests.scenes import bar, rotation, simulation

TERMS = [{"g": 0.8, "tau": 0.03}, {"g": 0.3, "tau": 0.5}]
FLOW = {"yield_stress": 60.0, "hardening": 500.0, "kinematic": 300.0}
TEARS = {"strength": 60.0, "fracture_energy": 3.0}
EFFECTS: dict[str, dict[str, Any]] = {"prony": {"terms": TERMS}, "plasticity": FLOW, "damage": TEARS}
FLOOR: dict[str, Any] = {"name": "floor", "shape": "plane"}
DT = 0.01


def cube(effect: str, name: str = "cube", young: float | None = 1e5, **table: Any) -> dict[str, Any]:
    found = bar((2, 2, 2), (0.2, 0.2, 0.2), name=name, young=young, **table)
    return found | {"effects": found["effects"] | {effect: EFFECTS[effect]}}


def made(effect: str, *objects: dict[str, Any], contact: bool = False, **table: Any) -> Simulation:
    effects: dict[str, Any] = {"gravity": {"g": table.pop("gravity", [0.5, -9.81, 0])}}
    effects |= {"contact": True} if contact else {}
    solver = {"preconditioner": "block_jacobi", "tolerance": 1e-9, "max_iterations": 2000} | table.pop("solver", {})
    given = {"name": "test", "dt": DT, "object": list(objects), "effects": effects, "solver": solver, **table}
    return Simulation(Scene.model_validate(given | ({"obstacle": [FLOOR]} if contact else {})))


def memory_of(sim: Simulation) -> TetrahedraWithHistory:
    return next(e for e in sim.effects.values() if isinstance(e, TetrahedraWithHistory))


def remembered(effect: TetrahedraWithHistory, path: list[NDArray]) -> dict[str, NDArray]:
    """The memory after a path, by the plain reference."""
    rest, tets = effect.world.rest, effect.elements
    if effect.name == "damage":
        return {"largest": reference.largest_tension(path, rest, tets)[None]}
    if effect.name == "plasticity":
        constants = FLOW["yield_stress"], FLOW["hardening"], FLOW["kinematic"]
        plastic, hardened = reference.plasticity(path, rest, tets, effect.shear[0], constants)
        return {"plastic": reference.rows(plastic), "hardened": hardened[None]}
    pairs = [(term["g"], term["tau"]) for term in TERMS]
    q = reference.prony(path, rest, tets, pairs, DT)
    last = reference.deviator(reference.turned(path[-1], rest, tets)[1] - np.eye(3))
    return {"overstrain": np.concatenate([reference.rows(each) for each in q]), "reached": reference.rows(last)}


def check_path(sim: Simulation, steps: int) -> None:
    """Compares the memory with that of the positions at which the steps ended."""
    path = [sim.fetch().x.copy()]
    for _ in range(steps):
        sim.engine.run(1)
        path.append(sim.fetch().x.copy())
    sim.engine.run(1)  # begins where the last one ended
    effect = memory_of(sim)
    expected = remembered(effect, path)
    for name, array in effect.memory.items():
        largest = np.abs(expected[name]).max()
        assert largest > 1e-4, "nothing happened"
        np.testing.assert_allclose(array, expected[name], rtol=0, atol=1e-9 * largest + 1e-13, err_msg=name)


HELD = {"fixed": "X < 0.01"}
TILTED = {"pose": {"rotate": [10, 0, 20], "translate": [0, 0.03, 0]}}
ALONE: dict[str, dict[str, Any]] = {
    "one linearization": {},
    "line search": {"integrator": {"scheme": "backward_euler", "linearizations": 6}},
    "newmark": {"integrator": {"scheme": "newmark"}},
    "newmark, Newton": {"integrator": {"scheme": "newmark", "linearizations": 4}},
    "bdf2": {"integrator": {"scheme": "bdf2"}},
    "generalized_alpha": {"integrator": {"scheme": "generalized_alpha", "linearizations": 3}},
    "quasi_static": {"integrator": {"scheme": "quasi_static", "linearizations": 6}, "gravity": [0.1, -0.3, 0]},
    "factors": {"solver": {"preconditioner": "cholesky", "update": "every-3"}},
}
IN_CONTACT: dict[str, dict[str, Any]] = {
    "passes": {},
    "passes of Newton": {"integrator": {"scheme": "backward_euler", "linearizations": 4}},
    "newmark and steps of backward Euler": {"integrator": {"scheme": "newmark"}},
    "bdf2 and steps of backward Euler": {"integrator": {"scheme": "bdf2", "linearizations": 3}},
}


@pytest.mark.parametrize("case", ALONE)
@pytest.mark.parametrize("effect", EFFECTS)
def test_memory_follows_the_ends_of_steps(effect: str, case: str) -> None:
    check_path(made(effect, cube(effect, young=1e4, **HELD), **ALONE[case]), 25)


@pytest.mark.parametrize("case", IN_CONTACT)
@pytest.mark.parametrize("effect", EFFECTS)
def test_memory_follows_the_ends_of_steps_of_bodies_that_touch(effect: str, case: str) -> None:
    """They fall on a floor and on each other: paths that enter go back, and islands are solved in passes."""
    upper = cube(effect, "upper", young=2e4, pose={"translate": [0.02, 0.26, 0.01]})
    check_path(made(effect, cube(effect, young=2e4, **TILTED), upper, contact=True, **IN_CONTACT[case]), 40)


def test_memory_of_a_body_that_a_refused_solve_sends_back() -> None:
    """Its law ends at J = 0: the body goes back to where the step before began, and its memory follows."""
    table = cube("prony", young=None)
    table["effects"] |= {"neo_hookean": {"young": 1e4, "poisson": 0.3}}
    sim = made("prony", table)
    sim.world.v[...] = np.random.default_rng(0).normal(scale=8, size=sim.world.x.shape)
    check_path(sim, 12)
    assert (sim.engine.records()["status"] == 5).any(), "a solve was refused"


@pytest.mark.parametrize("effect", EFFECTS)
def test_a_step_that_is_assembled_twice_advances_once(effect: str) -> None:
    one, other = (made(effect, cube(effect, young=1e4, **HELD)) for _ in "ab")
    for sim in (one, other):
        sim.engine.run(6)
    one.engine.assemble()
    for sim in (one, other):
        sim.engine.assemble()
        sim.engine.solve()
    np.testing.assert_array_equal(one.fetch().x, other.fetch().x)


@pytest.mark.parametrize("effect", EFFECTS)
def test_a_frozen_body_remembers_its_last_step(effect: str) -> None:
    """Thrown apart, it goes back to where the step began; its memory stays what it was there."""
    table = cube(effect, young=1e4, **HELD)
    table["effects"]["traction"] = {"where": "X > 0.19", "force": [1, 0, 0]}
    sim = made(effect, table)
    found, path = memory_of(sim), [sim.fetch().x.copy()]
    for _ in range(6):
        sim.engine.run(1)
        path.append(sim.fetch().x.copy())
    sim.parameters.set({"cube.traction.force": "[1e8, 0, 0]"})
    sim.engine.run(8)
    assert not sim.world.free.any(), "it has run away"
    np.testing.assert_array_equal(sim.fetch().x, path[-1])
    for name, expected in remembered(found, path).items():
        np.testing.assert_allclose(found.memory[name], expected, atol=1e-9 * np.abs(expected).max())


@pytest.mark.parametrize("effect", EFFECTS)
def test_one_object_that_is_reset_forgets_and_the_other_does_not(effect: str) -> None:
    sim = made(effect, cube(effect, "a", 1e4, **HELD), cube(effect, "b", 1e4, pose={"translate": [0, 2, 0]}, **HELD))
    start = Start(sim)
    sim.engine.run(9)
    found = memory_of(sim)
    before = {name: array.copy() for name, array in found.memory.items()}
    start.reset("a")
    first = found.owner == sim.world.body("a").index
    for name, array in found.memory.items():
        assert before[name][:, first].any()
        assert not array[:, first].any()
        np.testing.assert_array_equal(array[:, ~first], before[name][:, ~first])


@pytest.mark.parametrize("effect", EFFECTS)
@pytest.mark.parametrize("scheme", ["ros2", "central_difference"])
def test_schemes_with_forces_in_between_are_refused(effect: str, scheme: str) -> None:
    with pytest.raises(ValidationError, match=f"{scheme}.*allowed: backward_euler, newmark, bdf2"):
        made(effect, cube(effect), integrator={"scheme": scheme}, solver={"preconditioner": "auto"})


@pytest.mark.parametrize("effect", EFFECTS)
def test_other_elements_are_refused_and_auto_is_linear(effect: str) -> None:
    assert made(effect, cube(effect, elements="auto")).world.bodies[0].elements == "linear"
    for elements in ("patch", "smoothed", "quadratic"):
        with pytest.raises(ValidationError, match=f"with the effect {effect}, which has linear elements alone"):
            made(effect, cube(effect, elements=elements))


@pytest.mark.parametrize("effect", EFFECTS)
def test_a_state_turned_as_a_whole_has_turned_forces(effect: str) -> None:
    """Memory is of the frame that turns with the element: a turned body with the same memory has turned forces, which
    sum to nothing and have no torque."""
    sim = simulation(cube(effect, young=1e4), preconditioner="block_jacobi")
    world, found = sim.world, memory_of(sim)
    random = np.random.default_rng(1)
    for array in found.memory.values():
        array[...] = np.abs(random.normal(scale=0.02, size=array.shape))
    kept = {name: array.copy() for name, array in found.memory.items()}
    shape = world.rest + random.normal(scale=0.01, size=world.x.shape)
    found_forces = []
    for R in (np.eye(3), rotation([1, 2, 3], 2.5)):
        world.x[...] = shape @ R.T
        for name, array in found.memory.items():
            array[...] = kept[name]
        for launch in sim.launches()[0]:
            launch()
        found_forces.append(sim.system.b / world.dt @ R)
        force, scale = found_forces[-1], np.abs(found_forces[-1]).max()
        np.testing.assert_allclose(force.sum(axis=0), 0, atol=1e-12 * scale)
        torque = np.cross(world.x - world.x.mean(axis=0), force @ R.T)
        np.testing.assert_allclose(torque.sum(axis=0), 0, atol=1e-12 * scale)
    np.testing.assert_allclose(found_forces[1], found_forces[0], atol=1e-10 * scale)


STARTS: dict[str, Any] = {
    "stretched": lambda rest, random: rest * [3, 1, 1],
    "pressed flat": lambda rest, random: rest * [0.1, 1, 1],
    "all in a point": lambda rest, random: 0 * rest,
    "inside out": lambda rest, random: rest * [-1, 1, 1],
    "at random": lambda rest, random: random.uniform(0, 0.2, rest.shape),
}


@pytest.mark.parametrize("start", STARTS)
@pytest.mark.parametrize("scheme", ["backward_euler", "newmark"])
@pytest.mark.parametrize("linearizations", [1, 12])
@pytest.mark.parametrize("effect", EFFECTS)
def test_nothing_flies_apart_from_anywhere(effect: str, linearizations: int, scheme: str, start: str) -> None:
    """The matrix is positive definite, forces are numbers, and no energy comes in."""
    sim = made(
        effect, cube(effect, young=1e4), integrator={"scheme": scheme, "linearizations": linearizations},
        gravity=[0, 0, 0],
    )  # fmt: skip
    sim.world.x[...] = STARTS[start](sim.world.rest, np.random.default_rng(2))
    sim.engine.run(60)
    records = sim.engine.records()
    assert set(records["status"].tolist()) <= {0, 1, 6}, "solved, or the limit of iterations or linearizations"
    assert np.isfinite(sim.fetch().x).all()
