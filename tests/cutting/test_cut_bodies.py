# SPDX-License-Identifier: MIT
"""Bodies that lose elements: what is left moves as a body that never had them; the rest is gone and does no harm."""

import numpy as np
import pytest

from protocol import messages_pb2 as pb
from sim_server.errors import InputError
from sim_server.scene.model import Scene
from sim_server.simulation import Simulation
from sim_server.state.start import Start
from tests.cutting.cut_scenes import HALVED, LAWS, cut, elements, made, table
from tests.scenes import bar, mesh_file, simulation

NOTCH = "abs(X - 1) < 0.13 and Y > 0.25"
SCHEMES = {
    "backward_euler": {},
    "newmark": {"scheme": "newmark"},
    "bdf2": {"scheme": "bdf2"},
    "generalized_alpha": {"scheme": "generalized_alpha"},
    "ros2": {"scheme": "ros2"},
    "newton": {"scheme": "backward_euler", "linearizations": 4},
    "central_difference": {"scheme": "central_difference"},
}


def without(sim, where, folder):
    """The mesh of a body without the elements of a region, as a file, and the nodes that it keeps."""
    mesh = sim.world.bodies[0].mesh
    left = np.delete(mesh.tets, elements(sim, where), axis=0)
    kept, tets = np.unique(left, return_inverse=True)
    return mesh_file(folder, mesh.rest[kept], tets.reshape(-1, 4)), kept


@pytest.mark.parametrize("law", LAWS)
def test_what_is_left_moves_as_a_body_without_these_elements(law, tmp_path):
    """A notch opens: twenty steps as those of a mesh that has it from the start."""
    sim = made(law)
    mesh, kept = without(sim, NOTCH, tmp_path)
    other = made(law, mesh=mesh)
    cut(sim, NOTCH)
    sim.engine.run(20)
    other.engine.run(20)
    np.testing.assert_allclose(sim.fetch().x[kept], other.fetch().x, atol=2e-8)
    np.testing.assert_allclose(sim.fetch().mass[kept], other.world.mass, rtol=1e-12)
    if law == "corotational":  # frames of others are of all neighbours at rest
        np.testing.assert_allclose(sim.system.rotation[kept], other.system.rotation, atol=1e-6)
    assert np.abs(other.world.x - made(law).world.x[kept]).max() > 0.05, "it moves"


def test_a_cut_leaves_the_masses_that_effects_add_to_other_bodies():
    cut_bar, other = bar((2, 2, 2), name="cut"), bar((2, 2, 2), name="other")
    cut_bar["effects"]["cutting"] = True
    capsule = {"young": 1e5, "poisson": 0.3, "thickness": 0.02, "density": 5000}
    wire = {"path": [[0.1, 0.5, 0.5], [1.9, 0.5, 0.5]], "young": 1e7, "radius": 0.05, "density": 7850}
    other["effects"] |= {"membrane": capsule, "rod": wire}
    sim = simulation(cut_bar, other)
    cut_nodes, nodes = (body.nodes for body in sim.world.bodies)
    before = sim.world.mass.copy()
    assert before[nodes].sum() > 1.05 * before[cut_nodes].sum()
    np.testing.assert_array_equal(sim.world.uncut_mass, before)
    sim.parameters.set({"cut.cutting.removed": '"3"'})
    sim.engine.run(1)
    mass = sim.fetch().mass
    np.testing.assert_array_equal(mass[nodes], before[nodes])
    assert mass[cut_nodes].sum() < before[cut_nodes].sum()


@pytest.mark.parametrize("scheme", SCHEMES)
def test_every_scheme_goes_on_with_what_is_left(scheme, tmp_path):
    integrator = SCHEMES[scheme]
    solver = {"preconditioner": "none" if scheme == "central_difference" else "block_jacobi", "tolerance": 1e-10,
              "max_iterations": 3000}  # fmt: skip
    sim = made(integrator=integrator, solver=solver)
    mesh, kept = without(sim, NOTCH, tmp_path)
    other = made(integrator=integrator, mesh=mesh, solver=solver)
    cut(sim, NOTCH)
    for each in (sim, other):
        each.engine.run(15)
    np.testing.assert_allclose(sim.fetch().x[kept], other.fetch().x, atol=1e-6)


