# SPDX-License-Identifier: MIT
"""Bodies that are split along faces: they move as a mesh that was split beforehand, and lose nothing."""

import numpy as np
import pytest

from protocol import messages_pb2 as pb
from sim_server.checkpoint.content import capture, restore, restore_driver, saved_factors
from sim_server.checkpoint.file import from_bytes
from sim_server.errors import InputError
from sim_server.mechanics import shape_matching
from sim_server.mechanics.cut_shapes import opened_by_blade
from sim_server.mechanics.named_points import NamedPoints
from sim_server.mechanics.splitting import Splitter, opening
from sim_server.mesh import Mesh, bar
from sim_server.mesh.surface import surface_triangles
from sim_server.parameters import BadParameter
from sim_server.scene.model import Scene
from sim_server.scene.where import mask
from sim_server.service.cuts import BadCut, carry_out
from sim_server.simulation import Simulation
from sim_server.state.start import Start
from sim_server.updates.driver import Driver
from tests.cutting.cut_scenes import BAR, made, table
from tests.cutting.split_scenes import (
    FINE,
    HALVES,
    SCHEMES,
    SLIT,
    SPARE,
    SPLIT_LAWS,
    faces_around,
    of_scheme,
    split,
    splitter_of,
)  # fmt: skip


def split_beforehand(sim, law="corotational", **keys):
    """A simulation of the mesh that a body was split into, and the nodes that it has of that body's."""
    found = sim.world.splitting.of(sim.parameters.scene, 0)
    kept = np.flatnonzero(found.origin >= 0)
    number = np.full(len(found.origin), -1, np.int32)
    number[kept] = np.arange(len(kept))
    scene = Scene.model_validate(table(law, **keys), context={"folder": "."})
    scene.objects[0].use_mesh(Mesh(sim.world.bodies[0].mesh.rest[found.root[kept]], number[found.tets]))
    return Simulation(scene), kept


@pytest.mark.parametrize(
    ("law", "scheme"),
    [*((law, "backward_euler") for law in SPLIT_LAWS), *(("corotational", scheme) for scheme in SCHEMES),
     ("neo_hookean", "newmark"), ("stable_neo_hookean", "central_difference")],
)  # fmt: skip
def test_a_split_body_moves_as_a_mesh_that_was_split_beforehand(law, scheme):
    """A slit opens, with a corner in it where nodes get two copies; frames of nodes are the same, too."""
    keys = {} if scheme == "backward_euler" else of_scheme(scheme)
    sim = made(law, own=SPARE, **keys)
    split(sim, SLIT)
    other, kept = split_beforehand(sim, law, **keys)
    for each in (sim, other):
        each.engine.run(20)
    np.testing.assert_allclose(sim.fetch().x[kept], other.fetch().x, atol=1e-9)
    np.testing.assert_allclose(sim.system.rotation[kept], other.system.rotation, atol=1e-9)
    np.testing.assert_allclose(sim.world.mass[kept], other.world.mass, rtol=1e-12)
    whole = made(law, **keys)
    whole.engine.run(20)
    softer = 1e-3 if scheme != "central_difference" else 1e-6  # which has had less time
    assert np.abs(whole.fetch().x - sim.world.x[: whole.world.nodes]).max() > softer, "it is softer"


@pytest.mark.parametrize("scheme", SCHEMES)
def test_copies_go_on_with_the_history_of_the_node_that_they_come_from(scheme):
    """A body that flies, spins and is strained is split where nothing holds the parts together in any case: at the
    face of two elements of their own, whose nodes share all that a step carries on."""
    sim = made(own=SPARE, **of_scheme(scheme))
    sim.engine.run(7)
    carried = [*sim.integrator.carried, sim.world.x, sim.world.v, sim.world.predictor, sim.world.damping_velocity]
    before = [array.copy() for array in carried]
    found = split(sim, SLIT)
    sim.engine.take_changes()
    there = found.origin >= 0
    for array, old in zip(carried, before, strict=True):
        np.testing.assert_array_equal(array[there], old[found.root[there]])
    history = sim.integrator.mode if scheme == "central_difference" else sim.integrator.inertial_increment
    copies = np.flatnonzero(there & (found.root != np.arange(len(there))))
    assert np.abs(history[copies]).max() > 0 and len(copies) > 8


