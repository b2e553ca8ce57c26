# SPDX-License-Identifier: MIT
"""Simulations in a program of one's own: known motions, views of memory, meshes of arrays, and what is refused."""

import logging

import numpy as np
import pytest

import warpfactor as wf
from sim_server.errors import InputError
from sim_server.mesh import bar

DT = 0.01
GRID = bar((1, 1, 2), (0.1, 0.1, 0.2))


def falling(mesh: object, **effects: object) -> dict:
    """A scene of one soft body that nothing holds, under gravity."""
    soft = {"corotational": {"young": 1e4, "poisson": 0.3}, "touch": True, **effects}
    body = {"name": "cube", "mesh": mesh, "effects": soft}
    return {"dt": DT, "effects": {"gravity": {"g": [0.0, -9.81, 0.0]}}, "object": [body]}


@pytest.fixture(scope="module")
def simulation():
    with wf.Simulation(falling(wf.Mesh(GRID.rest, GRID.tets))) as made:
        yield made


def test_a_body_of_arrays_falls_as_bodies_do(simulation):
    """Backward Euler: v = -n dt g, and y = y0 - dt^2 g n (n + 1) / 2."""
    simulation.reset()
    begun = simulation.time
    records = simulation.step(10)
    assert len(records) == 10 and simulation.time - begun == pytest.approx(0.1)
    assert simulation.objects == ["cube"]
    np.testing.assert_allclose(simulation.velocities("cube"), np.tile([0, -0.981, 0], (12, 1)), atol=1e-6)
    np.testing.assert_allclose(simulation.positions("cube")[:, 1], GRID.rest[:, 1] - DT**2 * 9.81 * 55, atol=1e-6)


def test_views_are_the_memory_that_steps_write(simulation):
    simulation.reset()
    x, mine = simulation.x, simulation.positions("cube")
    before = x.copy()
    simulation.step()
    assert np.shares_memory(x, mine) and (x != before).any()
    np.testing.assert_array_equal(mine, simulation.x)


def test_views_are_shared_by_dlpack(simulation):
    """So that PyTorch and others see what steps write, and write what steps read."""
    theirs = np.from_dlpack(simulation.x)
    assert np.shares_memory(theirs, simulation.x) and theirs.shape == (12, 3)
    simulation.step()
    np.testing.assert_array_equal(theirs, simulation.x)


def test_an_object_goes_back_alone():
    """With its pushes; others go on as they are."""
    scene = falling(wf.Mesh(GRID.rest, GRID.tets))
    scene["object"].append({**scene["object"][0], "name": "other", "pose": {"translate": [1, 0, 0]}})
    with wf.Simulation(scene) as two:
        start = two.x.copy()
        for name in two.objects:
            two.push(name, "top", (0, 0, 5), duration=10)
        two.step(5)
        moved = two.positions("other").copy()
        two.reset("cube")
        np.testing.assert_array_equal(two.positions("cube"), start[:12])
        np.testing.assert_array_equal(two.positions("other"), moved)
        assert (two.velocities("cube") == 0).all() and (two.displacements("cube") == 0).all()
        two.step(5)
        assert abs(two.velocities("cube")[:, 2]).max() < 1e-6 < two.velocities("other")[:, 2].mean()
        two.reset()
        np.testing.assert_array_equal(two.x, start)


def test_displacements_and_tip():
    with wf.Simulation(falling(wf.Mesh(GRID.rest, GRID.tets), fixed={"where": "Z < 0.01"})) as bent:
        bent.step(5)
        moved = bent.displacements("cube")
        np.testing.assert_array_equal(moved, bent.x - GRID.rest)
        assert GRID.rest[bent.tip("cube"), 2] == 0.2 and moved[bent.tip("cube"), 1] < -1e-4


def test_a_reset_repeats_the_run(simulation):
    """To what solves leave: factors are kept, and are others the second time."""
    runs = []
    for _ in range(2):
        simulation.reset()
        simulation.step(3)
        runs.append(simulation.x.copy())
    np.testing.assert_allclose(runs[0], runs[1], atol=1e-7)


def test_a_push_adds_its_impulse(simulation):
    """Force times duration, beside that of gravity."""
    simulation.reset()
    simulation.push("cube", (0.05, 0.05, 0.2), (0.0, 0.0, 3.0), duration=4 * DT)
    simulation.step(6)
    mass = 1000 * 0.1 * 0.1 * 0.2
    momentum = _lumped() @ simulation.v
    np.testing.assert_allclose(momentum, [0, -9.81 * mass * 6 * DT, 3.0 * 4 * DT], atol=1e-5)


def _lumped() -> np.ndarray:
    """Nodal masses: a quarter of each adjacent tetrahedron [kg]."""
    masses = np.zeros(len(GRID.rest))
    np.add.at(masses, GRID.tets, np.repeat(1000 * GRID.volumes[:, None] / 4, 4, axis=1))
    return masses


