# SPDX-License-Identifier: MIT
"""Quadratic tetrahedra: files keep their nodes on edges, sub-tetrahedra match, what cannot be used is named."""

import logging

import meshio
import numpy as np
import pytest

from sim_server.errors import InputError
from sim_server.mesh import Mesh, bar, check, read
from sim_server.mesh.quadratic import AROUND, AT_CORNERS, EDGES, MIRRORED
from sim_server.mesh.surface import surface_triangles, volumes

REFERENCE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]])


def jittered(cells=(2, 2, 3), curved=0.0):
    """A bar with inner nodes moved at random, its edges' nodes added and moved by up to `curved` of the edge length."""
    random = np.random.default_rng(3)
    box = bar(cells, cells)
    inner = ((box.rest > 0) & (box.rest < cells)).all(axis=1)
    box.rest[inner] += random.uniform(-0.2, 0.2, (inner.sum(), 3))
    mesh = box.with_mid_nodes()
    mesh.rest[len(box.rest) :] += random.uniform(-curved, curved, (len(mesh.rest) - len(box.rest), 3))
    return check(mesh)


def middles(mesh):
    return mesh.rest[mesh.quadratic[:, np.array(EDGES)]].mean(axis=2)


def surface_area(mesh):
    a, b, c = (mesh.rest[surface_triangles(mesh.tets)[:, k]] for k in range(3))
    return np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2


FORMATS = [
    (".vtk", "vtk"), (".vtk", "vtk42"), (".vtu", "vtu"), (".msh", "gmsh"), (".msh", "gmsh22"), (".inp", "abaqus"),
    (".bdf", "nastran"), (".vol", "netgen"), (".mdpa", "mdpa"),
]  # fmt: skip


@pytest.mark.parametrize(("suffix", "form"), FORMATS)
def test_formats_keep_the_nodes_on_edges(tmp_path, monkeypatch, suffix, form):
    monkeypatch.chdir(tmp_path)
    mesh = jittered(curved=0.05)
    mesh.rest[...] = mesh.rest.round(4)  # what a card of Nastran holds
    path = tmp_path / f"q{suffix}"
    meshio.write(path, meshio.Mesh(mesh.rest, [("tetra10", mesh.quadratic)]), form)
    found = check(read(path, quadratic=True))
    assert found.quadratic.shape == mesh.quadratic.shape and found.dropped == 0
    assert np.allclose(found.rest[found.quadratic[:, 4:]], middles(found), atol=0.05 * 3**0.5)
    assert np.abs(volumes(found.rest, found.tets) / volumes(mesh.rest, mesh.tets) - 1).max() < 1e-4


# The ten nodes of one element as the manuals of gmsh and Abaqus number them: the last two edges change places
GMSH = """$MeshFormat
2.2 0 8
$EndMeshFormat
$Nodes
10
{nodes}
$EndNodes
$Elements
1
1 11 2 1 1 1 2 3 4 5 6 7 8 9 10
$EndElements
"""
ABAQUS = "*Node\n{nodes}\n*Element, type=C3D10\n1, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10\n"
MANUALS = [
    ("one.msh", GMSH, " ", ((0, 1), (1, 2), (2, 0), (0, 3), (2, 3), (1, 3))),
    ("one.inp", ABAQUS, ", ", ((0, 1), (1, 2), (0, 2), (0, 3), (1, 3), (2, 3))),
]


@pytest.mark.parametrize(("name", "text", "between", "edges"), MANUALS)
def test_files_as_other_programs_write_them(tmp_path, caplog, name, text, between, edges):
    points = np.concatenate([REFERENCE, REFERENCE[np.array(edges)].mean(axis=1)])
    nodes = "\n".join(between.join([str(k + 1), *map(str, x)]) for k, x in enumerate(points.tolist()))
    (tmp_path / name).write_text(text.format(nodes=nodes))
    mesh = check(read(tmp_path / name, quadratic=True))
    assert np.allclose(mesh.rest[mesh.quadratic[0, 4:]], middles(mesh)[0]) and not caplog.records


def test_nodes_in_another_order_are_put_in_order(tmp_path, caplog):
    mesh = jittered(curved=0.05)
    permuted = mesh.quadratic[:, [0, 1, 2, 3, 7, 5, 9, 8, 6, 4]]
    meshio.write(tmp_path / "q.vtu", meshio.Mesh(mesh.rest, [("tetra10", permuted)]))
    found = check(read(tmp_path / "q.vtu", quadratic=True))
    assert np.array_equal(found.quadratic, mesh.quadratic)
    assert "the nodes on the edges of 72 tetra10 cells put in order" in caplog.text


def test_without_being_asked_nothing_is_kept(tmp_path, caplog):
    mesh = jittered()
    meshio.write(tmp_path / "q.vtu", meshio.Mesh(mesh.rest, [("tetra10", mesh.quadratic)]))
    found = check(read(tmp_path / "q.vtu"))
    assert found.quadratic is None and np.array_equal(found.tets, mesh.quadratic[:, :4])
    assert "72 tetra10 cells reduced to their corners" in caplog.text