@pytest.mark.parametrize(
    "solver",
    [{"preconditioner": "none"}, {"preconditioner": "jacobi"}, {"preconditioner": "ssor"}, {"precision": "float64"}],
    ids=lambda solver: next(iter(solver.values())),
)
def test_every_solver_goes_on_after_a_split_in_motion(solver):
    """Newton-Raphson, too; the mesh that was split beforehand begins where the other is when it is split."""
    solver = {"tolerance": 1e-11, "max_iterations": 5000} | solver
    keys = {"solver": solver, "integrator": {"scheme": "backward_euler", "linearizations": 3}}
    sim = made(own=SPARE, **keys)
    sim.engine.run(6)
    x, v = sim.fetch().x.copy(), sim.world.v.copy()
    found = split(sim, SLIT)
    other, kept = split_beforehand(sim, **keys)
    other.world.x[:], other.world.v[:] = x[found.root[kept]], v[found.root[kept]]
    for each in (sim, other):
        each.engine.run(8)
    np.testing.assert_allclose(sim.fetch().x[kept], other.fetch().x, atol=1e-8)


@pytest.mark.parametrize("scheme", ["backward_euler", *SCHEMES])
def test_mass_and_momenta_are_kept_to_rounding(scheme):
    """A bar that flies and spins is split in two, then each part again; a piece parts with what it had."""
    solver = {"tolerance": 1e-12} if scheme != "central_difference" else {"preconditioner": "none"}
    keys = {"integrator": {"scheme": scheme}, "solver": solver}
    sim = made(fixed=False, own=SPARE | {"rayleigh": {}}, effects={}, **keys)
    world = sim.world
    world.v[:] = np.cross([0.0, 1.0, 3.0], world.x - world.x.mean(axis=0)) + np.array([1.0, 2.0, 0.0])
    sim.engine.run(3)

    def sums():
        there = sim.cutting.at_rest == 0
        m, x, v = world.mass[there, None], sim.fetch().x[there], world.v[there]
        return np.concatenate([m.sum(axis=0), (m * v).sum(axis=0), (m * np.cross(x, v)).sum(axis=0)])

    before = sums()
    for where in (HALVES, "Y > 0.25"):
        split(sim, where)
        sim.engine.take_changes()
        np.testing.assert_allclose(sums(), before, rtol=1e-13, atol=1e-11)
        at = sums()
        sim.engine.run(5)
        np.testing.assert_allclose(sums()[:4], at[:4], rtol=1e-9, atol=1e-8)
        before = sums()
    assert (sim.engine.records()["status"] == pb.CONVERGED).all()


def test_a_body_split_through_comes_apart_and_the_part_falls_freely():
    sim = made(own=SPARE | {"rayleigh": {}}, solver={"tolerance": 1e-12, "max_iterations": 3000})
    found = split(sim, HALVES)
    far = np.unique(found.tets[mask(HALVES, sim.world.bodies[0].centroids)])
    near = np.unique(found.tets[~mask(HALVES, sim.world.bodies[0].centroids)])
    assert len(np.intersect1d(far, near)) == 0
    start = sim.world.bodies[0].mesh.rest[found.root]
    sim.engine.run(50)
    m, x = sim.world.mass[far], sim.fetch().x[far]
    fallen = (m @ (x - start[far])) / m.sum()
    np.testing.assert_allclose(fallen, [0, -9.81 * 0.02**2 * 50 * 51 / 2, 0], atol=1e-9)
    assert np.abs(x - x.mean(axis=0) - start[far] + start[far].mean(axis=0)).max() < 1e-8, "nothing strains it"
    assert np.abs(sim.world.x[near] - start[near]).max() < 0.3, "the stump hangs"