def test_a_mesh_of_arrays_is_the_same_as_one_of_a_scene_file():
    source = {"bar": [1, 1, 2], "size": [0.1, 0.1, 0.2]}
    stepped = []
    for mesh in (source, wf.Mesh(GRID.rest.tolist(), GRID.tets)):
        with wf.Simulation(falling(mesh, fixed={"where": "Z < 0.01"})) as made:
            made.step(5)
            stepped.append(made.x)
    np.testing.assert_allclose(*stepped, atol=1e-7)  # as exact as the solves, whose kind is chosen by times


def test_a_parameter_is_set_between_steps(simulation):
    simulation.reset()
    simulation.set("gravity.g", [0.0, 0.0, 0.0])
    simulation.step(2)
    np.testing.assert_allclose(simulation.v, 0, atol=1e-9)
    simulation.set("gravity.g", "[0, -9.81, 0]")
    simulation.step()
    np.testing.assert_allclose(simulation.v[:, 1], -9.81 * DT, atol=1e-6)


def test_values_of_numpy_are_set_and_several_at_once_or_none():
    with wf.Simulation(falling(wf.Mesh(GRID.rest, GRID.tets))) as simulation:

        def values() -> tuple[str, ...]:
            found = {each.field.key: each.text for each in simulation.inside.parameters}
            return found["effects.gravity.g"], found["object.cube.effects.corotational.young"]

        simulation.set("gravity.g", np.array([0, -1, 0]))
        simulation.set("cube.corotational.young", np.float32(2e4))
        assert values() == ("[0.0, -1.0, 0.0]", "20000.0")
        simulation.set({"gravity.g": (0, np.int64(-9), 0), "cube.corotational.young": np.int32(30_000)})
        assert values() == ("[0.0, -9.0, 0.0]", "30000.0")
        with pytest.raises(InputError, match="young"):
            simulation.set({"gravity.g": [0, 0, 0], "cube.corotational.young": np.nan})
        assert values() == ("[0.0, -9.0, 0.0]", "30000.0")


def test_what_cuts_in_a_server_alone_is_told(caplog):
    mesh = {"bar": [1, 1, 2], "size": [0.1, 0.1, 0.2]}
    with caplog.at_level(logging.WARNING), wf.Simulation(falling(mesh, cutting={"tear": 50})) as simulation:
        (line,) = [r.getMessage() for r in caplog.records]
        assert line.startswith("object 'cube' has cutting.tear: that cuts in a server alone")
        masses = simulation.inside.world.mass.sum()
        simulation.set("cube.cutting.removed", "0-2")
        simulation.step()
        assert simulation.inside.world.mass.sum() < masses
    caplog.clear()
    wf.Simulation(falling(mesh, cutting=True)).close()
    assert not caplog.records


def test_a_scene_of_the_package_is_read_with_other_values():
    scene = wf.Scene.load("gallery/beam", ["dt=0.005"])
    assert scene.table()["dt"] == 0.005 and scene.table()["object"][0]["name"] == "beam"


BAD = {
    "points": (lambda s: wf.Mesh(np.zeros((4, 2)), [[0, 1, 2, 3]]), r"have shape \(4, 2\): must be \(n, 3\)"),
    "tets": (lambda s: wf.Mesh(GRID.rest, [[0.0, 1, 2, 3]]), r"tets of shape \(1, 4\) and type float64: must be"),
    "a flat one": (lambda s: wf.Mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]], [[0, 1, 2, 3]]), "mesh arrays: "),
    "a key": (lambda s: wf.Scene({"dt": 0.1, "objekt": []}), "from Python, objekt"),
    "no steps": (lambda s: s.step(0), r"step\(0\): must be at least 1"),
    "an object": (lambda s: s.positions("ball"), "no object 'ball'; there is cube"),
    "a push": (lambda s: s.push("cube", "nose", (0, 0, 1), 1), "push: no point 'nose'; known: tip, "),
    "a parameter": (lambda s: s.set("cube.corotational.young", -1), "young"),
}


@pytest.mark.parametrize(("call", "message"), BAD.values(), ids=BAD.keys())
def test_bad_input_is_named(simulation, call, message):
    with pytest.raises(InputError, match=message):
        call(simulation)


def test_a_closed_simulation_says_so_and_leaves_what_was_taken():
    made = wf.Simulation(falling(wf.Mesh(GRID.rest, GRID.tets)))
    x = made.x
    made.close()
    made.close()
    assert np.isfinite(x).all()
    for use in (made.step, made.reset, lambda: made.x):
        with pytest.raises(InputError, match="this simulation is closed"):
            use()