@pytest.mark.parametrize("law", LAWS)
def test_a_body_cut_through_comes_apart_without_harm(law):
    """The piece falls freely and turns over; elements that were removed may be inside out, and nobody asks."""
    sim = made(law)
    sim.engine.run(5)
    removed = cut(sim, HALVED)
    sim.engine.run(60)
    status = sim.engine.records()["status"]
    assert (status == pb.CONVERGED).all() and not sim.refusals()
    world = sim.fetch()
    mesh = sim.world.bodies[0].mesh
    far = mesh.rest[:, 0] > 1.3
    fallen = world.x[far, 1].mean() - mesh.rest[far, 1].mean()
    assert fallen < -3, "it falls, 1.2 s long, with drag"
    assert np.abs(world.x[mesh.rest[:, 0] < 0.6] - mesh.rest[mesh.rest[:, 0] < 0.6]).max() < 0.3, "the stump hangs"
    assert len(removed) and np.isfinite(world.x).all()


def test_masses_and_momentum_are_those_of_what_is_left():
    """A bar that flies and spins is cut in two: the momentum of the rest is what it had, and stays."""
    sim = made(fixed=False)
    world = sim.world
    world.v[:] = np.cross([0.0, 1.0, 3.0], world.x - world.x.mean(axis=0)) + np.array([1.0, 2.0, 0.0])
    sim.engine.run(3)
    removed = cut(sim, HALVED)
    v = sim.fetch().v.copy()
    sim.engine.run(1)
    mesh = sim.world.bodies[0].mesh
    left = np.delete(np.arange(len(mesh.tets)), removed)
    volume = np.abs(np.linalg.det(mesh.rest[mesh.tets[:, 1:]] - mesh.rest[mesh.tets[:, :1]])) / 6
    assert world.mass.sum() == pytest.approx(1000 * volume[left].sum(), rel=1e-5)
    g, alpha, dt = np.array([0, -9.81, 0]), 0.1, 0.02
    gone = sim.cutting.left == 0
    before = (world.mass[~gone, None] * v[~gone]).sum(axis=0)
    after = (world.mass[~gone, None] * sim.fetch().v[~gone]).sum(axis=0)
    exact = (before + dt * world.mass[~gone].sum() * g) / (1 + alpha * dt)
    np.testing.assert_allclose(after, exact, rtol=1e-8, atol=1e-8)


def test_a_node_without_elements_rests():
    sim = made(fixed=False)
    sim.engine.run(5)
    cut(sim, "X > 1.74")
    gone = np.flatnonzero(sim.world.rest[:, 0] > 1.99)
    before = sim.fetch().x[gone].copy()
    sim.engine.run(10)
    assert np.array_equal(sim.fetch().x[gone], before) and np.abs(sim.world.v[gone]).max() < 1e-15
    assert (sim.cutting.at_rest[gone] == 1).all() and sim.cutting.at_rest.sum() == len(gone)


def test_an_object_without_elements_stands_still_and_a_reset_makes_it_whole():
    sim = made()
    start = Start(sim)
    sim.engine.run(12)
    first = sim.fetch().x.copy()
    cut(sim, "true")
    sim.engine.run(10)
    assert (sim.engine.records()["status"] == pb.CONVERGED).all()
    assert np.abs(sim.fetch().v).max() < 1e-15
    start.reset()
    assert sim.parameters.changed == {}
    sim.engine.run(12)
    assert np.array_equal(sim.fetch().x, first), "to the bit, as it was before it was cut"


def test_elements_that_come_back_hold_again():
    heavy = {"rayleigh": {"mass": 8.0}}
    sim = made(own=heavy)
    cut(sim, HALVED)
    sim.engine.run(3)
    sim.parameters.set({"bar.cutting.removed": '""'})
    sim.engine.run(200)
    other = made(own=heavy)
    other.engine.run(200)
    np.testing.assert_allclose(sim.fetch().x, other.fetch().x, atol=1e-3)
    assert sim.cutting.at_rest.sum() == 0
    assert sim.world.mass.sum() == other.world.mass.sum()


def test_a_scene_may_begin_without_elements():
    numbers = " ".join(map(str, elements(made(), NOTCH)))
    given, later = made(own={"cutting": {"removed": numbers}}), made()
    cut(later, NOTCH)
    for sim in (given, later):
        sim.engine.run(5)
    assert np.array_equal(given.fetch().x, later.fetch().x)
    assert given.parameters.changed == {}


FLOOR = {"obstacle": [{"name": "floor", "shape": "plane", "friction": 0.5, "pose": {"translate": [0, -0.01, 0]}}]}