def test_a_split_body_is_repeated_to_the_bit_and_a_reset_makes_it_whole():
    sim, twin = made(own=SPARE), made(own=SPARE)
    start = Start(sim)
    for each in (sim, twin):
        each.engine.run(4)
        split(each, SLIT)
        each.engine.run(4)
        split(each, HALVES)
        each.engine.run(4)
    assert np.array_equal(sim.fetch().x, twin.fetch().x)
    start.reset()
    assert sim.parameters.changed == {}
    whole = made(own=SPARE)
    for each in (sim, whole):
        each.engine.run(6)
    assert np.array_equal(sim.fetch().x, whole.fetch().x)
    split(sim, HALVES)
    split(whole, HALVES)
    for each in (sim, whole):
        each.engine.run(6)
    assert np.array_equal(sim.fetch().x, whole.fetch().x), "a spare node may be used again"


@pytest.mark.parametrize("update", ["every-3", "lockstep-2"])
def test_a_checkpoint_of_a_split_body_goes_on_to_the_bit(update):
    keys = {"own": {"cutting": {"spare": 90}}, "mesh": FINE, "solver": {"tolerance": 1e-8, "update": update}}
    driver = Driver(made(**keys))
    driver.advance(4)
    split(driver.simulation, SLIT)
    driver.advance(5)
    saved = from_bytes(capture(driver.simulation, driver, "test").to_bytes())
    again = Driver(made(**keys))
    manifest = restore(again.simulation, saved)
    restore_driver(again, manifest, saved_factors(again.simulation, saved, manifest))
    for each in (driver, again):
        each.advance(6)
        split(each.simulation, HALVES)
        records = each.advance(6)
    assert np.array_equal(driver.simulation.fetch().x, again.simulation.fetch().x)
    assert (records["status"] == pb.CONVERGED).all()


def test_a_scene_may_begin_split():
    text = splitter_of(made(own=SPARE)).opened_by("", faces_around(made(own=SPARE), SLIT))
    given, later = made(own={"cutting": {"spare": 60, "opened": text}}), made(own=SPARE)
    split(later, SLIT)
    for sim in (given, later):
        sim.engine.run(5)
    np.testing.assert_allclose(given.fetch().x, later.fetch().x, atol=1e-12)
    assert given.parameters.changed == {} and given.cutting.at_rest.sum() == later.cutting.at_rest.sum()


def test_what_does_not_split_is_as_without_spare_nodes():
    sim, plain = made(own=SPARE), made()
    for each in (sim, plain):
        each.engine.run(10)
    n = plain.world.nodes
    np.testing.assert_allclose(sim.fetch().x[:n], plain.fetch().x, atol=1e-12)


def test_elements_are_removed_from_a_split_body(tmp_path):
    """What is removed after a split has the part of its copies; nothing holds the two lips then."""
    sim = made(own=SPARE)
    found = split(sim, HALVES)
    sim.engine.run(2)
    gone = np.flatnonzero(mask("X > 1.74", sim.world.bodies[0].centroids))
    sim.parameters.set({"bar.cutting.removed": f'"{" ".join(map(str, gone))}"'})
    sim.engine.run(10)
    left = np.setdiff1d(np.arange(len(found.tets)), gone)
    volume = np.bincount(found.tets[left].ravel(), weights=np.repeat(sim.world.bodies[0].mesh.volumes[left], 4),
                         minlength=len(found.origin)) / 4  # fmt: skip
    there = volume > 0
    np.testing.assert_allclose(sim.world.mass[there], 1000 * volume[there], rtol=1e-12)
    assert np.array_equal(sim.cutting.at_rest == 0, there)


