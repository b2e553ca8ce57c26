# SPDX-License-Identifier: MIT
"""Named groups of mesh files choose elements and nodes, wherever a scene has `where`."""

from pathlib import Path

import meshio
import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.mesh import Mesh, bar, read
from sim_server.mesh.groups import Group
from sim_server.mesh.surface import surface_triangles
from sim_server.recording import messages
from sim_server.scene import Scene, load, where
from sim_server.simulation import Simulation
from sim_server.updates.worker_assembly import Assembly

BOX = bar([4, 1, 1], [4.0, 1.0, 1.0])
LEFT = BOX.centroids[:, 0] < 2
SURFACE = surface_triangles(BOX.tets)
END = SURFACE[(BOX.rest[SURFACE][:, :, 0] == 0).all(axis=1)]
AT_END, AT_LEFT = BOX.rest[:, 0] == 0, BOX.rest[:, 0] <= 2

# What "save all" of gmsh 4 leaves of a tetrahedron: the physical surface "wall" (also "both"), the physical volumes
# "body" and "both", and a point, an edge and two faces that are in no group.
SAVE_ALL = """$MeshFormat
4.1 0 8
$EndMeshFormat
$PhysicalNames
4
2 7 "wall"
2 9 "both"
3 1 "body"
3 9 "both"
$EndPhysicalNames
$Entities
1 1 2 1
1 0 0 0 0
1 0 0 0 1 0 0 0 0
1 0 0 0 1 1 0 2 7 9 0
2 0 0 0 1 0 1 0 0
1 0 0 0 1 1 1 2 1 9 0
$EndEntities
$Nodes
1 4 1 4
3 1 0 4
1
2
3
4
0 0 0
1 0 0
0 1 0
0 0 1
$EndNodes
$Elements
5 5 1 5
0 1 15 1
1 1
1 1 1 1
2 1 2
2 1 2 1
3 1 3 2
2 2 2 1
4 1 2 4
3 1 4 1
5 1 2 3 4
$EndElements
"""
SCENE = """
dt = 0.01
[solver]
update = "every-1"
preconditioner = "cholesky"
[[object]]
name = "liver"
mesh = { file = "organ.msh" }
elements = "linear"
[object.effects]
corotational = { young = [{ group = "tumour", young = 2e4, poisson = 0.3 }, { young = 1e4, poisson = 0.4 }] }
fixed = { group = "ligament", where = "Y < 0.5" }
"""


def write_organ(folder: Path) -> Path:
    """Writes a bar as a file of gmsh with the groups tumour (left half), rest, and ligament (triangles at X = 0)."""
    parts = [("triangle", END, 7), ("tetra", BOX.tets[LEFT], 1), ("tetra", BOX.tets[~LEFT], 2)]
    tags = [np.full(len(cells), tag) for _, cells, tag in parts]
    given = meshio.Mesh(
        BOX.rest, [(kind, cells) for kind, cells, _ in parts],
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
        field_data={"ligament": np.array([7, 2]), "tumour": np.array([1, 3]), "rest": np.array([2, 3])},
    )  # fmt: skip
    given.write(folder / "organ.msh", file_format="gmsh22")
    return folder / "organ.msh"


def test_physical_groups_have_elements_and_nodes(tmp_path):
    mesh = read(write_organ(tmp_path))
    assert sorted(mesh.groups) == ["ligament", "rest", "tumour"]
    assert np.array_equal(where.elements('group("tumour")', mesh), mesh.centroids[:, 0] < 2)
    assert np.array_equal(where.nodes('group("tumour")', mesh), AT_LEFT)
    assert np.array_equal(where.nodes('group("ligament")', mesh), AT_END)
    chosen = where.nodes('not group("ligament") and (Y > 0.5 or group("rest")) and X < 3', mesh)
    x, y, _ = BOX.rest.T
    assert np.array_equal(chosen, ~AT_END & ((y > 0.5) | (x >= 2)) & (x < 3))