def test_with_other_cells_beside_them_they_are_reduced(tmp_path, caplog):
    mesh = bar((1, 1, 1), (1, 1, 1)).with_mid_nodes()
    beside = np.concatenate([mesh.quadratic[:1, :3], [[len(mesh.rest)]]], axis=1)
    points = np.concatenate([mesh.rest, mesh.rest[:1] + np.array([0.2, 0.2, 5])])
    meshio.write(tmp_path / "q.vtu", meshio.Mesh(points, [("tetra10", mesh.quadratic), ("tetra", beside)]))
    found = check(read(tmp_path / "q.vtu", quadratic=True))
    assert found.quadratic is None and len(found.tets) == 7
    assert "6 tetra10 cells reduced to their corners" in caplog.text


def test_the_sub_tetrahedra_fill_the_elements_and_match():
    linear = bar((3, 2, 2), (3, 2, 2))
    for mesh in (jittered((3, 2, 2)), jittered((3, 2, 2), curved=0.08)):
        assert len(mesh.tets) == 8 * len(mesh.quadratic) and (volumes(mesh.rest, mesh.tets) > 0).all()
        assert len(surface_triangles(mesh.tets)) == 4 * len(surface_triangles(linear.tets))
        owner = np.repeat(np.arange(len(mesh.quadratic)), 8)
        assert all(np.isin(tet, mesh.quadratic[e]).all() for e, tet in zip(owner, mesh.tets, strict=True))
    straight = jittered((3, 2, 2))
    sums = volumes(straight.rest, straight.tets).reshape(-1, 8).sum(axis=1)
    assert np.allclose(sums, volumes(straight.rest, straight.quadratic[:, :4]), rtol=1e-12)
    assert np.isclose(surface_area(straight), 32)


@pytest.mark.parametrize("diagonal", range(3))
def test_each_split_has_eight_equal_parts(diagonal):
    mesh = Mesh(REFERENCE, np.arange(4, dtype=np.int32)[None]).with_mid_nodes()
    parts = np.array([*AT_CORNERS, *AROUND[diagonal]])
    assert np.allclose(volumes(mesh.rest, mesh.quadratic[0][parts]), 1 / 48, rtol=1e-14)


def test_elements_wound_the_other_way_round_are_repaired(caplog):
    mesh = jittered(curved=0.05)
    turned = mesh.quadratic.copy()
    turned[::3] = turned[::3][:, MIRRORED]
    with caplog.at_level(logging.WARNING):
        found = check(Mesh(mesh.rest, mesh.tets, "liver.msh", quadratic=turned))
    assert np.array_equal(found.quadratic, mesh.quadratic) and np.array_equal(found.tets, mesh.tets)
    assert "winding of 24 of 72 elements repaired" in caplog.text


def one_element():
    return Mesh(REFERENCE, np.arange(4, dtype=np.int32)[None], "liver.msh").with_mid_nodes()


def bent(mesh):
    mesh.rest[mesh.quadratic[0, 4]] = [0.5, 0.9, 0.4]


def lost(mesh):
    mesh.rest[mesh.quadratic[0, 7]] = np.nan


def flat(mesh):
    mesh.rest[:, 2] = 0


def twice(mesh):
    mesh.quadratic[0, 5] = mesh.quadratic[0, 4]


def beyond(mesh):
    mesh.quadratic[0, 5] = 12


@pytest.mark.parametrize(("spoil", "words"), [
    (bent, ["tet 0 (least volume", "curved so much"]),
    (lost, ["node 6 ((nan, nan, nan))"]),
    (flat, ["tet 0 (0 m3", "zero volume"]),
    (twice, ["tet 0 (nodes [", "occurs twice"]),
    (beyond, ["tet 0 (nodes [", "must be 0 to 9"]),
])  # fmt: skip
def test_check_names_the_element(spoil, words):
    mesh = one_element()
    spoil(mesh)
    with pytest.raises(InputError) as error:
        check(mesh)
    assert all(w in str(error.value) for w in ["liver.msh", *words]), str(error.value)


def two_elements():
    points = np.concatenate([REFERENCE, [[1.0, 1, 1]]])
    return Mesh(points, np.array([[0, 1, 2, 3], [4, 2, 1, 3]], np.int32), "liver.msh").with_mid_nodes()


def test_neighbours_must_share_the_nodes_of_their_edges():
    mesh = two_elements()
    shared = mesh.quadratic[1, 5]  # on the edge of nodes 2 and 1
    mesh.quadratic[1, 5] = len(mesh.rest)
    apart = Mesh(np.concatenate([mesh.rest, mesh.rest[[shared]] + 0.01]), mesh.tets, "liver.msh", 0, mesh.quadratic)
    with pytest.raises(InputError, match=r"tet 0 \(node 8 on the edge of nodes \[1, 2\]\), tet 1 .* one node"):
        check(apart)


def test_a_corner_on_the_edge_of_a_neighbour_is_refused():
    points = np.concatenate([one_element().rest, [[0.5, 0.5, 2]]])
    hanging = np.array([[4, 1, 2, 3]], np.int32)
    small = Mesh(points, hanging).with_mid_nodes()
    both = np.concatenate([one_element().quadratic, small.quadratic])
    with pytest.raises(InputError, match=r"tet 0 \(node 4 on an edge of it\): is a corner of another element"):
        check(Mesh(small.rest, hanging, "liver.msh", 0, both))
