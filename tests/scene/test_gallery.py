# SPDX-License-Identifier: MIT
"""The scenes that come along: found by name, good meshes, and 30 steps of each to a known displacement."""

import os
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from clients.accuracy.study import check_scene
from clients.errors import BadInput
from deploy.gallery import hollow_finger
from deploy.gallery.__main__ import MESHES
from deploy.gallery.mesher import dihedral_angles, mesh, skin, surface, volumes
from deploy.gallery.pictures import BLADE, CUT, EFFECTS, PUSH
from sim_server.errors import InputError
from sim_server.mesh import read
from sim_server.scene import gallery, load
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.scenes import elastic
from tests.support.commands import in_turn

# Mean displacement of the nodes after 30 steps [m], with a factor of each step's matrix and a tolerance of 1e-12.
MOVED = {
    "beam": 0.6215740893325287, "creature": 0.030689663355918974, "jelly": 0.01463447589135043,
    "liver": 0.007724776085599566, "sheet": 0.6079951372654776, "tentacle": 0.030758850964178203,
}  # fmt: skip
# Compilers round differently, and a solve ends anywhere below 1e-6 of |b|: other preconditioners move the mean by 2e-6.
DIFFERENT = 2e-5
LITRES = {"creature": 6.687, "jelly": 0.4332, "liver": 1.922, "tentacle": 2.628}
LEAST, MOST = 17.0, 150.0  # degrees, of dihedral angles


def shape_numbers(x: NDArray[Any], tets: NDArray[Any]) -> tuple[float, float, float]:
    """Least volume [m3], least and largest dihedral angle [degrees]."""
    angle = dihedral_angles(x, tets)
    return float(volumes(x, tets).min()), float(np.nanmin(angle)), float(np.nanmax(angle))