@pytest.mark.parametrize("update", ["never", "every-4", "lockstep-3"])
def test_factors_from_before_a_split_stay_in_use(update):
    """The copies move with the nodes that the factor knows, and a local solve sets them apart."""
    worst = {}
    for preconditioner in ("cholesky", "block_jacobi"):
        solver = {"preconditioner": preconditioner, "update": update, "tolerance": 1e-6}
        sim = made(mesh=FINE, own={"cutting": {"spare": 90}}, solver=solver)
        driver = Driver(sim)
        driver.advance(6)
        used = split(sim, SLIT).used
        records = driver.advance(9)
        worst[preconditioner] = records["iterations"].max()
        assert (records["status"] == pb.CONVERGED).all() and records["fallbacks"].sum() == 0 and used == 45
        if preconditioner == "cholesky":
            assert records["iterations"][-1] <= (14 if update == "never" else 5), "a factor of the split body comes"
            if update == "never":
                wanted, treated, rest = sim.engine.cut_nodes(0)
                assert wanted == treated == 90 and rest == 45 and records["factor_step"].max() == 0
    assert worst["cholesky"] <= 16 < 45 < worst["block_jacobi"]


def test_the_preconditioner_is_symmetric_and_positive_with_and_without_the_local_solve():
    solver = {"preconditioner": "cholesky", "update": "never", "tolerance": 1e-6, "factor_precision": "float64"}
    for part in (0.0, 0.4):  # of all faces, so many that no local solve is cheap
        sim = made(mesh=FINE, own={"cutting": {"spare": 3000}}, solver=solver)
        Driver(sim).advance(3)
        if part:
            faces = np.flatnonzero(splitter_of(sim).whole.closed)
            chosen = np.random.default_rng(2).choice(faces, int(part * len(faces)), replace=False)
            sim.parameters.set(opening(splitter_of(sim), "", np.sort(chosen)))
        else:
            split(sim, SLIT)
        sim.engine.assemble()
        random = np.random.default_rng(1)
        free = np.repeat(sim.world.free[: sim.world.nodes] * (sim.cutting.at_rest == 0), 3)
        a, b = random.standard_normal((2, 3 * sim.world.nodes)) * free
        za, zb = sim.engine.precondition(0, a).copy(), sim.engine.precondition(0, b).copy()
        assert za @ b == pytest.approx(zb @ a, rel=1e-6)
        assert za @ a > 0 and zb @ b > 0
        treated = sim.engine.cut_nodes(0)[1]
        assert (treated > 0) == (part == 0)
        sim.engine.solve()
        record = sim.engine.records()[-1]
        assert record["status"] == pb.CONVERGED and record["fallbacks"] == 0


def test_too_few_spare_nodes_are_refused_and_nothing_changes():
    sim, twin = made(own={"cutting": {"spare": 8}}), made(own={"cutting": {"spare": 8}})
    with pytest.raises(BadParameter, match=r"it needs 9 more spare nodes, 8 of cutting.spare = 8 are left"):
        split(sim, HALVES)
    assert sim.parameters.changed == {}
    split(sim, "X > 1.74 and Y > 0.25 and Z > 0.25")
    split(twin, "X > 1.74 and Y > 0.25 and Z > 0.25")
    with pytest.raises(BadParameter, match="are left"):
        split(sim, HALVES)
    for each in (sim, twin):
        each.engine.run(3)
    assert np.array_equal(sim.fetch().x, twin.fetch().x)


@pytest.mark.parametrize(
    ("keys", "says"),
    [
        ({"integrator": {"scheme": "ros2"}}, "not split in the scheme ros2; allowed: backward_euler, newmark, bdf2"),
        ({"effects": {"contact": {"between": False}}, "obstacle": [{"name": "floor", "shape": "plane"}]},
         "objects of a scene with the effect contact cannot be split"),
        ({"own": {"mass_spring": {"young": 1e5}, **SPARE}}, "with the effect mass_spring cannot be split"),
        ({"own": {"fixed": {"where": "X < 0.01", "along": "x"}, **SPARE}}, "fixed with along"),
        ({"holder": [{"name": "hand", "object": "bar", "where": "X > 1.9"}]}, "a scene with holders cannot be split"),
        ({"own": {"cutting": {"spare": 60, "opened": "768"}}}, "opened: there is no face 768: numbers are from 0"),
    ],
)  # fmt: skip
def test_what_cannot_be_split_is_refused(keys, says):
    with pytest.raises(InputError, match=says):
        made(**{"own": SPARE, **keys})


