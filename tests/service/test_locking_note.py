# SPDX-License-Identifier: MIT
"""Objects whose linear tetrahedra lock are told at load, with what they lose as measured, and what to do."""

from pathlib import Path

import pytest

from protocol.messages_pb2 import CONVERGED
from sim_server.scene.model import Scene
from sim_server.service import locking_note
from sim_server.service.scene_notes import scene_notes
from sim_server.simulation import Simulation
from sim_server.updates.driver import Driver
from tests.reference.quadratic_statics import SAG, SIZE
from tests.scenes import bar, jittered_bar, mesh_file, scene, simulation

CELLS = {"bar": [1, 1, 2], "size": [1, 1, 2]}
MIRRORED, KUHN = {**CELLS, "split": "mirrored"}, {**CELLS, "split": "kuhn"}


def noted(*objects: dict, **table) -> list[str]:
    return scene_notes(simulation(*objects, **table))


def test_objects_alike_have_one_line():
    bodies = [bar(name=f"b{k}", mesh=KUHN, poisson=0.49) for k in range(5)]
    assert noted(bar(name="soft", mesh=KUHN, poisson=0.45), *bodies) == [
        "objects 'b0', 'b1', 'b2' and 2 more with a Poisson's ratio of 0.49 and linear tetrahedra (split = \"kuhn\"), "
        'which lock: a beam five of them thick bends about 60 % too little; elements = "smoothed" does not lock, '
        'split = "mirrored" locks less'
    ]


def test_what_is_lost_is_that_of_the_mesh(tmp_path: Path):
    file = mesh_file(tmp_path, *jittered_bar((2, 2, 2), (1, 1, 1)))
    lines = noted(*(bar(name=n, mesh=m, poisson=0.499) for n, m in {"k": KUHN, "m": MIRRORED, "u": file}.items()))
    assert [line.split("bends about ")[1].split(" %")[0] for line in lines] == ["86", "18", "70"]
    assert ['split = "mirrored"' in line.split(";")[1] for line in lines] == [True, False, False]


def test_the_largest_ratio_of_regions_counts():
    young = [{"where": "Z < 1", "young": 1e4, "poisson": 0.48}, {"where": "Z >= 1", "young": 1e4, "poisson": 0.3}]
    o = bar(mesh=KUHN, young=None)
    o["effects"]["corotational"] = {"young": young}
    [line] = noted(o)
    assert "ratio of 0.48 " in line


def test_laws_with_patches_are_told_of_them():
    o = bar(mesh=MIRRORED, young=None)
    o["effects"]["neo_hookean"] = {"young": 1e5, "poisson": 0.48}
    [line] = noted(o)
    assert line.endswith('; elements = "patch" does not lock')
    assert noted({**o, "elements": "patch"}) == []


def test_other_laws_have_no_patches():
    o = bar(mesh=MIRRORED, young=None)
    o["effects"]["st_venant_kirchhoff"] = {"young": 1e5, "poisson": 0.48}
    [line] = noted(o)
    assert line.endswith("; a finer mesh locks less")
    [line] = noted(bar(mesh=KUHN, poisson=0.48, rotation="qr"))
    assert line.endswith('; split = "mirrored" locks less')


@pytest.mark.parametrize("poisson", [0.46, 0.4899, 0.4995, 0.49999])
@pytest.mark.parametrize("mesh", locking_note.KEPT)
def test_between_measured_ratios_what_is_kept_lies_between(mesh: str, poisson: float):
    place = sum(p < poisson for p in locking_note.POISSON)
    values = locking_note.KEPT[mesh]
    assert values[min(place, 3)] <= locking_note.kept(mesh, poisson) <= values[place - 1]
    assert locking_note.kept(mesh, locking_note.POISSON[1]) == pytest.approx(values[1])


@pytest.mark.parametrize("split", ["kuhn", "mirrored"])
@pytest.mark.parametrize("poisson", locking_note.POISSON)
def test_the_figures_are_those_of_the_elements(split: str, poisson: float):
    mesh = {"bar": [5, 5, 20], "size": list(SIZE), "split": split}
    table = bar(mesh=mesh, young=1e6, poisson=poisson, density=1000)
    table["effects"]["fixed"] = {"where": "Z < 1e-6"}
    static = {"scheme": "quasi_static", "linearizations": 10}
    sim = Simulation(scene(table, gravity=(0, -1e-4, 0), integrator=static, tolerance=1e-10, preconditioner="cholesky"))
    assert Driver(sim).advance(6)[-1]["status"] == CONVERGED
    x, rest = sim.fetch().x, sim.world.rest
    sag = (rest - x)[rest[:, 2] > SIZE[2] - 1e-6, 1].mean()
    measured = locking_note.KEPT[split][locking_note.POISSON.index(poisson)]
    assert sag * 1e6 / (1000 * 1e-4) / SAG[poisson] == pytest.approx(measured, abs=1e-3)


@pytest.mark.parametrize("kind", ["patch", "smoothed"])
def test_nothing_is_said_of_elements_that_do_not_lock(kind: str):
    table = {"name": "test", "dt": 0.02, "object": [{**bar(mesh=MIRRORED, poisson=0.49), "elements": kind}]}
    assert scene_notes(Simulation(Scene.model_validate(table, context={"folder": "."}))) == []