def test_save_all_of_gmsh_is_read(tmp_path):
    """Only some of its entities are in a group, and some in two."""
    (tmp_path / "all.msh").write_text(SAVE_ALL)
    mesh = read(tmp_path / "all.msh")
    assert mesh.tets.tolist() == [[0, 1, 2, 3]]
    held = {name: np.flatnonzero(mesh.nodes_of(name)).tolist() for name in mesh.groups}
    assert held == {"wall": [0, 1, 2], "body": [0, 1, 2, 3], "both": [0, 1, 2, 3]}
    assert mesh.elements_of("both").all()


def test_sets_of_abaqus_and_numbers_of_medit(tmp_path):
    cells = [("tetra", BOX.tets)]
    sets = {"tumour": [np.flatnonzero(LEFT)]}
    given = meshio.Mesh(BOX.rest, cells, cell_sets=sets, point_sets={"end": np.flatnonzero(AT_END)})
    given.write(tmp_path / "a.inp")
    mesh = read(tmp_path / "a.inp")
    assert np.array_equal(mesh.elements_of("tumour"), LEFT) and np.array_equal(mesh.nodes_of("end"), AT_END)
    meshio.Mesh(BOX.rest, cells, cell_data={"medit:ref": [np.where(LEFT, 3, 0)]}).write(tmp_path / "a.mesh")
    mesh = read(tmp_path / "a.mesh")
    assert list(mesh.groups) == ["3"] and np.array_equal(mesh.elements_of("3"), LEFT)


def test_numbers_that_count_something_are_no_groups(tmp_path):
    large = bar([5, 4, 1], [5.0, 4.0, 1.0])
    numbers = {"medit:ref": [np.arange(len(large.tets))]}
    meshio.Mesh(large.rest, [("tetra", large.tets)], cell_data=numbers).write(tmp_path / "a.mesh")
    assert len(large.tets) > 100 and read(tmp_path / "a.mesh").groups == {}


def test_a_group_of_split_cells_has_their_tetrahedra(tmp_path):
    """Of hexahedra beside tetrahedra in the same file, whichever comes first; nodes without a cell are renumbered."""
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)], float)
    points = np.concatenate(
        [[[9.0, 9, 9]], corners, corners + np.array([2, 0, 0]), [[5, 0, 0], [6, 0, 0], [5, 1, 0], [5, 0, 1]]]
    )
    hexahedra = 1 + np.array([[0, 1, 3, 2, 4, 5, 7, 6], [8, 9, 11, 10, 12, 13, 15, 14]])
    tags = [np.array([1, 2]), np.array([2])]
    given = meshio.Mesh(
        points, [("hexahedron", hexahedra), ("tetra", np.array([[17, 18, 19, 20]]))],
        cell_data={"gmsh:physical": tags, "gmsh:geometrical": tags},
        field_data={"a": np.array([1, 3]), "b": np.array([2, 3])},
    )  # fmt: skip
    given.write(tmp_path / "h.msh", file_format="gmsh22")
    mesh = read(tmp_path / "h.msh")
    assert len(mesh.tets) == 13
    assert np.array_equal(mesh.elements_of("a"), mesh.centroids[:, 0] < 1)
    assert np.array_equal(mesh.nodes_of("b"), mesh.rest[:, 0] >= 2)


def test_quadratic_elements_keep_their_groups():
    tumour = Group(elements=np.flatnonzero(LEFT).astype(np.int32))
    ligament = Group(faces=END[:, [0, 1, 2, 2]])
    mesh = Mesh(BOX.rest, BOX.tets, groups={"tumour": tumour, "ligament": ligament}).with_mid_nodes()
    assert np.array_equal(mesh.elements_of("tumour"), np.repeat(LEFT, 8))
    assert np.array_equal(mesh.nodes_of("ligament"), mesh.rest[:, 0] == 0)
    assert np.array_equal(mesh.nodes_of("tumour"), mesh.rest[:, 0] <= 2)