@pytest.mark.parametrize(("given", "says"), [({"opened": "3"}, "spare = 0"), ({"spare": 5, "opened": "x; 3"}, "face")])
def test_a_text_that_opens_nothing_is_refused(given, says):
    with pytest.raises(ValueError, match=says):
        made(own={"cutting": given})


def blade_at(x, depth):
    """Swept through y and, from above, z, down to a depth."""
    return [pb.Vector(x=x, y=y, z=z) for y, z in ((-1, depth), (2, depth), (2, 2), (-1, 2))]


def test_clients_split_what_keeps_spare_nodes():
    """Two cuts in a row, of which the loop takes the second one alone: it finds copies where they will be."""
    sim, other = made(own=SPARE), made(own=SPARE)
    for each in (sim, other):
        each.engine.run(3)
    replies = []
    for each in (sim, other):
        for depth in (0.3, -1):
            reply = carry_out(each, pb.Cut(object="bar", blade=blade_at(1.02, depth), split=True), "client")
            replies.append((reply.opened, reply.copied, reply.left, reply.removed))
            if each is other:
                each.engine.take_changes()
    assert replies[:2] == replies[2:] and all(opened > 0 and copied > 0 for opened, copied, *_ in replies)
    assert replies[0][2:] == (len(sim.world.bodies[0].mesh.tets), 0)
    again = carry_out(sim, pb.Cut(object="bar", blade=blade_at(1.02, -1), split=True), "client")
    assert again.opened == again.copied == 0
    for each in (sim, other):
        each.engine.run(5)
    assert np.array_equal(sim.fetch().x, other.fetch().x)
    found = sim.world.splitting.of(sim.parameters.scene, 0)
    assert components(found.tets, len(found.origin)) == 2
    with pytest.raises(BadCut, match="one of blade, radius, where and elements"):
        carry_out(sim, pb.Cut(object="bar", split=True), "client")
    with pytest.raises(BadCut, match=r"add spare to its effect cutting, as cutting = \{ spare = 1000 \}"):
        carry_out(made(), pb.Cut(object="bar", where="X > 1", split=True), "client")


MESH = bar((4, 3, 3), (1.0, 0.8, 0.7))


def test_a_blade_through_a_body_parts_it_and_one_that_ends_in_it_does_not():
    splitter = Splitter("block", MESH, 200)
    owners = splitter.faces.owners
    through = np.array([[0.45, -1, -1], [0.5, 2, -1], [0.62, 2, 2], [0.55, -1, 2]], float)
    for corners, parts in ((through, 2), (through - [0, 0, 1.6], 1)):
        faces = opened_by_blade(MESH.rest, MESH.tets, owners, corners)
        found = splitter.split(splitter.opened_by("", faces))
        assert found.used > 0 and components(found.tets, len(found.origin)) == parts
        open_faces = np.flatnonzero(splitter.whole.closed & ~found.closed)
        assert np.array_equal(np.sort(faces), open_faces)
        surface = splitter.faces.surface(np.ones(len(MESH.tets)), found.tets, found.closed)
        assert len(surface) == len(surface_triangles(MESH.tets)) + 2 * len(faces)
        outer = np.sort(surface_triangles(found.tets), axis=1).tolist()
        if parts == 2:  # nothing hangs together at the faces, so they are those of one element
            assert sorted(map(sorted, surface.tolist())) == sorted(outer)