def test_what_a_cut_opens_touches_obstacles_and_what_is_gone_does_not():
    """The lower half of a block is removed where it lies: the upper one falls onto the floor with nodes from inside."""
    effects = {"effects": {"gravity": {"g": [0, -9.81, 0]}, "contact": True}}
    block = {"bar": [3, 4, 3], "size": [0.3, 0.4, 0.3], "split": "mirrored"}
    sim = made(fixed=False, mesh=block, **(FLOOR | effects))
    sim.engine.run(60)
    rest = sim.world.rest
    lower = rest[:, 1] < 0.19
    cut(sim, "Y < 0.2")
    x = sim.fetch().x[lower].copy()
    sim.engine.run(100)
    world = sim.fetch()
    opened = np.abs(rest[:, 1] - 0.2) < 1e-9
    assert np.array_equal(world.x[lower], x), "what is gone is no obstacle and meets none"
    assert np.abs(world.x[opened, 1] + 0.01).max() < 0.012, "the new underside lies on the floor"
    assert np.abs(world.v).max() < 1e-3
    assert (sim.engine.records()["clipped"] == 0).all()


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"integrator": {"scheme": "quasi_static"}}, "quasi_static"),
        ({"own": {"cutting": {"removed": "3 99999"}}}, "removed: there is no element 99999: numbers are from 0 to 191"),
        ({"own": {"traction": {"where": "X > 1.9", "pressure": 1.0}}}, "with the effect traction"),
    ],
)
def test_what_cannot_be_cut_is_refused(keys, says):
    with pytest.raises(InputError, match=says):
        made(**keys)


def test_laws_that_are_not_defined_inside_out_are_refused():
    ogden = {"ogden": {"mu": [3e4], "alpha": [2.0], "bulk": 1e5}}
    with pytest.raises(InputError, match="with the effect ogden"):
        made(own=ogden | {"corotational": LAWS["corotational"]})
    with pytest.raises(ValueError, match="removes linear elements alone"):
        made(bar={"elements": "smoothed"})


@pytest.mark.parametrize("text", ["3-1", "x", "1,2", "1 -2", "-1"])
def test_a_text_that_names_no_elements_is_refused(text):
    with pytest.raises(ValueError, match="element numbers"):
        made(own={"cutting": {"removed": text}})


def test_bodies_that_touch_each_other_cannot_be_cut():
    block = {"bar": [1, 1, 1], "size": [0.3, 0.3, 0.3]}
    one = {"name": "one", "mesh": block, "density": 1000.0,
           "effects": {"corotational": LAWS["corotational"], "cutting": True}}  # fmt: skip
    two = one | {"name": "two", "pose": {"translate": [0, 1, 0]}}
    effects = {"gravity": True, "contact": True}
    with pytest.raises(InputError, match="touch obstacles alone"):
        made(object=[one, two], effects=effects)
    made(object=[one, two], effects=effects | {"contact": {"between": False}}, **FLOOR)


def test_a_body_that_cannot_be_cut_turns_beside_one_that_can_as_it_does_alone():
    """Here the one that can is of another law, so that no element of corotational may be removed."""
    solid = bar(name="solid", cells=(2, 1, 1), pose={"translate": [0, 5, 0]}, damping=(0.1, 0))
    found = table("neo_hookean")
    beside, alone = (
        Simulation(Scene.model_validate(found | {"object": objects}, context={"folder": "."}))
        for objects in ([*found["object"], solid], [solid])
    )
    for sim in (beside, alone):
        nodes = sim.world.body("solid").nodes
        sim.world.v[nodes] = np.cross([0, 0, 5.0], sim.world.x[nodes])
        sim.engine.run(10)
    rotation = beside.system.rotation[beside.world.body("solid").nodes]
    np.testing.assert_allclose(rotation, alone.system.rotation, atol=1e-12)


def test_a_body_that_may_be_cut_falls_on_a_floor_beside_one_that_may_not():
    """The one touches with its nodes alone, the other with its triangles, too."""
    found = table(fixed=False, effects={"gravity": {"g": [0, -9.81, 0]}, "contact": {"between": False}})
    solid = bar(name="solid", cells=(2, 1, 1), pose={"translate": [0, 0, 1]})
    found |= {"object": [*found["object"], solid], "obstacle": [{"name": "floor", "shape": "plane"}], "solver": {}}
    sim = Simulation(Scene.model_validate(found, context={"folder": "."}))
    sim.engine.run(20)
    assert (sim.engine.records()["contacts"][-2:] > 0).all()
    assert sim.world.x[:, 1].min() > -1e-3