def edge_uses(triangles: NDArray[Any]) -> set[int]:
    """How many triangles have an edge in common."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    return set(np.unique(edges, axis=0, return_counts=True)[1].tolist())


def test_the_scenes_are_these() -> None:
    assert gallery.names() == sorted(MOVED)
    for name in gallery.names():
        said = gallery.sentence(name)
        assert 30 < len(said) < 120 and said.endswith(".") and said[0].isupper()


def moved_in_thirty_steps(name: str, update: str, device: str = "cpu") -> float:
    """Returns the mean displacement of the nodes [m]; every solve must converge."""
    solver = ["solver.preconditioner=cholesky", f"solver.update={update}"]
    simulation = Simulation.load(f"gallery/{name}", solver, device)
    start = simulation.fetch().x.copy()
    records = Driver(simulation).advance(30)
    assert (records["status"] == 0).all()
    return float(np.linalg.norm(simulation.fetch().x - start, axis=1).mean())


@pytest.mark.parametrize("name", sorted(MOVED))
def test_thirty_steps(name: str) -> None:
    assert moved_in_thirty_steps(name, "every-10") == pytest.approx(MOVED[name], rel=DIFFERENT)


@pytest.mark.parametrize("name", sorted(MOVED))
def test_elements_are_good_and_bodies_may_be_touched(name: str) -> None:
    scene = load(f"gallery/{name}")
    scene.check_device("gpu")
    for o in scene.objects:
        body = o.load_mesh()
        least, smallest, largest = shape_numbers(body.rest, body.tets)
        assert least > 0 and smallest > LEAST and largest < MOST
        assert "touch" in o.effects


def test_its_page_shows_each_scene_with_its_sentence_and_its_command() -> None:
    docs = Path(__file__).parents[2] / "docs"
    parts = dict(part.split("\n", 1) for part in (docs / "gallery.md").read_text().split("\n## ")[1:])
    for name in gallery.names():
        assert f"sim-server gallery/{name} --workers 1\n" in parts[name]
        assert gallery.sentence(name) in parts[name] and f"](figures/gallery/{name}.png)" in parts[name]
        assert (docs / "figures" / "gallery" / f"{name}.png").stat().st_size < 200_000
    assert (docs / "figures" / "creature.gif").stat().st_size < 1_500_000


def test_its_page_shows_each_scene_of_an_effect_with_its_sentence_and_its_command() -> None:
    docs = Path(__file__).parents[2] / "docs"
    parts = dict(part.split("\n", 1) for part in (docs / "gallery.md").read_text().split("\n### ")[1:])
    assert set(parts) == {CUT, *EFFECTS}
    for name, part in parts.items():
        assert f"](figures/gallery/{name}.png)" in part
        assert (docs / "figures" / "gallery" / f"{name}.png").stat().st_size < 100_000
    for name in EFFECTS:
        said = (docs.parent / "deploy" / "scenes" / f"{name}.toml").read_text().split("\n", 1)[0].lstrip("# ")
        assert f"sim-server deploy/scenes/{name}.toml --workers 1\n" in parts[name]
        assert re.split(r"\.( |$)|: \d", said)[0] in parts[name]


def test_the_page_cuts_the_liver_as_its_picture_was_made() -> None:
    found = (Path(__file__).parents[2] / "docs" / "gallery.md").read_text()
    at, force = (" ".join(f"{c:g}" for c in PUSH[key]) for key in ("at", "force"))
    push = f"push --object liver --at {at} --radius {PUSH['radius']} --force {force} --duration {PUSH['duration']:g} "
    blade = ", ".join(" ".join(f"{c:g}" for c in corner) for corner in BLADE)
    assert f'sim-client {push}&& sim-client cut --object liver --blade "{blade}"\n' in found


def test_the_fingers_mesh_is_made_as_it_is_told() -> None:
    x, tets = hollow_finger.mesh()
    found = read(hollow_finger.FILE)
    assert (found.rest == x).all() and (found.tets == tets).all()
    assert edge_uses(surface(tets)[0]) == {2} and volumes(x, tets).min() > 0


@pytest.mark.parametrize("name", sorted(LITRES))
def test_meshes_and_skins_are_closed(name: str) -> None:
    found = read(gallery.FOLDER / f"{name}.msh")
    assert 1e3 * volumes(found.rest, found.tets.astype(int)).sum() == pytest.approx(LITRES[name], rel=1e-3)
    assert edge_uses(surface(found.tets.astype(int))[0]) == {2}
    rows = [line.split() for line in (gallery.FOLDER / f"{name}.obj").read_text().splitlines()]
    x = np.array([row[1:] for row in rows if row[0] == "v"], float)
    triangles = np.array([row[1:] for row in rows if row[0] == "f"], int) - 1
    assert edge_uses(triangles) == {2} and len(x) < 15_000
    inside = np.einsum("ij,ij->", x[triangles[:, 0]], np.cross(x[triangles[:, 1]], x[triangles[:, 2]])) / 6
    assert 1 < 1e3 * inside / LITRES[name] < 1.15  # chords of the coarse mesh cut round parts off


def test_the_creature_is_as_large_as_the_papers_and_its_skeleton_is_one_piece() -> None:
    simulation = Simulation.load("gallery/creature")
    tets = simulation.world.bodies[0].mesh.tets
    assert 4000 <= len(tets) <= 5000
    bones = tets[elastic(simulation).elastic[0][0] == 2e6]
    ends = np.sort(bones[:, [[0, 1], [0, 2], [0, 3]]].reshape(-1, 2), axis=1)
    graph = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), 2 * (simulation.world.nodes,))
    part = connected_components(graph, directed=False)[1][bones]
    assert (part == part[0, 0]).all() and len(bones) > 500


def test_meshes_are_made_from_distances() -> None:
    """The smallest one again: not the same bits everywhere, but as good, and as near to the shape."""
    made = MESHES["jelly"]
    low, high = np.array(made.low), np.array(made.high)
    x, tets = mesh(made.shape, low, high, made.cell)
    least, smallest, largest = shape_numbers(x, tets)
    assert least > 0 and smallest > LEAST and largest < MOST
    outer = np.unique(surface(tets)[0])
    assert np.abs(made.shape(x[outer])).max() < 0.3 * made.cell
    assert len(tets) == pytest.approx(len(read(gallery.FOLDER / "jelly.msh").tets), rel=0.1)
    vertices, triangles = skin(made.shape, low, high, 0.014)
    assert np.abs(made.shape(vertices)).max() < 1e-3 and edge_uses(triangles) == {2}


def test_a_file_of_that_name_wins(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert load("gallery/sheet").objects[0].name == load("gallery/sheet.toml").objects[0].name == "sheet"
    (tmp_path / "gallery" / "sheet").mkdir(parents=True)
    assert load("gallery/sheet").path == load("gallery/sheet.toml").path == Path("gallery/sheet")
    text = (gallery.FOLDER / "sheet.toml").read_text().replace('name = "sheet"', 'name = "mine"')
    (tmp_path / "gallery" / "sheet.toml").write_text(text)
    assert load("gallery/sheet.toml").objects[0].name == load("gallery/sheet").objects[0].name == "mine"
    assert load("gallery/sheet").path == Path("gallery/sheet.toml")
    assert load(gallery.FOLDER / "sheet.toml").path == Path("gallery/sheet"), "not where the package lies"


@pytest.mark.parametrize(
    "name", ["gallery/nobody", "sheet", "gallery/sheet.msh", "gallery/sub/sheet", "../gallery/sheet"]
)
def test_other_names_are_answered_with_those_that_are_there(name: str) -> None:
    with pytest.raises(InputError, match=r"No such file .*; scenes that come along: gallery/beam, .*gallery/tentacle"):
        load(name)


def test_an_overlay_beside_a_scene_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("sheet.toml", "sheet.plan.toml"):
        (tmp_path / name).touch()
    monkeypatch.setattr(gallery, "FOLDER", tmp_path)
    assert gallery.names() == ["sheet"]


def test_clients_leave_names_of_the_gallery_to_the_server() -> None:
    check_scene(Path("gallery/creature"))
    with pytest.raises(BadInput, match="no such file"):
        check_scene(Path("creature"))


def test_the_list_has_every_scene_as_it_is_run() -> None:
    (code, out, err), *_ = in_turn("sim_server", [["--list"]]).values()
    assert (code, err) == (0, "")
    lines = {line.split()[0]: line for line in out.splitlines()[1:] if line.strip()}
    for name in gallery.names():
        assert gallery.sentence(name).split(os.linesep)[0][:40] in lines[f"gallery/{name}"]
    assert lines["gallery/creature"].rstrip().endswith(" 4400")
    assert "sim-server NAME --workers 1" in out.splitlines()[-1]