def test_what_a_cut_has_copied_keeps_its_number_in_later_ones():
    """All elements of a block apart: each has nodes of its own, whose number grows by no more than is left."""
    splitter, random = Splitter("block", MESH, 4 * len(MESH.tets)), np.random.default_rng(3)
    faces = random.permutation(np.flatnonzero(splitter.whole.closed))
    text, before = "", splitter.whole
    for part in np.array_split(faces, 12):
        text = splitter.opened_by(text, part)
        found = splitter.split(text)
        assert np.array_equal(
            found.origin[: splitter.nodes + before.used], before.origin[: splitter.nodes + before.used]
        )
        changed = found.tets != before.tets
        assert (found.tets[changed] >= splitter.nodes + before.used).all()
        assert np.array_equal(found.root[found.tets], MESH.tets)
        before = found
    assert len(np.unique(found.tets)) == 4 * len(MESH.tets) == splitter.nodes + found.used
    again = Splitter("block", MESH, 4 * len(MESH.tets)).split(text)
    assert np.array_equal(again.tets, found.tets)


def components(tets, nodes):
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    pairs = np.concatenate([tets[:, [0, k]] for k in (1, 2, 3)])
    graph = coo_array((np.ones(len(pairs)), pairs.T), shape=(nodes, nodes))
    return len(np.unique(connected_components(graph, directed=False)[1][np.unique(tets)]))


def test_a_thousand_cuts_are_as_many_at_the_start():
    splitter = Splitter("bar", bar((4, 2, 2), (2, 0.5, 0.5)), 60)
    faces = np.flatnonzero(splitter.whole.closed)[:3]
    sides = [int(splitter.faces.sides[face, 0]) for face in faces]
    once = splitter.split("; ".join(map(str, sides)))
    again = splitter.split("; ".join(map(str, sides * 400)))
    np.testing.assert_array_equal(once.tets, again.tets)


def test_copies_of_nodes_that_a_group_fixes_are_fixed_from_the_start():
    mesh = bar((4, 2, 2), (2, 0.5, 0.5))
    left = np.flatnonzero(mesh.rest[:, 0] < 0.01)
    arrays = {"points": mesh.rest, "tets": mesh.tets, "groups": {"left": {"nodes": left}}}
    live = made(own=SPARE | {"fixed": {"group": "left"}}, mesh=arrays)
    found = split(live, "Y > 0.25")
    opened = live.parameters.scene.objects[0].effects["cutting"].opened
    begun = made(own={"cutting": {"spare": 60, "opened": opened}, "fixed": {"group": "left"}}, mesh=arrays)
    fixed = (found.origin >= 0) & np.isin(found.root, left)
    assert fixed.sum() > len(left) and not begun.world.free[fixed].any()
    for each in (live, begun):
        each.engine.run(10)
    np.testing.assert_allclose(live.fetch().x, begun.fetch().x, atol=1e-7)


def test_a_cut_sees_copies_where_they_come_from_until_a_step_has_made_them():
    sim = made(own=SPARE)
    sim.engine.run(3)
    found = split(sim, HALVES)
    copies = np.flatnonzero(found.used > np.arange(len(found.origin)) - splitter_of(sim).nodes)
    x = sim.cutting.positions(sim.parameters.scene)
    np.testing.assert_array_equal(x[copies], x[found.root[copies]])
    sim.engine.run(3)
    np.testing.assert_array_equal(sim.cutting.positions(sim.parameters.scene), sim.fetch().x)


def test_workers_get_matrices_of_bodies_that_may_be_split():
    sim = made(own=SPARE)
    assert not all(effect.known_to_workers for effect in sim.effects.values())
    assert all(effect.known_to_workers for effect in made(own={"cutting": True}).effects.values())


def places(sim):
    found = NamedPoints(sim.world, sim.world.bodies[0])
    found.now()
    return found