@pytest.fixture(scope="module")
def organ(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("organ")
    write_organ(folder)
    (folder / "scene.toml").write_text(SCENE)
    return folder


def test_a_scene_names_groups_of_elements_and_nodes(organ):
    """Its resolved form says the same, and a worker that knows the topology alone makes the same matrix."""
    scene = load(organ / "scene.toml")
    assert Scene.model_validate(scene.resolved()).resolved() == scene.resolved()
    sim = Simulation(scene)
    young, poisson = sim.effects["corotational"].elastic[0]
    assert np.array_equal(young, np.where(LEFT, 2e4, 1e4)) and np.array_equal(poisson, np.where(LEFT, 0.3, 0.4))
    assert np.array_equal(sim.world.free == 0, AT_END & (BOX.rest[:, 1] < 0.5))
    sim.engine.assemble()
    topology = messages.topology(sim, sim.world.bodies[0])
    assembly = Assembly(messages.scene(sim), topology)
    np.testing.assert_allclose(assembly.matrix(sim.world.x.copy()), sim.system.values, rtol=1e-12)


def test_all_that_names_nodes_knows_groups(organ):
    """Holders, attachments, springs to a target, drained nodes, loads and membranes; also in lists of tables."""
    effects = """
target = { to = ["X", "Y", "Z"], stiffness = 1, group = "rest" }
traction = [{ group = "ligament", force = [0, 0, 3] }, { group = "tumour", where = "Z > 0.99", pressure = 1 }]
poroelasticity = { mobility = 1e-9, storage = 1e5, drained = { group = "ligament" } }
membrane = { young = 1e5, poisson = 0.3, thickness = 1e-3, group = "ligament" }
[[holder]]
name = "clamp"
object = "liver"
group = "ligament"
"""
    (organ / "all.toml").write_text(SCENE.replace('fixed = { group = "ligament", where = "Y < 0.5" }', effects))
    scene = load(organ / "all.toml")
    sim = Simulation(scene)
    assert np.array_equal(sim.world.held > 0, AT_END)
    assert np.array_equal(sim.effects["target"].stiffness > 0, BOX.rest[:, 0] >= 2)
    assert len(sim.effects["membrane"].elements) == len(END)
    first, second = scene.objects[0].effects["traction"].tables
    assert (first.where, second.where) == ('group("ligament")', 'group("tumour") and (Z > 0.99)')
    assert scene.holders[0].where == first.where and scene.holders[0].name == "clamp"


def test_one_region_is_set_by_its_name(organ):
    at_start = load(organ / "scene.toml", ["object.liver.effects.corotational.young[tumour]=3e4"])
    sim = Simulation(at_start)
    assert np.array_equal(sim.effects["corotational"].elastic[0][0], np.where(LEFT, 3e4, 1e4))
    assert load(organ / "scene.toml", ["object.liver.effects.corotational.poisson[tumour]=0.1"]).objects[0].effects[
        "corotational"
    ].young[0].poisson == pytest.approx(0.1)
    sim.parameters.set({"liver.corotational.young[tumour]": "5e4"})
    assert np.array_equal(sim.effects["corotational"].elastic[0][0], np.where(LEFT, 5e4, 1e4))
    assert list(sim.parameters.changed) == ["object.liver.effects.corotational.young"]
    with pytest.raises(ValueError, match=r"no region 'tumor'; did you mean 'tumour'\?"):
        sim.parameters.set({"liver.corotational.young[tumor]": "5e4"})


@pytest.mark.parametrize(
    ("given", "words"),
    [
        ('fixed = { group = "ligamnet" }', "no group 'ligamnet' in organ.msh; groups of it: ligament (nodes), re"),
        ("fixed = { group = 7 }", "effects.fixed.group = 7: must be the name of a group"),
        ('corotational = { young = [{ group = "ligament", young = 1 }], poisson = 0 }', "'ligament' of organ.msh has"),
        ("fixed = { where = { } }", "effects.fixed.where: must be a string"),
        ("fixed = { group = 'ligament', where = { group = 'rumour' } }", "no group 'rumour' in organ.msh"),
        ("fixed = { where = 'group(X)' }", "group takes one name in quotes"),
    ],
)  # fmt: skip
def test_groups_that_are_not_there_are_refused(organ, given, words):
    kept = [line for line in SCENE.splitlines() if line.split(" ")[0] != given.split(" ")[0]]
    (organ / "bad.toml").write_text("\n".join([*kept, given]))
    with pytest.raises(InputError) as error:
        Simulation(load(organ / "bad.toml"))
    assert words in str(error.value)