def test_box_and_tip_are_those_of_a_body_without_spare_nodes():
    """Spare nodes wait where the first node is at rest: among what is fixed, or high above a body that fell."""
    fixed = {"fixed": {"where": "X > 1.99"}}
    sim, plain = made(own=SPARE | fixed), made(own=fixed)
    assert places(sim).tip() == places(plain).tip() and places(sim).tip()[0] == 0
    sim, plain = (made(fixed=False, own=own | {"rayleigh": {}}) for own in (SPARE, {}))
    for each in (sim, plain):
        each.engine.run(30)
    assert np.ptp(sim.fetch().x[:, 1]) > 1
    np.testing.assert_allclose(places(sim).box(), places(plain).box(), atol=1e-9)
    assert places(sim).tip() == pytest.approx(places(plain).tip(), abs=1e-9)


def test_copies_of_fixed_nodes_are_fixed_and_those_that_move_are_in_the_box():
    own = SPARE | {"fixed": {"where": "X < 0.01 and Y < 0.3"}}
    sim = made(own=own)
    before = places(sim)
    found = split(sim, "Y > 0.25")
    sim.engine.run(20)
    copies = np.flatnonzero((found.origin >= 0) & (found.origin != np.arange(len(found.origin))))
    of_fixed = sim.world.bodies[0].mesh.rest[found.root[copies], 0] < 0.01
    before.now()
    for points in (before, places(sim)):
        assert of_fixed.any() and np.array_equal(points.free[copies], ~of_fixed)
        x = sim.fetch().x[found.origin >= 0]
        assert points.box() == (tuple(x.min(axis=0)), tuple(x.max(axis=0)))
        assert points.tip() == before.tip()


def test_copies_for_workers_have_the_room_of_their_body():
    """A small body that may not be split, one that may, and one that would need as much as it has elements."""

    def bodies(spares):
        first = table()["object"][0]
        for name, spare, mesh in zip("abc", spares, (FINE, BAR, BAR), strict=True):
            yield first | {"name": name, "mesh": mesh, "effects": first["effects"] | {"cutting": {"spare": spare}}}

    plain, sim = (made(object=list(bodies(spares))) for spares in ((0, 0, 0), (0, 10, 10**4)))
    blocks = [len(plain.system.body_values(b.first, b.last)) for b in plain.world.bodies]
    rooms = [sim.system.most_blocks(b.first, b.last) for b in sim.world.bodies]
    most = [2 * 6 * len(b.mesh.tets) + b.last - b.first for b in sim.world.bodies]
    assert rooms[0] == blocks[0]
    assert blocks[1] < rooms[1] <= most[1] and rooms[2] == most[2]
    apart = sim.world.splitting.splitters[2]
    sim.parameters.set(opening(apart, "", np.flatnonzero(apart.whole.closed)))
    sim.engine.run(2)
    used = [len(sim.system.body_values(b.first, b.last)) for b in sim.world.bodies]
    assert used[:2] == [blocks[0], blocks[1] + 10] and blocks[2] < used[2] - 10**4 <= rooms[2] - 10**4


def test_what_is_removed_changes_arms_of_frames_but_not_neighbours(monkeypatch):
    """Those of a split body that begins without these elements."""
    sim = made("neo_hookean", own=SPARE)
    split(sim, SLIT)
    text, gone = sim.parameters.scene.objects[0].effects["cutting"].opened, "0-40 150"
    sim.engine.take_changes()
    whole = sim.shape.arm.copy()
    begins = made("neo_hookean", own={"cutting": {"spare": 60, "opened": text, "removed": gone}})
    monkeypatch.delattr(shape_matching, "neighbours")  # those that it has stay
    sim.parameters.set({"object.bar.effects.cutting.removed": f'"{gone}"'})
    sim.engine.take_changes()
    assert np.array_equal(sim.shape.arm, begins.shape.arm) and not np.array_equal(sim.shape.arm, whole)
    assert np.array_equal(sim.shape.neighbour, begins.shape.neighbour)
    with pytest.raises(NameError):
        split(sim, HALVES)
